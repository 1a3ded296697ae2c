//! The lumen as the medial line's later steps see it: rays to the wall, inscribed spheres, cross-sections.
//!
//! A ray is marched through the voxels (a bit each, nanoseconds) and f is asked only where the voxels say that the wall
//! is near, then the wall is found by bracketing and Newton: some 6 values and gradients of f per ray (measured). A septum
//! thinner than the voxels is therefore not seen; the automatic spacing is a quarter of the smallest radius.

use crate::voxelise::Domain;
use crate::{BitVolume, Settings};
use imaging::CutPlane;
use implicit::Field;
use space::{Affine, Grid, P3, Patient, V3, Voxel};
use std::f64::consts::TAU;

/// Directions of the first search for the nearest wall; the best is refined on f. 96 leave 0.2 rad between them.
const SPHERE: usize = 96;
/// A section whose longest radius about its centroid exceeds its shortest by more than this leaks into a neighbour: an
/// oblique section of 66 degrees and a vessel pressed flat to 2.5 : 1 pass, the mouth of a branch does not.
const LONGEST_RADIUS: f64 = 2.5;
/// Largest ratio of two radii at neighbouring rays, for 64 rays. An ellipse of 2.5 : 1 has at most 1.1.
const RADIUS_JUMP: f64 = 1.4;

/// f, the cut planes and the voxels that were made of them.
pub struct Lumen<'a> {
    domain: Domain<'a>,
    volume: &'a BitVolume,
    to_voxel: Affine<Patient, Voxel>,
    spacing_mm: f64,
    limit_mm: f64,
}

/// What a ray met, and how far away, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Hit {
    /// f = 0.
    Wall(f64),
    /// A cut plane, or nothing within reach.
    Open,
}

/// A cross-section that is closed and does not leak.
#[derive(Clone, Debug)]
pub(crate) struct Section {
    /// Area centroid.
    pub(crate) centre: P3,
    /// mm2.
    pub(crate) area: f64,
    /// The two points of its outline that are nearest to the point it was taken at, on different sides.
    pub(crate) near: [P3; 2],
}

impl<'a> Lumen<'a> {
    /// The lumen of `field` within `cuts`, whose voxels (before thinning) are `volume` on `grid` (see
    /// [`crate::voxelise`]). `None` when the grid's map is singular.
    pub fn new(field: &'a dyn Field, cuts: &'a [CutPlane], volume: &'a BitVolume, grid: &Grid) -> Option<Self> {
        let to_voxel = grid.to_patient.inverse()?;
        let spacing_mm = (grid.point(1, 0, 0) - grid.point(0, 0, 0)).length();
        let limit_mm = field.bounds().size().length();
        Some(Self { domain: Domain { field, cuts }, volume, to_voxel, spacing_mm, limit_mm })
    }

    /// Spacing of the voxels, mm.
    pub fn spacing_mm(&self) -> f64 {
        self.spacing_mm
    }

    /// Whether f > 0 and no cut plane is passed.
    pub fn contains(&self, x: P3) -> bool {
        self.domain.contains(x)
    }

    /// Whether the voxel nearest to a point is lumen.
    fn voxel(&self, x: P3) -> bool {
        let v = self.to_voxel.point(x).to_array().map(f64::round);
        v.iter().all(|c| c.abs() < 1e9) && self.volume.at(v.map(|c| c as isize))
    }

    /// Whether the straight line between two points stays where f > 0, at steps of half a voxel. (A lumen voxel reaches
    /// half a voxel into the tissue beyond the wall: it does not tell.)
    pub(crate) fn sees(&self, a: P3, b: P3) -> bool {
        let steps = (a.distance(b) / (0.5 * self.spacing_mm)).ceil().max(1.0) as usize;
        (1..steps).all(|i| self.domain.field.value(a.lerp(b, i as f64 / steps as f64)) > 0.0)
    }

