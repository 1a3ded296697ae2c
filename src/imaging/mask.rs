//! A lumen that somebody else has drawn (a label mask) instead of the search for one.
//!
//! Which voxels belong to the lumen is the mask's to say; where between two voxels the wall lies, the image knows better:
//! a mask's boundary is good to a pixel's rounding (.29 px), the local half-maximum of the grey values to a few
//! hundredths (tube of 5 px, SNR 20, mask drawn half a pixel too narrow to half a pixel too wide, 10 seeds: rms .033 to
//! .049 px, area -1.2 to +.3 % before the correction for the point spread). Within one pixel of the mask's boundary the contour therefore follows the half-way level between lumen and
//! surroundings, as far as the image shows its wall there; elsewhere it follows the mask itself, half-way between its
//! voxels. A contour is never farther than one voxel from the mask's boundary.
//!
//! Limits: a mask drawn more than a pixel too wide or too narrow keeps that error. A mask without its image is used as
//! its own image: rms .08 px and area +.7 % against the true circle of 5 px after smoothing where voxel centres were
//! classified without error, and as wrong as its author elsewhere.

use crate::level::Patch;
use crate::segment::{Segmentation, Site, patch, patch_index, radius};
use crate::volume::{Volume, median, noise};
use crate::{Error, Settings, Stack};
use exec::Ctx;
use space::{Place, Warning};
use std::sync::Arc;

/// Which voxels of a stack are lumen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// One per pixel of the stack, in its order.
    inside: Arc<[bool]>,
}

impl Mask {
    /// A mask; `inside` has one entry per pixel of the stack that it belongs to, in the stack's order.
    pub fn new(inside: Vec<bool>) -> Self {
        Self { inside: inside.into() }
    }
    /// One entry per pixel.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
    /// The mask of the stack without some slices; `area` is the number of pixels of a slice.
    #[must_use]
    pub(crate) fn without(&self, slices: &[usize], area: usize) -> Self {
        let kept = self.inside.chunks(area).enumerate().filter(|(k, _)| !slices.contains(k));
        Self { inside: kept.flat_map(|(_, s)| s.iter().copied()).collect() }
    }
}

/// Width of the band in which the image decides, tenths of a pixel from the other side's nearest voxel: one pixel from the
/// boundary half-way between. At 10 a mask drawn half a pixel too narrow costs 6 % of the area of a tube of 5 px.
const BAND: u8 = 15;
/// The band's inner voxels, which touch the boundary: the image places the wall on either side of them.
const INNER: u8 = 10;
/// Contrast below this many deviations of the noise shows no wall.
const LEAST_CONTRAST: f32 = 3.0;
/// An outer voxel of the band may hold this share of lumen by its grey value (outside the mask; inside it, of tissue);
/// beyond, the wall that the image shows lies outside the band and the mask decides.
const MOST_AGAINST: f32 = 0.75;
/// Share of boundary voxels without a wall in the image that is told.
const TOLD_SHARE: f64 = 0.2;

/// The mask as a segmentation: sites within the band where the image shows its wall, forced elsewhere.
///
/// # Errors
/// [`Error::Mask`] for a mask of another size or without a voxel, [`Error::Cancelled`].
pub(crate) fn segmentation(stack: &Stack, mask: &Mask, settings: &Settings, ctx: &Ctx) -> Result<Segmentation, Error> {
    if mask.inside.len() != stack.pixels.len() {
        let reason = format!("it has {} voxels and the stack {}", mask.inside.len(), stack.pixels.len());
        return Err(Error::Mask { reason });
    }
    let place = |i: usize| [i % stack.columns, i / stack.columns % stack.rows, i / stack.columns / stack.rows];
    let voxels: Vec<[usize; 3]> = (0..mask.inside.len()).filter(|&i| mask.inside[i]).map(place).collect();
    if voxels.is_empty() {
        return Err(Error::Mask { reason: "no voxel of the stack is marked".into() });
    }
    let noise = noise(stack);
    let (smooth, _) = Volume::denoised(stack, ctx)?;
    ctx.progress(0.3);
    let patch = patch(stack, &smooth, &voxels);
    let mut inside = vec![false; patch.raw.len()];
    for &p in &voxels {
        inside[patch_index(&patch, p)] = true;
    }
    // first without, then with the other bright structures left out of the surroundings
    let first = patch.fields(&inside, |_| f32::MAX, ctx)?;
    ctx.progress(0.6);
    let near = patch.fields(&inside, |i| first.level(i), ctx)?;
    let fields = patch.drawing_fields(&inside, near, ctx)?;
    let outside_error = patch.outside_error(&inside, &fields, ctx)?;
    let contrast: Vec<f32> = (0..inside.len()).map(|i| fields.contrast(i)).collect();
    let level: Vec<f32> = match settings.threshold {
        Some(t) => vec![t as f32; inside.len()],
        None => (0..inside.len()).map(|i| fields.level(i)).collect(),
    };
    let sites = sites(&patch, &inside, (level, &contrast), noise);
    let mut levels: Vec<f64> =
        (0..inside.len()).filter(|&i| sites.site[i] == Site::Lumen).map(|i| f64::from(sites.level[i])).collect();
    let threshold = settings.threshold.unwrap_or_else(|| median(&mut levels));
    ctx.progress(1.0);
    Ok(Segmentation {
        low: patch.low,
        size: patch.n,
        radius_mm: radius(&patch, &inside),
        site: sites.site,
        level: sites.level,
        contrast,
        outside_error,
        noise,
        threshold: if threshold.is_finite() { threshold } else { 0.0 },
        candidates: Vec::new(),
        warnings: sites.warnings,
    })
}

