//! A simulated scan as NIfTI-1 (.nii): unsigned shorts, sform in scanner coordinates (RAS).

use super::dicom::{NotWritable, whole_values};
use imaging::Stack;

/// The volume. A stack with gaps cannot be said in NIfTI: its slices must be evenly spaced to 1e-3 of a step.
///
/// # Errors
/// [`NotWritable`] when a grey value is no whole number from 0 to 65535, a size exceeds 32767 or the spacing is uneven.
pub fn volume(stack: &Stack) -> Result<Vec<u8>, NotWritable> {
    let values = whole_values(stack)?;
    let step = even_step(stack)?;
    let size = [stack.columns, stack.rows, stack.slices()];
    if size.iter().any(|n| *n > i16::MAX as usize) {
        return Err(NotWritable::Encoder(format!("{size:?} voxels are too many for NIfTI-1")));
    }
    let mut h = [0u8; 352];
    let mut short = |at: usize, x: i16| h[at..at + 2].copy_from_slice(&x.to_le_bytes());
    for (i, n) in [3, size[0], size[1], size[2], 1, 1, 1, 1].into_iter().enumerate() {
        short(40 + 2 * i, n as i16);
    }
    short(70, 512); // unsigned short
    short(72, 16);
    short(254, 1); // sform: scanner
    let mut single = |at: usize, x: f64| h[at..at + 4].copy_from_slice(&(x as f32 + 0.0).to_le_bytes());
    let [row, column] = stack.pixel_spacing_mm;
    for (i, x) in [1.0, column, row, step].into_iter().enumerate() {
        single(76 + 4 * i, x);
    }
    single(108, 352.0);
    single(112, 1.0);
    let columns = [
        (stack.row_direction * column).to_array(),
        (stack.column_direction * row).to_array(),
        (stack.normal() * step).to_array(),
        stack.origins[0].to_array(),
    ];
    for axis in 0..3 {
        let sign = if axis < 2 { -1.0 } else { 1.0 }; // LPS -> RAS
        for (c, v) in columns.iter().enumerate() {
            single(280 + 16 * axis + 4 * c, sign * v[axis]);
        }
    }
    h[0..4].copy_from_slice(&348i32.to_le_bytes());
    h[123] = 2; // mm
    h[344..348].copy_from_slice(b"n+1\0");
    let mut out = h.to_vec();
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    Ok(out)
}

/// The step between slices where it is one.
///
/// # Errors
/// [`NotWritable::Encoder`] with the number of the uneven slice.
pub(crate) fn even_step(stack: &Stack) -> Result<f64, NotWritable> {
    let step = stack.slice_spacing_mm();
    match (1..stack.slices()).find(|&k| (stack.offset_mm(k) - stack.offset_mm(k - 1) - step).abs() > 1e-3 * step) {
        Some(k) => Err(NotWritable::Encoder(format!(
            "slice {k} is not {step} mm from the one before; a volume needs even steps"
        ))),
        None if stack.slices() > 1 => {
            // the mean step: the last slice lies where it lies
            Ok(stack.offset_mm(stack.slices() - 1) / (stack.slices() - 1) as f64)
        }
        None => Err(NotWritable::Encoder("a volume needs two slices".to_owned())),
    }
}
