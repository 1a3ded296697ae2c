//! A simulated scan as MetaImage (.mha): unsigned shorts, LPS.

use super::dicom::{NotWritable, whole_values};
use super::nifti::even_step;
use imaging::Stack;

/// The volume, uncompressed.
///
/// # Errors
/// As [`super::nifti::volume`].
pub fn volume(stack: &Stack) -> Result<Vec<u8>, NotWritable> {
    let values = whole_values(stack)?;
    let step = even_step(stack)?;
    let axes = [stack.row_direction, stack.column_direction, stack.normal()];
    let words = |v: &[f64]| v.iter().map(|x| format!("{}", x + 0.0)).collect::<Vec<_>>().join(" ");
    let [row, column] = stack.pixel_spacing_mm;
    let header = format!(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\n\
         TransformMatrix = {}\nOffset = {}\nCenterOfRotation = 0 0 0\nElementSpacing = {}\nDimSize = {} {} {}\n\
         ElementType = MET_USHORT\nElementDataFile = LOCAL\n",
        words(&axes.iter().flat_map(|a| a.to_array()).collect::<Vec<_>>()),
        words(&stack.origins[0].to_array()),
        words(&[column, row, step]),
        stack.columns,
        stack.rows,
        stack.slices(),
    );
    let mut out = header.into_bytes();
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    Ok(out)
}
