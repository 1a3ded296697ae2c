//! A field as a 3D image: values on a lattice, read back through a tricubic B-spline (C2, fourth order).
//!
//! The variational function costs one kernel sum of thousands of terms per value; its samples cost 64 products. Samples
//! are taken exactly in a band around the wall and interpolated from a lattice four times coarser elsewhere, where they
//! only feed the tails of the Gaussian: 10 to 20 times fewer kernel sums than the full lattice.

use crate::filter::{Rows, Spans, to_coefficients, twiced};
use crate::{Error, Field};
use exec::{Cancelled, Ctx};
use space::{Aabb, DMat3, DVec3, Grid, P3, Patient, V3};
use std::sync::Arc;

/// Lattice steps per coarse step.
const COARSE: usize = 4;

/// How to sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampledSettings {
    /// Lattice spacing, mm; up to twice as much where the lattice would have too many points.
    pub spacing_mm: f64,
    /// Half-width of the band of exact samples, mm.
    pub band_mm: f64,
    /// Most lattice points; if twice the spacing has more: [`Error::TooManySamples`]. 40 million take 320 MB.
    pub max_points: usize,
}

impl Default for SampledSettings {
    fn default() -> Self {
        Self { spacing_mm: 0.25, band_mm: 2.0, max_points: 40_000_000 }
    }
}

/// A field on a lattice. Outside the lattice the value falls off with the distance to it.
#[derive(Clone, Debug)]
pub struct Sampled {
    grid: Grid,
    origin: P3,
    spacing: f64,
    /// Of the field as it was sampled, x fastest.
    coefficients: Arc<Vec<f64>>,
    /// Where samples are exact, by rows along x.
    band: Arc<Spans>,
    /// Coefficients that stand in the band instead.
    smoothed: Option<Arc<Rows>>,
}

impl Sampled {
    /// Sample `field` around wall points (which must lie closer to each other than the band is wide).
    ///
    /// # Errors
    /// [`Error::TooFewPoints`] without wall points, [`Error::TooManySamples`], [`Error::Cancelled`].
    pub fn new(field: &dyn Field, wall: &[P3], settings: &SampledSettings, ctx: &Ctx) -> Result<Self, Error> {
        let (grid, settings) = &fitting(wall, settings)?;
        let mut values = coarse_values(field, grid, ctx)?;
        let near = near_points(grid, wall, settings);
        let points: Vec<P3> = near.iter().map(|&i| position(grid, i)).collect();
        for (&i, v) in near.iter().zip(values_at(field, &points, ctx)?) {
            values[i] = v;
        }
        to_coefficients(&mut values, grid.size, ctx)?;
        let grid = *grid;
        let (origin, spacing) = (grid.point(0, 0, 0), settings.spacing_mm);
        let band = Arc::new(Spans::around(&near, grid.size));
        Ok(Self { grid, origin, spacing, coefficients: Arc::new(values), band, smoothed: None })
    }

    /// The lattice.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The field as it was sampled, smoothed by 2 G - G*G, G the Gaussian of standard deviation `sigma_mm` (see
    /// [`crate::smooth`]). Only the band is smoothed: farther from the wall the image is coarse and guides no more.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub fn smoothed(&self, sigma_mm: f64, ctx: &Ctx) -> Result<Self, Error> {
        let t = (sigma_mm / self.spacing).powi(2);
        let rows = twiced(&self.coefficients, self.grid.size, &self.band, t, ctx)?;
        Ok(Self { smoothed: Some(Arc::new(rows)), ..self.clone() })
    }

    /// Lattice coordinates of a point moved into the lattice, and the distance moved, mm.
    fn locate(&self, x: P3) -> (DVec3, f64) {
        let u = (x - self.origin).raw() / self.spacing;
        let last = DVec3::from_array(self.grid.size.map(|n| n as f64 - 1.0));
        let inside = u.clamp(DVec3::ONE, last - DVec3::splat(2.0 + 1e-9));
        (inside, (u - inside).length() * self.spacing)
    }

    /// Four coefficients along x from (i, j, k).
    #[inline]
    fn four(&self, i: usize, j: usize, k: usize) -> &[f64] {
        let row = j + self.grid.size[1] * k;
        let at = i + self.grid.size[0] * row;
        self.smoothed.as_ref().and_then(|s| s.four(row, i)).unwrap_or(&self.coefficients[at..at + 4])
    }

    /// Sum over the 4 x 4 x 4 coefficients with the given weights per axis.
    fn weigh(&self, base: [usize; 3], wx: &[f64; 4], wy: &[f64; 4], wz: &[f64; 4]) -> f64 {
        let mut sum = 0.0;
        for (k, wz) in wz.iter().enumerate() {
            for (j, wy) in wy.iter().enumerate() {
                let c = self.four(base[0], base[1] + j, base[2] + k);
                sum += wz * wy * (wx[0] * c[0] + wx[1] * c[1] + wx[2] * c[2] + wx[3] * c[3]);
            }
        }
        sum
    }
}