    /// A point that lies up to half a voxel beyond the wall, or hardly inside it, moved a tenth of a voxel inside: voxel
    /// lines in the crotch of two vessels side by side graze the wall between them.
    pub(crate) fn inward(&self, x: P3) -> P3 {
        let (margin, reach) = (0.1 * self.spacing_mm, 0.5 * self.spacing_mm);
        let (f, g) = self.domain.field.gradient(x);
        let slope = g.length();
        if f >= margin * slope || f < -reach * slope || slope <= f64::MIN_POSITIVE {
            return x;
        }
        x + g * ((margin * slope - f) / (slope * slope))
    }

    /// Length of the straight line between two points that is not lumen, to a quarter of a voxel, mm.
    pub(crate) fn tissue_mm(&self, a: P3, b: P3) -> f64 {
        let steps = (a.distance(b) / (0.25 * self.spacing_mm)).ceil().max(1.0);
        let outside = (0..steps as usize).filter(|&i| {
            let x = a.lerp(b, (i as f64 + 0.5) / steps);
            self.domain.field.value(x) <= 0.0
        });
        outside.count() as f64 * a.distance(b) / steps
    }

    /// The first wall along a ray from a point inside, not farther than `reach`.
    pub(crate) fn ray(&self, from: P3, direction: V3, reach: f64) -> Hit {
        let step = 0.5 * self.spacing_mm;
        let end = self.cut_distance(from, direction).min(reach).min(self.limit_mm);
        let at = |t: f64| self.domain.field.value(from + direction * t);
        let mut t = 0.0;
        while t < end {
            t = (t + step).min(end);
            if (t < end && self.voxel(from + direction * t)) || at(t) > 0.0 {
                continue;
            }
            let (mut low, mut high) = (t - step, t);
            while low > 0.0 && at(low) <= 0.0 {
                (low, high) = (low - step, low);
            }
            return Hit::Wall(self.root(from, direction, [low.max(0.0), high]));
        }
        Hit::Open
    }

    fn cut_distance(&self, from: P3, direction: V3) -> f64 {
        self.domain.cuts.iter().filter_map(|cut| cut.passed_at(from, direction)).fold(f64::INFINITY, f64::min)
    }

    /// f = 0 along a ray between `low` (inside) and `high` (outside): Newton, kept in the bracket by bisection.
    fn root(&self, from: P3, direction: V3, [mut low, mut high]: [f64; 2]) -> f64 {
        let mut t = 0.5 * (low + high);
        for _ in 0..40 {
            let (f, g) = self.domain.field.gradient(from + direction * t);
            if f > 0.0 {
                low = t
            } else {
                high = t
            }
            let newton = t - f / g.dot(direction);
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            let done = (next - t).abs() <= 1e-5 * self.spacing_mm;
            t = next;
            if done {
                break;
            }
        }
        t
    }

    /// Radius of the largest sphere about a point that f = 0 leaves free (cut planes do not bound it), mm: rays over
    /// the sphere, then the nearest wall point refined on f. `None` outside the lumen or where no wall is met.
    pub fn inscribed(&self, x: P3) -> Option<f64> {
        if self.domain.field.value(x) <= 0.0 {
            return None;
        }
        let uncut = Lumen { domain: Domain { cuts: &[], ..self.domain }, ..*self };
        let mut best: Option<(f64, P3)> = None;
        for direction in sphere_directions() {
            let reach = best.map_or(self.limit_mm, |(r, _)| r);
            if let Hit::Wall(t) = uncut.ray(x, direction, reach) {
                best = best.filter(|(r, _)| *r <= t).or(Some((t, x + direction * t)));
            }
        }
        best.map(|(r, wall)| r.min(self.nearest_wall(x, wall)))
    }

    /// Inscribed radius at the point of a section, from the section's nearest outline points.
    pub(crate) fn inscribed_from(&self, x: P3, near: [P3; 2]) -> f64 {
        near.into_iter().map(|q| self.nearest_wall(x, q)).fold(f64::INFINITY, f64::min)
    }

