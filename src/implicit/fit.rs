//! The variational implicit function f(x) = sum c_i |x - x_i|^3 + p0 + p.x (Giordana et al., eq. 3), fitted in two passes.
//!
//! The first pass takes its interior points along the planar normals of the curves, the second along the gradient of the
//! first function: for oblique vessels a planar normal is wrong by the vessel's angle against the slice.
//!
//! Smoothing. Exact interpolation of noisy contours breaks the shape (2 of 3 cases failed at .2 mm noise). Every
//! constraint carries its standard error sigma_i; the fit is the posterior mean of a random field with generalised
//! covariance s |x - x'|^3 and noise sigma_i^2, so that lambda_i = sigma_i^2 / s. The one unknown, s, maximises the
//! restricted likelihood of clusters of neighbouring constraints. Nothing is tuned by hand.

use crate::constraints::{self, Constraints};
use crate::ensemble::Ensemble;
use crate::kernel::Centres;
use crate::system::{Factor, Scale, residual};
use crate::{Error, Field, Settings};
use exec::Ctx;
use imaging::Contours;
use space::{Aabb, DMat3, DVec3, P3, Patient, V3};

/// The fitted function with its constraints.
#[derive(Clone, Debug)]
pub struct Variational {
    centres: Centres,
    polynomial: [f64; 4],
    scale: Scale,
    bounds: Aabb<Patient>,
    wall: Vec<P3>,
    inner: Vec<P3>,
}

/// What the fit says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct FitReport {
    /// Constraints of the final system.
    pub constraints: usize,
    /// Of these, on the wall.
    pub wall: usize,
    /// Mean lambda of the wall constraints in normalised coordinates (the farthest constraint at distance 1).
    pub smoothing: f64,
    /// Largest |f| at a wall constraint, mm.
    pub residual_max_mm: f64,
    /// Root mean square of f at the wall constraints, mm.
    pub residual_rms_mm: f64,
    /// Estimated 2-norm condition of the projected system.
    pub condition: f64,
    /// Smallest and largest offset of interior points, mm.
    pub offset_mm: [f64; 2],
    /// |sum c_i| and |sum c_i x_i| (normalised coordinates) over sum |c_i|: 0 in exact arithmetic.
    pub side_conditions: f64,
    /// Largest error of the linear system by an independent sum, mm.
    pub solve_error_mm: f64,
}

impl Variational {
    /// Constraint points on the wall: they seed the polygoniser.
    pub fn wall(&self) -> &[P3] {
        &self.wall
    }
    /// Constraint points inside the lumen: they seed the voxeliser.
    pub fn inner(&self) -> &[P3] {
        &self.inner
    }
}

/// Residual on the wall beyond this many standard errors (and [`RESIDUAL_PX`]) makes the fit a fault: 8 sigma does not
/// happen by noise among 10^4 constraints.
const RESIDUAL_SIGMA: f64 = 8.0;
/// See [`RESIDUAL_SIGMA`]: below this many pixels a residual never is a fault.
const RESIDUAL_PX: f64 = 3.0;

/// Fit the function to contours.
///
/// Guarantees f = 0 on the wall up to the residuals in the report and f > 0 inside near the wall. Does not guarantee
/// anything past the data's ends. Cost: two Cholesky factorisations of n^3 / 3 operations and 8 n^2 bytes.
///
/// # Errors
/// [`Error::TooFewPoints`], [`Error::Coplanar`], [`Error::TooMany`], [`Error::Singular`], [`Error::Residual`],
/// [`Error::Cancelled`].
pub fn fit(contours: &Contours, settings: &Settings, ctx: &Ctx) -> Result<(Variational, FitReport), Error> {
    let (f, report, _) = fit_with_ensemble(contours, settings, 0, ctx)?;
    Ok((f, report))
}

/// [`fit`] with `draws` functions that the data allow as well, for error bands. Each costs one more solve with the factor.
///
/// # Errors
/// As [`fit`].
pub fn fit_with_ensemble(
    contours: &Contours,
    settings: &Settings,
    draws: usize,
    ctx: &Ctx,
) -> Result<(Variational, FitReport, Ensemble), Error> {
    let planar = constraints::planar(contours, settings);
    guard(&planar, settings)?;
    let (first, ..) = solve(&planar, contours, 0, &ctx.part(0.0, 0.5))?;
    let normal = |x: P3| first.gradient(x).1.normalised();
    let spatial = constraints::spatial(&planar, normal, |x| first.value(x) > 0.0);
    solve(&spatial, contours, draws, &ctx.part(0.5, 1.0))
}