impl Field for Sampled {
    fn value(&self, x: P3) -> f64 {
        let (u, moved) = self.locate(x);
        let (base, t) = split(u);
        let w = [basis(t[0]), basis(t[1]), basis(t[2])];
        self.weigh(base, &w[0], &w[1], &w[2]) - moved
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let (u, moved) = self.locate(x);
        let (base, t) = split(u);
        let w = t.map(basis);
        let d = t.map(slope);
        let g = V3::new(
            self.weigh(base, &d[0], &w[1], &w[2]),
            self.weigh(base, &w[0], &d[1], &w[2]),
            self.weigh(base, &w[0], &w[1], &d[2]),
        );
        (self.weigh(base, &w[0], &w[1], &w[2]) - moved, g / self.spacing)
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        let (u, _) = self.locate(x);
        let (base, t) = split(u);
        let (w, d, s) = (t.map(basis), t.map(slope), t.map(bend));
        let scale = 1.0 / (self.spacing * self.spacing);
        let xx = self.weigh(base, &s[0], &w[1], &w[2]) * scale;
        let yy = self.weigh(base, &w[0], &s[1], &w[2]) * scale;
        let zz = self.weigh(base, &w[0], &w[1], &s[2]) * scale;
        let xy = self.weigh(base, &d[0], &d[1], &w[2]) * scale;
        let xz = self.weigh(base, &d[0], &w[1], &d[2]) * scale;
        let yz = self.weigh(base, &w[0], &d[1], &d[2]) * scale;
        (f, g, DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz)))
    }
    fn bounds(&self) -> Aabb<Patient> {
        let [i, j, k] = self.grid.size;
        Aabb { min: self.grid.point(2, 2, 2), max: self.grid.point(i - 4, j - 4, k - 4) }
    }
}

/// Base index of the four coefficients and the fraction within the cell, per axis.
fn split(u: DVec3) -> ([usize; 3], [f64; 3]) {
    let cell = u.floor();
    let base = cell.to_array().map(|c| c as usize - 1);
    (base, (u - cell).to_array())
}

/// Cubic B-spline weights.
fn basis(t: f64) -> [f64; 4] {
    let s = 1.0 - t;
    [
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    ]
}

/// Their first derivatives.
fn slope(t: f64) -> [f64; 4] {
    let s = 1.0 - t;
    [-0.5 * s * s, t * (1.5 * t - 2.0), s * (2.0 - 1.5 * s), 0.5 * t * t]
}

/// Their second derivatives.
fn bend(t: f64) -> [f64; 4] {
    [1.0 - t, 3.0 * t - 2.0, 1.0 - 3.0 * t, t]
}

/// Growth of the spacing before a lattice is refused: at twice half a pixel it still has a point for every pixel.
const COARSEST: f64 = 2.0;

