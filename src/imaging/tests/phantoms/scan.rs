//! A real coil-faded aorta (never part of the repository): skipped where `VASCULUM_AORTA` names no file.

use imaging::{Axis, Settings, Stack, contours};
use space::{P3, V3};
use std::io::Read;

/// A compressed float MetaImage; only what this one file needs.
fn read(path: &str) -> Option<Stack> {
    let bytes = std::fs::read(path).ok()?;
    let mark = b"ElementDataFile = LOCAL\n";
    let at = bytes.windows(mark.len()).position(|w| w == mark)? + mark.len();
    let header = String::from_utf8_lossy(&bytes[..at]).into_owned();
    let field = |name: &str| -> Vec<f64> {
        let line = header.lines().find(|l| l.split(" = ").next() == Some(name)).unwrap();
        line.split(" = ").nth(1).unwrap().split_whitespace().map(|x| x.parse().unwrap()).collect()
    };
    let (size, step, matrix, origin) =
        (field("DimSize"), field("ElementSpacing"), field("TransformMatrix"), field("Offset"));
    let mut raw = Vec::new();
    flate2::read::ZlibDecoder::new(&bytes[at..]).read_to_end(&mut raw).unwrap();
    let v = |k: usize| V3::new(matrix[3 * k], matrix[3 * k + 1], matrix[3 * k + 2]);
    let origin = P3::new(origin[0], origin[1], origin[2]);
    Stack {
        columns: size[0] as usize,
        rows: size[1] as usize,
        pixels: raw.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect(),
        pixel_spacing_mm: [step[1], step[0]],
        row_direction: v(0),
        column_direction: v(1),
        origins: (0..size[2] as usize).map(|k| origin + v(2) * (k as f64 * step[2])).collect(),
        thickness_mm: None,
    }
    .validated()
    .ok()
}

#[test]
fn a_real_aorta_is_followed_through_all_rows() {
    let path = std::env::var("VASCULUM_AORTA").unwrap_or_default();
    let Some(stack) = read(&path) else {
        println!("skipped: no scan at VASCULUM_AORTA");
        return;
    };
    let (c, r) = contours(&stack, &Settings::default(), &exec::Ctx::new(2).unwrap()).unwrap();
    assert_eq!(r.axis, Axis::Row);
    assert_eq!(r.lumens.len(), 393, "a person sees the lumen in every row");
    // below row 290 a single round lumen of about 22 mm that changes little from row to row, to the last row
    let mut before = None;
    for row in 290..393 {
        let of_row: Vec<_> = c.curves.iter().filter(|k| c.planes[k.plane].index == row).collect();
        let area = of_row.iter().map(|k| k.spline.area()).fold(0.0f64, f64::max);
        let diameter = 2.0 * (area / std::f64::consts::PI).sqrt();
        assert!((20.0..25.0).contains(&diameter), "row {row}: {diameter} mm");
        assert!(before.is_none_or(|b: f64| (area / b - 1.0).abs() < 0.1), "row {row}: {area} after {before:?}");
        before = Some(area);
        assert!(of_row.iter().all(|k| !k.hole), "row {row} is hollow");
    }
}