fn guard(c: &Constraints, settings: &Settings) -> Result<(), Error> {
    const LEAST: usize = 20;
    if c.wall < LEAST {
        return Err(Error::TooFewPoints { points: c.wall, least: LEAST });
    }
    if c.points.len() > 2 * settings.max_constraints {
        return Err(Error::TooMany { constraints: c.points.len(), limit: settings.max_constraints });
    }
    Ok(())
}

fn solve(
    c: &Constraints,
    contours: &Contours,
    draws: usize,
    ctx: &Ctx,
) -> Result<(Variational, FitReport, Ensemble), Error> {
    let scale = Scale::of(&c.points);
    let points: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
    let s = roughness(c, &points, ctx)?;
    let noise: Vec<f64> = c.sigma_mm.iter().map(|e| e * e / s).collect();
    ctx.progress(0.1);
    let factor = Factor::new(&points, &noise, ctx)?;
    ctx.progress(0.8);
    let (mut coefficients, mut polynomial) = factor.solve(&c.values);
    // one step of refinement: the factor's own rounding is the largest error left
    let r = residual(&points, &noise, &c.values, (&coefficients, &polynomial), ctx)?;
    let (dc, db) = factor.solve(&r);
    coefficients.iter_mut().zip(&dc).for_each(|(c, d)| *c += d);
    polynomial.iter_mut().zip(&db).for_each(|(b, d)| *b += d);
    let r = residual(&points, &noise, &c.values, (&coefficients, &polynomial), ctx)?;
    let ensemble = Ensemble::new(c, &factor, (scale, s), draws, ctx)?;
    ctx.progress(1.0);
    let report = report(c, &noise, &coefficients, (&points, &r, factor.condition()));
    accept(c, &noise, &coefficients, contours)?;
    let bounds = Aabb::around(c.points.iter().copied()).ok_or(Error::TooFewPoints { points: 0, least: 1 })?;
    let centres = Centres::new(&points, &coefficients);
    let inner = (0..c.interior.len()).map(|k| c.points[c.wall + k]).collect();
    let wall = c.points[..c.wall].to_vec();
    Ok((Variational { centres, polynomial, scale, bounds: bounds.grown(2.0), wall, inner }, report, ensemble))
}

fn report(
    c: &Constraints,
    noise: &[f64],
    coefficients: &[f64],
    (points, errors, condition): (&[[f64; 3]], &[f64], f64),
) -> FitReport {
    // y - f(x_i) = lambda_i c_i
    let misses: Vec<f64> = (0..c.wall).map(|i| noise[i] * coefficients[i]).collect();
    let total = coefficients.iter().fold(f64::MIN_POSITIVE, |s, c| s + c.abs());
    let side = (0..4).fold(0.0_f64, |m, a| {
        let sum = points.iter().zip(coefficients).fold(0.0, |s, (p, c)| s + c * if a == 0 { 1.0 } else { p[a - 1] });
        m.max(sum.abs() / total)
    });
    let offsets = c.interior.iter().map(|o| o.1);
    FitReport {
        constraints: c.points.len(),
        wall: c.wall,
        smoothing: noise[..c.wall].iter().fold(0.0, |s, x| s + x) / c.wall as f64,
        residual_max_mm: misses.iter().fold(0.0, |m, r| m.max(r.abs())),
        residual_rms_mm: (misses.iter().fold(0.0, |s, r| s + r * r) / c.wall as f64).sqrt(),
        condition,
        offset_mm: [offsets.clone().fold(f64::INFINITY, f64::min), offsets.fold(0.0, f64::max)],
        side_conditions: side,
        solve_error_mm: errors.iter().fold(0.0, |m, r| m.max(r.abs())),
    }
}

/// Refuse a function that misses wall points of its own data.
fn accept(c: &Constraints, noise: &[f64], coefficients: &[f64], contours: &Contours) -> Result<(), Error> {
    for i in 0..c.wall {
        let Some(curve) = c.curve[i] else { continue };
        let miss = (noise[i] * coefficients[i]).abs();
        let bound = (RESIDUAL_SIGMA * c.sigma_mm[i]).max(RESIDUAL_PX * contours.pixel_mm);
        if miss > bound {
            let curve = &contours.curves[curve];
            let mut place = space::Place::contour(contours.planes[curve.plane].index, curve.lumen);
            place.position = Some(c.points[i]);
            return Err(Error::Residual { residual_mm: miss, bound_mm: bound, place });
        }
    }
    Ok(())
}

/// Clusters and their size for the likelihood: 6 clusters of 250 give log s to about +-.2, which moves the surface by
/// less than a tenth of its own error.
const CLUSTERS: usize = 6;
const CLUSTER_SIZE: usize = 250;

