//! Grey pictures of contour planes with the contours on them, for the report.
//!
//! Contours may run across slices, rows or columns of the stack, and the sample lattice of a plane may have uneven steps
//! (missing slices). The picture is resampled on an even lattice with the plane's smallest steps, linear between
//! samples, so that a gap is seen at its true width.

use super::Error;
use super::geometry::contour_lines;
use crate::reconstruction::SlicePicture;
use imaging::{Axis, Contours, Plane, Stack};
use space::P3;

/// Darkest and brightest parts of the pixels, which become black and white: specks do not decide the contrast.
const WINDOW: [f64; 2] = [0.01, 0.997];
/// Largest side of a picture, pixels; finer lattices are thinned.
const LARGEST: usize = 1024;

/// Up to three pictures: the first, the middle and the last quarter of the planes that carry contours.
///
/// # Errors
/// [`Error::Mismatch`] for a curve of a plane that does not exist.
pub fn slice_pictures(stack: &Stack, contours: &Contours) -> Result<Vec<SlicePicture>, Error> {
    let lines = contour_lines(contours)?;
    let mut used: Vec<usize> = contours.curves.iter().map(|c| c.plane).collect();
    used.sort_unstable();
    used.dedup();
    let n = used.len();
    let mut chosen: Vec<usize> = [n / 8, n / 2, n * 7 / 8].into_iter().filter_map(|k| used.get(k).copied()).collect();
    chosen.dedup();
    let picture = |k: usize| {
        let plane = &contours.planes[k];
        let on_plane = contours.curves.iter().zip(&lines).filter(|(c, _)| c.plane == k);
        let outlines = on_plane.map(|(_, l)| l.points.iter().map(|&p| plane.in_plane(p)).collect()).collect();
        plane_picture(stack, plane, contours.axis, outlines)
    };
    Ok(chosen.into_iter().map(picture).collect())
}

/// Smallest step of a lattice direction, not finer than [`LARGEST`] steps, and the number of even samples.
pub(super) fn even(offsets: &[f64]) -> (f64, usize) {
    let extent = offsets.last().copied().unwrap_or(0.0);
    let step = offsets.windows(2).map(|w| w[1] - w[0]).filter(|s| *s > 0.0).fold(f64::INFINITY, f64::min);
    if !step.is_finite() || extent <= 0.0 {
        return (1.0, 1);
    }
    let step = step.max(extent / (LARGEST - 1) as f64);
    (step, (extent / step + 1e-6) as usize + 1)
}

/// The axis in a word.
pub(super) fn axis_name(axis: Axis) -> &'static str {
    match axis {
        Axis::Slice => "slice",
        Axis::Row => "row",
        Axis::Column => "column",
    }
}

/// `outlines` in the plane's (u, v), mm.
fn plane_picture(stack: &Stack, plane: &Plane, axis: Axis, outlines: Vec<Vec<[f64; 2]>>) -> SlicePicture {
    let ((step_u, columns), (step_v, rows)) = (even(&plane.u_mm), even(&plane.v_mm));
    let samples = Grey::new(stack);
    let grey: Vec<f64> = (0..rows * columns)
        .map(|i| samples.at(plane.to_patient([(i % columns) as f64 * step_u, (i / columns) as f64 * step_v])))
        .collect();
    let mut sorted = grey.clone();
    sorted.sort_by(f64::total_cmp);
    let at = |part: f64| sorted.get((part * (sorted.len() - 1) as f64) as usize).copied().unwrap_or(0.0);
    let (black, white) = (at(WINDOW[0]), at(WINDOW[1]));
    let scale = 255.0 / (white - black).max(f64::MIN_POSITIVE);
    let name = axis_name(axis);
    let n = plane.normal().to_array().map(f64::abs);
    let k = (0..3).fold(0, |best, k| if n[k] > n[best] { k } else { best });
    SlicePicture {
        title: format!("{name} {}, LPS {} = {:.1} mm", plane.index, ["x", "y", "z"][k], plane.origin.to_array()[k]),
        columns,
        rows,
        pixel_aspect: step_v / step_u,
        pixels: grey.iter().map(|g| ((g - black) * scale).round().clamp(0.0, 255.0) as u8).collect(),
        polylines: outlines
            .into_iter()
            .map(|l| l.into_iter().map(|[u, v]| [u / step_u, v / step_v]).collect())
            .collect(),
    }
}

