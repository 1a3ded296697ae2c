//! Smoothing of f as a 3D image, nowhere moving the wall by more than a bound (Giordana et al., section 2.4: one pixel).
//!
//! The filter is 2 G - G*G with G a Gaussian ("twicing"), not G alone: G shrinks a vessel of radius R by sigma^2 / 2R
//! (sigma = .5 mm, R = 3 mm: .042 mm, 2.8 % of the area), the twiced filter by sigma^4 / 4R^3 (6e-4 mm, .04 %), while
//! both remove what is shorter than about 3 sigma. docs/adr/0003 has the figures. The largest sigma within the bound is
//! found by a guarded secant search on displacements measured in both directions.

use crate::{Error, Field, Sampled, SampledSettings, foot};
use exec::Ctx;
use space::P3;

/// How far to smooth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Smoothing {
    /// Pixel size, mm.
    pub pixel_mm: f64,
    /// Largest displacement of the wall, pixels.
    pub max_displacement_px: f64,
    /// Largest standard deviation tried, pixels. Above 1.5 the filter starts to eat what the scan resolves.
    pub max_sigma_px: f64,
}

impl Smoothing {
    /// The defaults for a pixel size: one pixel of displacement.
    pub fn new(pixel_mm: f64) -> Self {
        Self { pixel_mm, max_displacement_px: 1.0, max_sigma_px: 1.5 }
    }

    /// Lattice that resolves the pixel twice over, within `max_points`.
    pub fn sampling(&self) -> SampledSettings {
        SampledSettings {
            spacing_mm: 0.5 * self.pixel_mm,
            band_mm: (2.0 * self.max_sigma_px + self.max_displacement_px.min(2.0)) * self.pixel_mm,
            ..SampledSettings::default()
        }
    }
}

/// What the smoothing did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SmoothReport {
    /// Standard deviation chosen, mm.
    pub sigma_mm: f64,
    /// Largest distance from the given wall points to the smoothed wall, mm.
    pub forward_mm: f64,
    /// Largest distance from those points of the smoothed wall back to the unsmoothed one, mm.
    pub backward_mm: f64,
}

/// Share of the bound that the search aims at: the rest is for wall between the points it measures.
const AIM: f64 = 0.9;
/// A displacement of at least this share of the aim ends the search: sigma is then within 6 % of the largest.
const NEAR: f64 = 0.8;
/// Most filters tried; each costs six passes over the band (docs/adr/0024).
const ATTEMPTS: usize = 8;
/// Feet are sought within this many bounds.
const REACH: f64 = 3.0;
/// The twiced Gaussian moves a smooth wall by sigma^4, a rough one by less: the power of the next guess.
const POWER: f64 = 3.0;

/// The smoothed field of the largest sigma (at most `sigma_limit_mm`) whose wall stays within the bound of the `wall`
/// points, which lie on the zero level of `sampled`.
///
/// # Errors
/// [`Error::Cancelled`].
pub fn smooth(
    sampled: &Sampled,
    wall: &[P3],
    settings: &Smoothing,
    sigma_limit_mm: f64,
    ctx: &Ctx,
) -> Result<(Sampled, SmoothReport), Error> {
    let bound = AIM * settings.max_displacement_px * settings.pixel_mm;
    let (mut low, mut high) = (0.0, sigma_limit_mm.min(settings.max_sigma_px * settings.pixel_mm));
    let mut sigma = high;
    let mut best = None;
    for step in 0..ATTEMPTS {
        ctx.progress(step as f64 / ATTEMPTS as f64);
        let field = sampled.smoothed(sigma, ctx)?;
        let moved = displacement(sampled, &field, wall, REACH * bound, ctx)?;
        let share = moved.map(|(forward, backward)| forward.max(backward) / bound);
        match (moved, share) {
            (Some((forward_mm, backward_mm)), Some(share)) if share <= 1.0 => {
                best = Some((field, SmoothReport { sigma_mm: sigma, forward_mm, backward_mm }));
                low = sigma;
                if share >= NEAR || low == high {
                    break;
                }
            }
            _ => high = sigma,
        }
        // towards the middle of what the search aims at, but never so near an end that nothing is learnt
        let guess = share.map_or(0.0, |share| sigma * (0.5 * (1.0 + NEAR) / share.max(1e-6)).powf(1.0 / POWER));
        sigma = guess.clamp(low + 0.2 * (high - low), high - 0.05 * (high - low));
    }
    let unsmoothed = SmoothReport { sigma_mm: 0.0, forward_mm: 0.0, backward_mm: 0.0 };
    Ok(best.unwrap_or_else(|| (sampled.clone(), unsmoothed)))
}

/// Largest forward and backward distance, mm; `None` where some point finds no wall within reach.
fn displacement(
    from: &Sampled,
    to: &Sampled,
    wall: &[P3],
    reach_mm: f64,
    ctx: &Ctx,
) -> Result<Option<(f64, f64)>, Error> {
    let feet = ctx.map(wall, |&p| {
        let there = foot(to as &dyn Field, p, reach_mm)?;
        let back = foot(from as &dyn Field, there, reach_mm)?;
        Some((p.distance(there), there.distance(back)))
    })?;
    Ok(feet.into_iter().try_fold((0.0_f64, 0.0_f64), |m, d| d.map(|d| (m.0.max(d.0), m.1.max(d.1)))))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::test_fields::DentedCylinder;

    #[test]
    fn the_bound_holds_and_a_dent_is_filled() {
        let dented = DentedCylinder { radius: 3.0, depth: 0.35, width: 0.6 };
        let ctx = Ctx::new(2).unwrap();
        let smoothing = Smoothing { max_displacement_px: 0.5, ..Smoothing::new(0.5) };
        let wall = dented.wall(8.0);
        let sampled = Sampled::new(&dented, &wall, &smoothing.sampling(), &ctx).unwrap();
        let kept: Vec<P3> = wall.into_iter().filter(|p| p.z().abs() < 5.0).collect();
        let (f, report) = smooth(&sampled, &kept, &smoothing, f64::INFINITY, &ctx).unwrap();
        assert!(report.sigma_mm > 0.0);
        for &p in &kept {
            let moved = p.distance(foot(&f, p, 1.0).unwrap());
            assert!(moved <= 0.25, "{moved}");
        }
        let floor = foot(&f, P3::new(3.0 - 0.35, 0.0, 0.0), 1.0).unwrap();
        assert!(floor.x() > 3.0 - 0.35 + 0.15, "{floor:?}");
    }
}