/// The scale s of the random field (mm^2 in normalised coordinates) of largest restricted likelihood.
fn roughness(c: &Constraints, points: &[[f64; 3]], ctx: &Ctx) -> Result<f64, Error> {
    let clusters = clusters(points, c.wall);
    // s of a wall that bends with a radius of about 1 mm to 1 m, in normalised coordinates
    let candidates: Vec<f64> = (0..22).map(|k| 10f64.powf(-1.0 + 0.5 * k as f64)).collect();
    let likelihoods = candidates
        .iter()
        .map(|&s| cluster_likelihood(c, points, &clusters, s, ctx))
        .collect::<Result<Vec<f64>, Error>>()?;
    let best = (0..candidates.len()).fold(0, |b, k| if likelihoods[k] > likelihoods[b] { k } else { b });
    Ok(parabola_peak(&candidates, &likelihoods, best))
}

/// Sum of the clusters' likelihoods at scale s.
fn cluster_likelihood(
    c: &Constraints,
    points: &[[f64; 3]],
    clusters: &[Vec<usize>],
    s: f64,
    ctx: &Ctx,
) -> Result<f64, Error> {
    let mut sum = 0.0;
    for cluster in clusters {
        let p: Vec<[f64; 3]> = cluster.iter().map(|&i| points[i]).collect();
        let d: Vec<f64> = cluster.iter().map(|&i| c.sigma_mm[i].powi(2) / s).collect();
        let y: Vec<f64> = cluster.iter().map(|&i| c.values[i]).collect();
        match Factor::new(&p, &d, ctx) {
            Ok(factor) => sum += factor.log_likelihood(&y, s),
            Err(Error::Cancelled) => return Err(Error::Cancelled),
            // a cluster within one plane says nothing; a singular one rules the candidate out
            Err(Error::Coplanar { .. }) => {}
            Err(_) => return Ok(f64::NEG_INFINITY),
        }
    }
    Ok(sum)
}

/// Peak of the parabola through the best candidate and its neighbours, on the log scale.
fn parabola_peak(candidates: &[f64], values: &[f64], best: usize) -> f64 {
    if best == 0 || best + 1 == candidates.len() {
        return candidates[best];
    }
    let (a, b, c) = (values[best - 1], values[best], values[best + 1]);
    let bend = a - 2.0 * b + c;
    let shift = if bend.is_finite() && bend < 0.0 { (0.5 * (a - c) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    candidates[best] * (candidates[best + 1] / candidates[best]).powf(shift)
}

/// Constraints nearest to evenly chosen wall points.
fn clusters(points: &[[f64; 3]], wall: usize) -> Vec<Vec<usize>> {
    let count = CLUSTERS.min(wall);
    (0..count)
        .map(|k| {
            let centre = points[(2 * k + 1) * wall / (2 * count)];
            let distance =
                |i: usize| (0..3).fold(0.0, |s, a| s + (points[i][a] - centre[a]) * (points[i][a] - centre[a]));
            let mut order: Vec<usize> = (0..points.len()).collect();
            order.sort_by(|&i, &j| distance(i).total_cmp(&distance(j)).then(i.cmp(&j)));
            order.truncate(CLUSTER_SIZE);
            order
        })
        .collect()
}

impl Field for Variational {
    fn value(&self, x: P3) -> f64 {
        let mut out = [0.0];
        self.values(&[x], &mut out);
        out[0]
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let t = self.scale.apply(x);
        let (f, g) = self.centres.gradient(t);
        let b = &self.polynomial;
        (f + self.linear(t), self.scale.gradient([g[0] + b[1], g[1] + b[2], g[2] + b[3]]))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let t = self.scale.apply(x);
        let (f, g, h) = self.centres.hessian(t);
        let b = &self.polynomial;
        let [xx, yy, zz, xy, xz, yz] = h.map(|h| h / (self.scale.length * self.scale.length));
        let matrix = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
        (f + self.linear(t), self.scale.gradient([g[0] + b[1], g[1] + b[2], g[2] + b[3]]), matrix)
    }
    fn values(&self, xs: &[P3], out: &mut [f64]) {
        let targets: Vec<[f64; 3]> = xs.iter().map(|&x| self.scale.apply(x)).collect();
        self.centres.values(&targets, out);
        for (o, t) in out.iter_mut().zip(&targets) {
            *o += self.linear(*t);
        }
    }
    fn bounds(&self) -> Aabb<Patient> {
        self.bounds
    }
}

impl Variational {
    fn linear(&self, t: [f64; 3]) -> f64 {
        let b = &self.polynomial;
        b[0] + b[1] * t[0] + b[2] * t[1] + b[3] * t[2]
    }
}