/// The stack as a function of position: linear between samples, the nearest value outside.
pub(super) struct Grey<'a> {
    stack: &'a Stack,
    offsets: Vec<f64>,
}

impl<'a> Grey<'a> {
    pub(super) fn new(stack: &'a Stack) -> Self {
        Self { stack, offsets: (0..stack.slices()).map(|k| stack.offset_mm(k)).collect() }
    }
    /// The grey value at a point.
    pub(super) fn at(&self, p: P3) -> f64 {
        let s = self.stack;
        if self.offsets.is_empty() || s.columns == 0 || s.rows == 0 {
            return 0.0;
        }
        let d = p - s.origins[0];
        let column = between(d.dot(s.row_direction) / s.pixel_spacing_mm[1], s.columns);
        let row = between(d.dot(s.column_direction) / s.pixel_spacing_mm[0], s.rows);
        let along = d.dot(s.normal());
        let after = self.offsets.partition_point(|&o| o <= along);
        let slice = if after == 0 || after == self.offsets.len() {
            (after.saturating_sub(1), after.saturating_sub(1), 0.0)
        } else {
            let (a, b) = (self.offsets[after - 1], self.offsets[after]);
            (after - 1, after, (along - a) / (b - a))
        };
        let pixel = |k: usize, j: usize, i: usize| f64::from(s.pixels[(k * s.rows + j) * s.columns + i]);
        lerp(slice, |k| lerp(row, |j| lerp(column, |i| pixel(k, j, i))))
    }
}

fn lerp((a, b, t): (usize, usize, f64), value: impl Fn(usize) -> f64) -> f64 {
    if t == 0.0 { value(a) } else { value(a) * (1.0 - t) + value(b) * t }
}

/// The two samples around a lattice coordinate and the weight of the second.
fn between(x: f64, n: usize) -> (usize, usize, f64) {
    let x = x.clamp(0.0, (n - 1) as f64);
    let a = x as usize;
    (a, (a + 1).min(n - 1), x - a as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use space::V3;

    /// Grey = 100 slice position + 10 row + column, with slice 2 of four missing.
    fn stack() -> Stack {
        let z = [0.0, 1.5, 4.5];
        let value = |i: usize| z[i / 20] as f32 * 100.0 + (i % 20 / 5) as f32 * 10.0 + (i % 5) as f32;
        Stack {
            columns: 5,
            rows: 4,
            pixels: (0..60).map(value).collect(),
            pixel_spacing_mm: [0.5, 0.8],
            row_direction: V3::X,
            column_direction: V3::Y,
            origins: z.map(|z| P3::new(10.0, 20.0, z)).to_vec(),
            thickness_mm: None,
        }
    }

    #[test]
    fn grey_values_are_linear_between_samples_and_across_a_gap() {
        let stack = stack();
        let grey = Grey::new(&stack);
        let g = |x, y, z| grey.at(P3::new(x, y, z));
        assert!((g(10.8, 20.5, 1.5) - 161.0).abs() < 1e-9);
        assert!((g(10.4, 20.25, 3.0) - (300.0 + 5.0 + 0.5)).abs() < 1e-9);
        assert!((g(0.0, 0.0, 99.0) - 450.0).abs() < 1e-9);
    }

    #[test]
    fn a_plane_across_the_slices_shows_the_gap_at_its_true_width() {
        let plane = Plane {
            index: 2,
            origin: P3::new(10.0, 21.0, 0.0),
            u: V3::Z,
            v: V3::X,
            u_mm: vec![0.0, 1.5, 4.5],
            v_mm: (0..5).map(|i| 0.8 * f64::from(i)).collect(),
        };
        let p = plane_picture(&stack(), &plane, Axis::Row, vec![vec![[3.0, 1.6]]]);
        assert_eq!((p.columns, p.rows), (4, 5));
        assert!((p.pixel_aspect - 0.8 / 1.5).abs() < 1e-12);
        assert_eq!(p.title, "row 2, LPS y = 21.0 mm");
        let [x, y] = p.polylines[0][0];
        assert!((x - 2.0).abs() < 1e-12 && (y - 2.0).abs() < 1e-12);
        // 100 grey per mm along u: even steps, the missing slice included.
        let row: Vec<f64> = p.pixels[..4].iter().map(|&g| f64::from(g)).collect();
        assert!(((row[2] - row[1]) - (row[1] - row[0])).abs() <= 1.0 && row[3] > row[2]);
    }
}