/// The lattice, with the spacing that keeps it within its limit.
fn fitting(wall: &[P3], settings: &SampledSettings) -> Result<(Grid, SampledSettings), Error> {
    let mut fitting = *settings;
    loop {
        match lattice(wall, &fitting) {
            Err(Error::TooManySamples { .. }) if fitting.spacing_mm < COARSEST * settings.spacing_mm => {
                fitting.spacing_mm = (1.1 * fitting.spacing_mm).min(COARSEST * settings.spacing_mm);
            }
            lattice => return lattice.map(|grid| (grid, fitting)),
        }
    }
}

/// A lattice around the wall points with the band's margin, its size a multiple of the coarse step plus one.
fn lattice(wall: &[P3], settings: &SampledSettings) -> Result<Grid, Error> {
    let bounds = Aabb::around(wall.iter().copied()).ok_or(Error::TooFewPoints { points: 0, least: 1 })?;
    let mut grid = Grid::covering(bounds.grown(settings.band_mm + 4.0 * settings.spacing_mm), settings.spacing_mm);
    grid.size = grid.size.map(|n| (n - 1).div_ceil(COARSE).max(2) * COARSE + 1);
    let points = grid.size.iter().try_fold(1_usize, |a, &n| a.checked_mul(n)).unwrap_or(usize::MAX);
    if points > settings.max_points {
        return Err(Error::TooManySamples { points, limit: settings.max_points });
    }
    Ok(grid)
}

fn position(grid: &Grid, index: usize) -> P3 {
    let [nx, ny, _] = grid.size;
    grid.point(index % nx, index / nx % ny, index / (nx * ny))
}

/// Values of the field at lattice points: the most costly thing of all, so that an earlier run's are taken.
fn values_at(field: &dyn Field, points: &[P3], ctx: &Ctx) -> Result<Vec<f64>, Cancelled> {
    let Some(numbers) = field.numbers() else { return field.values_of_many(points, ctx) };
    let flat: Vec<f64> = points.iter().flat_map(|p| p.to_array()).collect();
    ctx.recalled("values", &[&numbers, &flat], || field.values_of_many(points, ctx))
}

/// All lattice values by trilinear interpolation of every fourth one.
fn coarse_values(field: &dyn Field, grid: &Grid, ctx: &Ctx) -> Result<Vec<f64>, Error> {
    let n = grid.size.map(|n| (n - 1) / COARSE + 1);
    let points: Vec<P3> = (0..n[0] * n[1] * n[2])
        .map(|at| grid.point(at % n[0] * COARSE, at / n[0] % n[1] * COARSE, at / (n[0] * n[1]) * COARSE))
        .collect();
    let knots = values_at(field, &points, ctx)?;
    let coarse = |i: usize, j: usize, k: usize| knots[i + n[0] * (j + n[1] * k)];
    let mut values = vec![0.0; grid.len()];
    let cell = |i: usize, n: usize| {
        let c = (i / COARSE).min(n - 2);
        (c, (i - c * COARSE) as f64 / COARSE as f64)
    };
    ctx.chunks_mut(&mut values, grid.size[0], |first, line| {
        let row = first / grid.size[0];
        let ((j, v), (k, w)) = (cell(row % grid.size[1], n[1]), cell(row / grid.size[1], n[2]));
        for (i, o) in line.iter_mut().enumerate() {
            let (i, u) = cell(i, n[0]);
            let edge = |j, k| coarse(i, j, k) * (1.0 - u) + coarse(i + 1, j, k) * u;
            let face = |k| edge(j, k) * (1.0 - v) + edge(j + 1, k) * v;
            *o = face(k) * (1.0 - w) + face(k + 1) * w;
        }
    })?;
    Ok(values)
}

