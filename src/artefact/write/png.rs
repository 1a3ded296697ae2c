//! Grey PNG slices (16 bits) with a plan that carries their geometry.

use super::dicom::{NotWritable, whole_values};
use crate::plan::{Geometry, Plan};
use crate::read::NamedBytes;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use imaging::Stack;
use std::io::Cursor;
use tiff::encoder::{TiffEncoder, colortype::Gray32Float};

/// `slice-0000.png` and on, and `plan.json` with the geometry (positions of all slices).
///
/// # Errors
/// [`NotWritable`] when a grey value is no whole number from 0 to 65535.
pub fn slices(stack: &Stack) -> Result<Vec<NamedBytes>, NotWritable> {
    let values = whole_values(stack)?;
    let size = stack.rows * stack.columns;
    let mut files = Vec::with_capacity(stack.slices() + 1);
    for (k, slice) in values.chunks_exact(size).enumerate() {
        let bytes = encoded(slice, stack.columns, stack.rows).map_err(NotWritable::Encoder)?;
        files.push(NamedBytes::new(format!("slice-{k:04}.png"), bytes));
    }
    let bytes = serde_json::to_vec_pretty(&plan(stack)).map_err(|e| NotWritable::Encoder(e.to_string()))?;
    files.push(NamedBytes::new("plan.json", bytes));
    Ok(files)
}

/// A plan with the geometry of a stack.
pub fn plan(stack: &Stack) -> Plan {
    Plan {
        geometry: Geometry {
            pixel_spacing_mm: Some(stack.pixel_spacing_mm),
            slice_spacing_mm: None,
            slice_positions_mm: Some((0..stack.slices()).map(|k| stack.offset_mm(k)).collect()),
            origin_mm: stack.origins.first().map(|o| o.to_array()),
            row_direction: Some(stack.row_direction.to_array()),
            column_direction: Some(stack.column_direction.to_array()),
        },
        ..Plan::default()
    }
}

fn encoded(values: &[u16], columns: usize, rows: usize) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    // the encoder takes samples in the machine's byte order
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_ne_bytes()).collect();
    PngEncoder::new(&mut out)
        .write_image(&bytes, columns as u32, rows as u32, ExtendedColorType::L16)
        .map_err(|e| e.to_string())?;
    Ok(out)
}

/// A picture with exactly these values: a 16-bit PNG where they fit, else a TIFF of 32-bit floats. With its extension.
pub(crate) fn lossless(pixels: &[f32], columns: usize, rows: usize) -> Result<(&'static str, Vec<u8>), String> {
    let whole: Option<Vec<u16>> = pixels.iter().map(|p| whole(*p)).collect();
    if let Some(values) = whole {
        return Ok(("png", encoded(&values, columns, rows)?));
    }
    let mut out = Cursor::new(Vec::new());
    TiffEncoder::new(&mut out)
        .and_then(|mut t| t.write_image::<Gray32Float>(columns as u32, rows as u32, pixels))
        .map_err(|e| e.to_string())?;
    Ok(("tif", out.into_inner()))
}

/// The value as an unsigned short, where it is one.
pub(crate) fn whole(p: f32) -> Option<u16> {
    ((0.0..=65_535.0).contains(&p) && p.fract() == 0.0).then_some(p as u16)
}