    /// Distance from `x` to the wall near the wall point `q`: foot points on the tangent planes, back on f = 0 by
    /// Newton (Hartmann 1999); the smallest distance met is returned, so that it never exceeds |x - q|.
    fn nearest_wall(&self, x: P3, q: P3) -> f64 {
        let (mut q, mut best) = (q, x.distance(q));
        for _ in 0..6 {
            let (_, g) = self.domain.field.gradient(q);
            let Some(normal) = g.normalised() else { break };
            let mut foot = x - normal * (x - q).dot(normal);
            for _ in 0..4 {
                let (f, g) = self.domain.field.gradient(foot);
                let square = g.length_squared();
                if square < 1e-12 {
                    return best;
                }
                foot = foot - g * (f / square);
                if f.abs() < 1e-7 * self.spacing_mm {
                    break;
                }
            }
            let d = x.distance(foot);
            if !d.is_finite() || d >= best - 1e-7 * self.spacing_mm {
                return if d.is_finite() { best.min(d) } else { best };
            }
            (q, best) = (foot, d);
        }
        best
    }

    /// The section through `x` normal to `tangent` (unit), by `rays` rays: closed, star-shaped about `x` as far as the
    /// rays see, not leaking; else `None`. Area and centroid are exact Fourier sums of the polar outline.
    pub(crate) fn section(&self, x: P3, tangent: V3, settings: &Settings) -> Option<Section> {
        let n = settings.rays;
        let u = tangent.any_orthonormal();
        let v = tangent.cross(u);
        let mut polar = Vec::with_capacity(n);
        for i in 0..n {
            let (sin, cos) = (TAU * i as f64 / n as f64).sin_cos();
            match self.ray(x, u * cos + v * sin, self.limit_mm) {
                Hit::Wall(rho) if rho > 0.0 => polar.push((rho, u * cos + v * sin)),
                _ => return None,
            }
        }
        // A = 1/2 int rho^2, centroid = 1/3 int rho^3 (cos, sin) / A
        let weight = TAU / n as f64;
        let area = polar.iter().fold(0.0, |a, (rho, _)| a + 0.5 * weight * rho * rho);
        let moment = polar.iter().fold(V3::ZERO, |m, (rho, d)| m + *d * (weight * rho.powi(3) / 3.0));
        let centre = x + moment / area;
        let outline: Vec<P3> = polar.iter().map(|(rho, d)| x + *d * *rho).collect();
        if leaks(&outline, centre) {
            return None;
        }
        let nearest = (0..n).min_by(|&a, &b| polar[a].0.total_cmp(&polar[b].0))?;
        let other = (n / 4..n - n / 4).map(|i| (nearest + i) % n).min_by(|&a, &b| polar[a].0.total_cmp(&polar[b].0))?;
        Some(Section { centre, area, near: [outline[nearest], outline[other]] })
    }
}

/// Whether an outline's radii about its centroid are too unequal, or jump between neighbours.
fn leaks(outline: &[P3], centre: P3) -> bool {
    let n = outline.len();
    let radii: Vec<f64> = outline.iter().map(|p| p.distance(centre)).collect();
    let (low, high) = radii.iter().fold((f64::INFINITY, 0.0_f64), |(l, h), &r| (l.min(r), h.max(r)));
    let jump = RADIUS_JUMP.powf((64.0 / n as f64).max(1.0));
    let jumps = (0..n).any(|i| {
        let (a, b) = (radii[i], radii[(i + 1) % n]);
        a.max(b) > jump * a.min(b)
    });
    high > LONGEST_RADIUS * low || jumps
}

/// Evenly spread unit vectors (a Fibonacci lattice).
fn sphere_directions() -> impl Iterator<Item = V3> {
    let golden = TAU * (1.0 - 1.0 / 1.618_033_988_749_895);
    (0..SPHERE).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / SPHERE as f64;
        let (sin, cos) = (golden * i as f64).sin_cos();
        let r = (1.0 - z * z).sqrt();
        V3::new(r * cos, r * sin, z)
    })
}
