//! Raw and smooth contours of discs and peanuts with known walls, as text for the judge `tests/python/test_contours.py`.
//!
//! One line per contour: shape, radius, SNR, seed, centre x, centre y, turn, raw points `x,y;...`, smooth points.

use imaging::{Layout, Settings, Slice, Stack, contours};
use space::{P3, V3};
use std::f64::consts::TAU;
use std::fmt::Write;

const SIDE: usize = 64;
const SEEDS: usize = 20;
const BLUR_PX: f64 = 0.6;

/// Deterministic noise: splitmix64 and Box-Muller.
struct Draw(u64);

impl Draw {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
    fn gauss(&mut self) -> f64 {
        let (u, v) = (self.uniform().max(1e-300), self.uniform());
        (-2.0 * u.ln()).sqrt() * (TAU * v).cos()
    }
}

/// Signed distance, negative inside; a peanut is two discs of .6 radius, joined by a smooth minimum.
fn distance(peanut: bool, radius: f64, turn: f64, x: f64, y: f64) -> f64 {
    if !peanut {
        return x.hypot(y) - radius;
    }
    let one = |s: f64| (x - s * 0.5 * radius * turn.cos()).hypot(y - s * 0.5 * radius * turn.sin()) - 0.6 * radius;
    let (p, q, k) = (one(1.0), one(-1.0), 0.4 * radius);
    let h = (k - (p - q).abs()).max(0.0) / k;
    p.min(q) - k * h * h * h / 6.0
}

/// Share of the shape in a pixel: the Gaussian point spread over the pixel's own square, by quarter-pixel sums.
fn share(d: impl Fn(f64, f64) -> f64, x: f64, y: f64) -> f64 {
    let middle = d(x, y);
    if middle.abs() > 4.0 {
        return f64::from(u8::from(middle < 0.0));
    }
    let weight = |k: i32| -> f64 {
        (0..8).map(|q| (f64::from(k) / 4.0 + (f64::from(q) - 3.5) / 8.0) / BLUR_PX).map(|t| (-0.5 * t * t).exp()).sum()
    };
    let (mut sum, mut total) = (0.0, 0.0);
    for j in -11..=11 {
        for i in -11..=11 {
            let w = weight(i) * weight(j);
            total += w;
            sum += w * (0.5 - 4.0 * d(x + f64::from(i) / 4.0, y + f64::from(j) / 4.0)).clamp(0.0, 1.0);
        }
    }
    sum / total
}

/// Twenty slices of one shape, each with its own centre, turn and noise.
fn judged(peanut: bool, radius: f64, snr: f64, out: &mut String) -> Result<(), Box<dyn std::error::Error>> {
    let mut draw = Draw((radius * 100.0 + snr) as u64 + u64::from(peanut) * 7919);
    let mut truth = Vec::new();
    let mut slices = Vec::new();
    for seed in 0..SEEDS {
        let centre = [31.5 + draw.uniform(), 31.5 + draw.uniform()];
        let turn = if peanut { 0.4 + 0.1 * seed as f64 } else { 0.0 };
        let pixels = (0..SIDE * SIDE)
            .map(|k| {
                let (x, y) = ((k % SIDE) as f64, (k / SIDE) as f64);
                let part = share(|x, y| distance(peanut, radius, turn, x - centre[0], y - centre[1]), x, y);
                (200.0 + 800.0 * (part + draw.gauss() / snr)) as f32
            })
            .collect();
        truth.push((centre, turn));
        slices.push(Slice { columns: SIDE, rows: SIDE, pixels, origin: P3::new(0.0, 0.0, 2.0 * seed as f64) });
    }
    let layout =
        Layout { pixel_spacing_mm: [1.0, 1.0], row_direction: V3::X, column_direction: V3::Y, thickness_mm: None };
    let settings = Settings {
        threshold: Some(600.0),
        psf_sigma_px: Some(BLUR_PX),
        axis: Some(imaging::Axis::Slice),
        ..Settings::default()
    };
    let (c, _) = contours(&Stack::new(layout, slices)?, &settings, &exec::Ctx::new(2)?)?;
    let list =
        |points: &[[f64; 2]]| points.iter().map(|p| format!("{:.5},{:.5}", p[0], p[1])).collect::<Vec<_>>().join(";");
    for curve in &c.curves {
        let ([x, y], turn) = truth[curve.plane];
        let n = 200;
        let fine: Vec<[f64; 2]> =
            (0..n).map(|i| curve.spline.derivatives(curve.length_mm() * i as f64 / n as f64)[0]).collect();
        let shape = if peanut { "peanut" } else { "disc" };
        let (raw, fine) = (list(&curve.raw), list(&fine));
        writeln!(out, "{shape} {radius} {snr} {} {x:.6} {y:.6} {turn:.6} {raw} {fine}", curve.plane)?;
    }
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut out = String::new();
    for radius in [5.0, 7.5, 10.0] {
        for snr in [10.0, 20.0, 30.0] {
            judged(false, radius, snr, &mut out)?;
        }
        judged(true, radius, 20.0, &mut out)?;
    }
    print!("{out}");
    Ok(())
}