struct Sites {
    site: Vec<Site>,
    level: Vec<f32>,
    warnings: Vec<Warning>,
}

/// Voxels of the band that the image supports keep their level; the others are forced to the mask's side, half a contrast
/// away from the level, so that a contour runs half-way between them.
fn sites(patch: &Patch, inside: &[bool], (mut level, contrast): (Vec<f32>, &[f32]), noise: f64) -> Sites {
    let outside: Vec<bool> = inside.iter().map(|m| !m).collect();
    let near = patch.distances(inside, BAND);
    let deep = patch.distances(&outside, BAND);
    // outer voxels of the band and those of them that were forced, outside and inside the mask
    let mut outer = [[0usize; 2]; 2];
    let mut site = Vec::with_capacity(inside.len());
    for i in 0..inside.len() {
        let distance = if inside[i] { deep[i] } else { near[i] };
        let is_band = distance <= BAND;
        let height = patch.raw[i] - level[i];
        let toward = if inside[i] { -height } else { height };
        let fits = distance <= INNER || toward < (MOST_AGAINST - 0.5) * contrast[i];
        let shown = fits && contrast[i] > LEAST_CONTRAST * noise as f32;
        if is_band && distance > INNER {
            outer[usize::from(inside[i])][0] += 1;
            outer[usize::from(inside[i])][1] += usize::from(!shown);
        }
        if is_band && !shown {
            let half = 0.5 * contrast[i].max(f32::MIN_POSITIVE);
            level[i] = patch.raw[i] + if inside[i] { -half } else { half };
        }
        site.push(match (inside[i], is_band && shown) {
            (true, true) => Site::Lumen,
            (true, false) => Site::Deep,
            (false, true) => Site::Near,
            (false, false) => Site::Far,
        });
    }
    let share = outer.iter().map(|[all, forced]| *forced as f64 / (*all).max(1) as f64).fold(0.0, f64::max);
    let mut warnings = Vec::new();
    if share > TOLD_SHARE {
        let message = format!(
            "at {:.0} % of one side of the mask's boundary the image shows no wall within one pixel; there the contours follow the \
             mask itself, which is good to a third of a pixel at best",
            100.0 * share
        );
        warnings.push(Warning::new("segmentation.mask_unsupported", message, Place::none()));
    }
    Sites { site, level, warnings }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Contours, Report, contours};
    use space::{P3, V3};

    const CENTRE: [f64; 2] = [20.3, 19.6];
    const RADIUS: f64 = 5.0;

    /// A vertical tube of 5 px radius blurred by .6 px, contrast 100; `noise` by seed.
    fn tube(noise: f64, seed: u64) -> Stack {
        let mut state = seed * 2 + 1;
        let mut gauss = || {
            // sum of 12 uniform numbers
            let sum: f64 = (0..12)
                .map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 11) as f64 / (1u64 << 53) as f64
                })
                .sum();
            sum - 6.0
        };
        let fine = 4;
        let blurred = |x: f64, y: f64| {
            // pixel average, Gaussian edge
            let mut sum = 0.0;
            for i in 0..fine * fine {
                let sub = |k: usize| (k as f64 + 0.5) / fine as f64 - 0.5;
                let r = (x + sub(i % fine) - CENTRE[0]).hypot(y + sub(i / fine) - CENTRE[1]);
                sum += 1.0 / (1.0 + (1.702 * (r - RADIUS) / 0.6).exp());
            }
            sum / (fine * fine) as f64
        };
        let plane: Vec<f64> = (0..40 * 40).map(|i| blurred((i % 40) as f64, (i / 40) as f64)).collect();
        Stack {
            columns: 40,
            rows: 40,
            pixels: (0..8).flat_map(|_| plane.clone()).map(|v| (100.0 * v + noise * gauss()) as f32).collect(),
            pixel_spacing_mm: [1.0, 1.0],
            row_direction: V3::X,
            column_direction: V3::Y,
            origins: (0..8).map(|k| P3::new(0.0, 0.0, 2.0 * f64::from(k))).collect(),
            thickness_mm: Some(2.0),
        }
    }

    fn drawn(radius: f64) -> Mask {
        let inside = |i: usize| ((i % 40) as f64 - CENTRE[0]).hypot((i / 40 % 40) as f64 - CENTRE[1]) < radius;
        Mask::new((0..40 * 40 * 8).map(inside).collect())
    }

    fn of(stack: &Stack, mask: Mask, threads: usize) -> (Contours, Report) {
        let settings = Settings { mask: Some(mask), psf_sigma_px: Some(0.0), ..Settings::default() };
        contours(stack, &settings, &Ctx::new(threads).unwrap()).unwrap()
    }

    /// rms distance of the curves from the true circle and relative error of the area.
    fn errors(c: &Contours) -> (f64, f64) {
        let (mut sum, mut n, mut area) = (0.0, 0, 0.0);
        for curve in &c.curves {
            let points: Vec<[f64; 2]> =
                (0..400).map(|i| curve.spline.derivatives(curve.spline.length() * f64::from(i) / 400.0)[0]).collect();
            for (k, p) in points.iter().enumerate() {
                sum += ((p[0] - CENTRE[0]).hypot(p[1] - CENTRE[1]) - RADIUS).powi(2);
                n += 1;
                let q = points[(k + 1) % 400];
                area += 0.5 * (p[0] * q[1] - p[1] * q[0]);
            }
        }
        let truth = std::f64::consts::PI * RADIUS * RADIUS * c.curves.len() as f64;
        ((sum / f64::from(n)).sqrt(), area / truth - 1.0)
    }

    #[test]
    fn within_the_band_the_image_places_the_wall() {
        for seed in 0..10 {
            let stack = tube(5.0, seed);
            for wrong in [-0.5, 0.0, 0.5] {
                let (c, report) = of(&stack, drawn(RADIUS + wrong), 1);
                let (rms, area) = errors(&c);
                println!("image: seed {seed} drawn {wrong:+} rms {rms:.3} px, area {:+.2} %", 100.0 * area);
                assert_eq!(c.curves.len(), 8);
                assert!(rms < 0.1 && area.abs() < 0.02, "seed {seed}, {wrong}: {rms} {area}");
                assert!(report.warnings.iter().all(|w| w.code != "segmentation.mask_unsupported"));
            }
        }
    }

    #[test]
    fn a_mask_is_its_own_image_where_there_is_none() {
        let mask = drawn(RADIUS);
        let pixels = mask.inside().iter().map(|&m| f32::from(u8::from(m))).collect();
        let (c, _) = of(&Stack { pixels, ..tube(0.0, 0) }, mask, 1);
        let (rms, area) = errors(&c);
        println!("alone: rms {rms:.3} px, area {:+.2} %", 100.0 * area);
        assert!(rms < 0.2 && area.abs() < 0.03, "{rms} {area}");
    }

    #[test]
    fn where_the_image_shows_no_wall_the_mask_decides_and_it_is_said() {
        let told = |report: &Report| report.warnings.iter().any(|w| w.code == "segmentation.mask_unsupported");
        // a wall drawn 2 px inside the true one: beyond the band
        let (c, report) = of(&tube(5.0, 1), drawn(RADIUS - 2.0), 1);
        let radius = (1.0 + errors(&c).1).sqrt() * RADIUS;
        println!("drawn 2 px too narrow: radius {radius:.2} px of {RADIUS}");
        assert!(told(&report) && radius < RADIUS - 1.0, "{radius}");
        // noise alone
        let pixels = tube(5.0, 1).pixels.iter().zip(tube(0.0, 1).pixels).map(|(a, b)| a - b).collect();
        let (c, report) = of(&Stack { pixels, ..tube(0.0, 1) }, drawn(RADIUS), 1);
        let (rms, area) = errors(&c);
        println!("noise alone: rms {rms:.3} px, area {:+.2} %", 100.0 * area);
        assert!(told(&report) && rms < 0.25 && area.abs() < 0.05, "{rms} {area}");
    }

    #[test]
    fn the_outcome_has_the_same_bits_for_any_number_of_threads() {
        let bits = |threads| {
            let (c, _) = of(&tube(5.0, 3), drawn(RADIUS), threads);
            c.curves.iter().map(|c| c.spline.length().to_bits()).collect::<Vec<_>>()
        };
        assert_eq!(bits(1), bits(2));
        assert_eq!(bits(1), bits(3));
    }

    #[test]
    fn an_empty_or_foreign_mask_is_refused() {
        let stack = tube(1.0, 1);
        for mask in [Mask::new(vec![false; 40 * 40 * 8]), Mask::new(vec![true; 7])] {
            let settings = Settings { mask: Some(mask), ..Settings::default() };
            let e = contours(&stack, &settings, &Ctx::new(1).unwrap()).unwrap_err();
            assert!(matches!(e, Error::Mask { .. }), "{e}");
        }
    }
}