/// Lattice points of the coarse cells that come within the band of a wall point, ascending.
fn near_points(grid: &Grid, wall: &[P3], settings: &SampledSettings) -> Vec<usize> {
    let n = grid.size.map(|n| (n - 1) / COARSE + 1);
    let step = settings.spacing_mm * COARSE as f64;
    let mut near = vec![false; n[0] * n[1] * n[2]];
    let origin = grid.point(0, 0, 0);
    for &p in wall {
        let u = (p - origin).to_array();
        let range = |a: usize| {
            let lo = ((u[a] - settings.band_mm) / step).floor().max(0.0) as usize;
            let hi = ((u[a] + settings.band_mm) / step).floor().max(0.0) as usize;
            lo..=hi.min(n[a] - 1)
        };
        for k in range(2) {
            for j in range(1) {
                for i in range(0) {
                    near[i + n[0] * (j + n[1] * k)] = true;
                }
            }
        }
    }
    (0..grid.len())
        .filter(|&index| {
            let [nx, ny, _] = grid.size;
            let (i, j, k) = (index % nx / COARSE, index / nx % ny / COARSE, index / (nx * ny) / COARSE);
            near[i + n[0] * (j + n[1] * k)]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::test_fields::Cylinder;

    fn sampled(spacing_mm: f64) -> (Cylinder, Sampled) {
        let cylinder = Cylinder { radius: 3.0 };
        let wall = cylinder.wall(8.0);
        let settings = SampledSettings { spacing_mm, band_mm: 2.0, ..SampledSettings::default() };
        let s = Sampled::new(&cylinder, &wall, &settings, &Ctx::new(2).unwrap()).unwrap();
        (cylinder, s)
    }

    #[test]
    fn samples_converge_with_the_fourth_order_in_value() {
        let error = |h| {
            let (c, s) = sampled(h);
            let check = (0..200).map(|i| P3::new(3.0 * (i as f64).cos(), 3.0 * (i as f64).sin(), 0.01 * i as f64));
            check.fold(0.0_f64, |m, p| m.max((s.value(p) - c.value(p)).abs()))
        };
        let (coarse, fine) = (error(0.5), error(0.25));
        assert!(fine < 5e-5, "{fine}");
        assert!(coarse / fine > 8.0, "{coarse} {fine}");
    }

    #[test]
    fn a_lattice_over_its_limit_gets_coarser_up_to_twice_and_is_refused_beyond() {
        let cylinder = Cylinder { radius: 3.0 };
        let wall = cylinder.wall(8.0);
        let points = sampled(0.25).1.grid().len();
        let within = |max_points| {
            let settings = SampledSettings { max_points, ..SampledSettings::default() };
            Sampled::new(&cylinder, &wall, &settings, &Ctx::new(1).unwrap())
        };
        let coarser = within(points / 2).unwrap();
        assert!(coarser.grid().len() <= points / 2 && coarser.spacing > 0.25 && coarser.spacing < 0.4);
        let on_the_wall = P3::new(3.0, 0.0, 1.0);
        assert!(coarser.value(on_the_wall).abs() < 5e-4);
        assert!(matches!(within(points / 20), Err(Error::TooManySamples { .. })));
    }

    #[test]
    fn derivatives_are_those_of_the_value() {
        let (_, s) = sampled(0.5);
        let x = P3::new(2.1, 1.7, 0.3);
        let (_, g, h) = s.hessian(x);
        let e = 1e-5;
        for (a, step) in [V3::X, V3::Y, V3::Z].into_iter().enumerate() {
            let (p, m) = (s.gradient(x + step * e), s.gradient(x - step * e));
            assert!(((p.0 - m.0) / (2.0 * e) - g.to_array()[a]).abs() < 1e-8);
            assert!(((p.1 - m.1).raw() / (2.0 * e) - h.col(a)).length() < 1e-6);
        }
    }

    #[test]
    fn twice_smoothing_keeps_a_cylinder_that_one_gaussian_shrinks() {
        let (_, s) = sampled(0.25);
        let ctx = Ctx::new(2).unwrap();
        let sigma: f64 = 0.75;
        let f = s.smoothed(sigma, &ctx).unwrap();
        let radius = crate::foot(&f, P3::new(2.9, 0.3, 0.1), 1.0).unwrap();
        let r = radius.x().hypot(radius.y());
        // t^2 / R^3 with t = sigma^2 / 2; one Gaussian would give sigma^2 / 2R = .094 mm
        assert!((r - 3.0).abs() < 1.5 * (0.5 * sigma * sigma).powi(2) / 27.0, "{r}");
    }
}
