//! Error bands of all numbers, from draws of other functions that the data allow.
//!
//! A draw differs from the fitted f by delta (see [`implicit::Draws`]). Along a ray of a section the wall moves by
//! -delta / (df/dr), which moves the section's area and centroid; lines, angles, curvature and helix are fitted anew to the
//! moved centres, in the windows of the measurement itself. So a draw costs 24 values of delta per section instead of a
//! measurement of its own, some 1200; the error is of second order in delta over the radius.
//!
//! A band is the value +- 2.06 standard deviations of the draws about it (Student's quantile). Quantiles of 24 draws would have four times the
//! scatter. What bands do not hold: biases of the segmentation that all draws share (the half level of a blurred oblique
//! wall), and a wrong graph.

use crate::Error;
use crate::helix::FittedHelix;
use crate::junction::{Axes, Leg, fit_window};
use crate::section::{Lumen, RAYS_COARSE, Ray, area_and_shift};
use crate::track::Track;
use crate::types::Helix;
use exec::Ctx;
use implicit::Draws;
use space::{P3, V3};

/// Standard deviations of a 95 % band of a normal error.
const DEVIATIONS: f64 = 1.96;

/// Half of a 95 % band in standard deviations that `count` draws give: Student's quantile, expanded about the normal one
/// (Abramowitz and Stegun 26.7.5), 2.06 at 24 draws.
fn deviations(count: usize) -> f64 {
    DEVIATIONS * (1.0 + (DEVIATIONS.powi(2) + 1.0) / (4.0 * count.max(1) as f64))
}

/// value +- a 95 % band from drawn values about it; `None` where a draw has no value.
pub(crate) fn band95(value: f64, drawn: impl ExactSizeIterator<Item = Option<f64>>) -> Option<[f64; 2]> {
    let half = deviations(drawn.len()) * deviation(value, drawn)?;
    Some([value - half, value + half])
}

fn deviation(value: f64, drawn: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    let squares = drawn.map(|v| v.map(|v| (v - value).powi(2))).collect::<Option<Vec<f64>>>()?;
    let deviation = (squares.iter().fold(0.0, |s, x| s + x) / squares.len().max(1) as f64).sqrt();
    (!squares.is_empty() && deviation.is_finite()).then_some(deviation)
}

/// The tracks as each draw has them.
pub(crate) struct Varied {
    /// By draw, then by track.
    tracks: Vec<Vec<Track>>,
}

impl Varied {
    /// # Errors
    /// [`Error::Cancelled`].
    pub(crate) fn new(tracks: &[Track], lumen: Lumen<'_>, draws: &dyn Draws, ctx: &Ctx) -> Result<Self, Error> {
        let items: Vec<(usize, usize)> = tracks
            .iter()
            .enumerate()
            .flat_map(|(t, track)| (0..track.sections.len()).map(move |k| (t, k)))
            .filter(|&(t, k)| tracks[t].sections[k].area_mm2.is_some())
            .collect();
        let rays = ctx.map(&items, |&(t, k)| {
            let s = &tracks[t].sections[k];
            lumen.rays(s.position, s.tangent, s.radius_inscribed_mm, RAYS_COARSE).ok()
        })?;
        let outlines: Vec<Outline> =
            items.into_iter().zip(rays).filter_map(|(place, rays)| Some(Outline { place, rays: rays? })).collect();
        let walls: Vec<P3> = outlines
            .iter()
            .flat_map(|o| {
                let centre = tracks[o.place.0].sections[o.place.1].position.raw();
                o.rays.iter().map(move |ray| P3::from_raw(centre + ray.along * ray.r))
            })
            .collect();
        let varied = ctx.map_range(draws.count(), |draw| {
            let mut delta = vec![0.0; walls.len()];
            draws.differences(draw, &walls, &mut delta);
            varied_tracks(tracks, &outlines, &delta)
        })?;
        Ok(Self { tracks: varied })
    }

    /// Writes the standard errors of areas and curvatures into the sections.
    pub(crate) fn section_errors(&self, tracks: &mut [Track]) {
        for (t, track) in tracks.iter_mut().enumerate() {
            for (k, section) in track.sections.iter_mut().enumerate() {
                let drawn = |of: fn(&crate::Section) -> Option<f64>| {
                    let values = self.tracks.iter().map(move |d| of(&d[t].sections[k]));
                    move |value: f64| deviation(value, values.clone())
                };
                section.area_error_mm2 = section.area_mm2.and_then(drawn(|s| s.area_mm2));
                section.curvature_error_per_mm = section.curvature_per_mm.and_then(drawn(|s| s.curvature_per_mm));
            }
        }
    }

    /// The directions of a junction's legs by draw, in the windows of its measurement.
    pub(crate) fn directions(&self, legs: &[Leg], axes: &Axes) -> Vec<Vec<Option<V3>>> {
        let direction = |tracks: &[Track], leg: usize| {
            let ([from, to], fit) = &axes.windows[leg];
            fit.line?;
            let samples = axes.samples(tracks, legs[leg]);
            fit_window(&samples, *from, *to, 0.0).line.map(|l| l.direction)
        };
        self.tracks.iter().map(|tracks| (0..legs.len()).map(|leg| direction(tracks, leg)).collect()).collect()
    }

    /// 95 % band of a branch's median diameter.
    pub(crate) fn diameter_band(&self, track: usize, diameter_mm: f64) -> Option<[f64; 2]> {
        band95(diameter_mm, self.tracks.iter().map(|d| d[track].area_radius(|_| true).map(|r| 2.0 * r)))
    }

    /// A branch's helix with the bands of its curvature and torsion.
    pub(crate) fn with_bands(&self, track: usize, fitted: &FittedHelix) -> Helix {
        let drawn: Vec<[f64; 2]> = self.tracks.iter().map(|d| fitted.refitted(&d[track].centred())).collect();
        let helix = fitted.helix;
        let band = |value: f64, i: usize| band95(value, drawn.iter().map(move |d| Some(d[i])));
        Helix {
            curvature_band95: band(helix.curvature_per_mm, 0).map(|[low, high]| [low.max(0.0), high]),
            torsion_band95: band(helix.torsion_per_mm, 1),
            ..helix
        }
    }
}

/// The rays of a closed section: (track, section).
struct Outline {
    place: (usize, usize),
    rays: Vec<Ray>,
}

/// The tracks with centres and areas moved by the walls' differences (outline by outline, ray by ray).
fn varied_tracks(tracks: &[Track], outlines: &[Outline], delta: &[f64]) -> Vec<Track> {
    let mut varied = tracks.to_vec();
    for (outline, delta) in outlines.iter().zip(delta.chunks(RAYS_COARSE)) {
        let rays = || outline.rays.iter();
        let (area, centre) = area_and_shift(rays().map(|ray| (ray.r, ray.along)));
        let moved = rays().zip(delta).map(|(ray, d)| ((ray.r - d / ray.fall).max(0.0), ray.along));
        let (moved_area, moved_centre) = area_and_shift(moved);
        let section = &mut varied[outline.place.0].sections[outline.place.1];
        section.position += V3::from_raw(moved_centre - centre);
        section.area_mm2 = section.area_mm2.map(|a| a * moved_area / area);
    }
    for track in &mut varied {
        track.bend();
    }
    varied
}
