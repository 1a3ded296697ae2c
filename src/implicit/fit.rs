//! The variational implicit function f(x) = sum c_i |x - x_i|^3 + p0 + p.x (Giordana et al., eq. 3), fitted in two passes.
//!
//! The first pass takes its interior points along the planar normals of the curves, the second along the gradient of the
//! first function: for oblique vessels a planar normal is wrong by the vessel's angle against the slice.
//!
//! Smoothing. Exact interpolation of noisy contours breaks the shape (2 of 3 cases failed at .2 mm noise). Every
//! constraint carries its standard error sigma_i; the fit is the posterior mean of a random field with generalised
//! covariance s |x - x'|^3 and noise sigma_i^2, so that lambda_i = sigma_i^2 / s. The one unknown, s, maximises the
//! restricted likelihood of clusters of neighbouring constraints. Nothing is tuned by hand.

use crate::conjugate::{Coefficients, Solution};
use crate::constraints::{self, Constraints};
use crate::ensemble::{self, Ensemble};
use crate::interpolate::{Problem, solved};
use crate::roughness::roughness;
use crate::system::Scale;
use crate::variational::Variational;
use crate::{Error, Field, Method, Settings};
use exec::Ctx;
use imaging::Contours;
use space::P3;

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
    /// Estimated 2-norm condition of the projected system, to a factor of about 2.
    pub condition: f64,
    /// Iterations of conjugate gradients in the final pass; 0 where the dense factor was taken.
    pub iterations: usize,
    /// Smallest and largest offset of interior points, mm.
    pub offset_mm: [f64; 2],
    /// |sum c_i| and |sum c_i x_i| (normalised coordinates) over sum |c_i|: 0 in exact arithmetic.
    pub side_conditions: f64,
    /// Largest error of the linear system by an independent sum, mm.
    pub solve_error_mm: f64,
}

/// Residual on the wall beyond this many standard errors (and [`RESIDUAL_PX`]) makes the fit a fault: 8 sigma does not
/// happen by noise among 10^4 constraints.
const RESIDUAL_SIGMA: f64 = 8.0;
/// See [`RESIDUAL_SIGMA`]: below this many pixels a residual never is a fault.
const RESIDUAL_PX: f64 = 3.0;

/// Fit the function to contours.
///
/// Guarantees f = 0 on the wall up to the residuals in the report and f > 0 inside near the wall. Does not guarantee
/// anything past the data's ends. Cost: two solutions (see [`crate::Method`]).
///
/// # Errors
/// [`Error::TooFewPoints`], [`Error::Coplanar`], [`Error::TooMany`], [`Error::Singular`], [`Error::Stalled`],
/// [`Error::Residual`], [`Error::Cancelled`].
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
    let (first, ..) = solve(&planar, contours, (settings, FIRST_MM, 0), &ctx.part(0.0, 0.4))?;
    let normal = |x: P3| first.gradient(x).1.normalised();
    let wall = corrected(&planar, &first, contours, ctx)?;
    let spatial = constraints::spatial(&planar, wall, normal, |x| first.value(x) > 0.0);
    solve(&spatial, contours, (settings, FINAL_MM, draws), &ctx.part(0.4, 1.0))
}

/// Wall points whose planar half-maximum correction is replaced by the one in space: where a contour was drawn, the first
/// function has the level whose blurred image has its half-maximum there, and the wall lies where that level is
/// ([`imaging::Blur::half_maximum_level`]).
fn corrected(c: &Constraints, first: &Variational, contours: &Contours, ctx: &Ctx) -> Result<Vec<P3>, Error> {
    Ok(ctx.map_range(c.wall, |i| {
        let x = c.points[i];
        let (Some(blur), Some(applied)) = (contours.blur, c.planar_shift[i]) else { return x };
        let drawn = x - applied;
        let (value, g) = first.gradient(drawn);
        let slope = g.length_squared();
        let level = blur.half_maximum_level(drawn, |y| first.hessian(y));
        let moved = level.map(|level| drawn + g * ((level - value) / slope));
        // an expansion that leads farther than the blur itself reaches has met another wall
        moved.filter(|m| m.distance(drawn) <= blur.reach_mm()).unwrap_or(x)
    })?)
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

/// Largest true residual of the first pass, mm: it gives normals only, and 1e-6 mm turns none by more than 1e-5.
const FIRST_MM: f64 = 1e-6;
/// Largest true residual of the final pass, mm: 1e-9 keeps f the same to 1e-8 under rigid motion, reversal and
/// permutation. Rounding leaves 1e-11 of noisy contours, and up to 1e-8 of 12,000 noise-free ones.
const FINAL_MM: f64 = 1e-9;
/// Beyond this residual a fit is refused, mm: a hundredth of what the best contours err. A real aorta with 36,297
/// constraints, whose errors differ by a factor of a thousand, stayed at 2e-5.
const ACCEPTED_MM: f64 = 1e-4;

fn solve(
    c: &Constraints,
    contours: &Contours,
    (settings, tolerance, draws): (&Settings, f64, usize),
    ctx: &Ctx,
) -> Result<(Variational, FitReport, Ensemble), Error> {
    let scale = Scale::of(&c.points);
    let points: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
    let s = roughness(c, &points, &scale, ctx)?;
    let noise: Vec<f64> = c.sigma_mm.iter().map(|e| e * e / s).collect();
    ctx.progress(0.1);
    let problem = Problem { points: &points, noise: &noise, values: &c.values, tolerance: [tolerance, ACCEPTED_MM] };
    let share = if draws == 0 { 1.0 } else { 0.5 };
    let compute = || {
        let (solution, solver) = solved(&problem, settings.method, &ctx.part(0.1, share))?;
        accept(c, &noise, &solution.coefficients, contours)?;
        let drawn = ensemble::solved(c, &solver, (scale, s), draws, &ctx.part(share, 1.0))?;
        Ok::<_, Error>(packed(&solution, &drawn))
    };
    let key = key(c, (scale, s, &noise), (settings.method, tolerance, draws));
    let key: Vec<&[f64]> = key.iter().map(Vec::as_slice).collect();
    let known = ctx.recalled("fit", &key, compute)?;
    let (solution, drawn) = unpacked(&known, c.points.len(), draws);
    let report = report(c, &noise, &points, &solution);
    accept(c, &noise, &solution.coefficients, contours)?;
    let ensemble = Ensemble::of(c, (scale, s), drawn);
    let f = Variational::new(c.points.clone(), scale, &solution)?.with_constraints(c.wall, c.interior.len());
    Ok((f, report, ensemble))
}

/// All that a solution and its draws depend on.
fn key(
    c: &Constraints,
    (scale, s, noise): (Scale, f64, &[f64]),
    (method, tolerance, draws): (Method, f64, usize),
) -> [Vec<f64>; 10] {
    [
        [&scale.numbers()[..], &[s, c.wall as f64, f64::from(method as u8), tolerance, draws as f64]].concat(),
        c.points.iter().flat_map(|p| p.to_array()).collect(),
        noise.to_vec(),
        c.values.clone(),
        c.sigma_mm.clone(),
        c.level_mm.clone(),
        c.freedom.clone(),
        c.correction_mm.clone(),
        c.curve.iter().map(|curve| curve.map_or(-1.0, |k| k as f64)).collect(),
        c.interior.iter().flat_map(|(wall, offset)| [*wall as f64, *offset]).collect(),
    ]
}

/// A solution and its draws as one list: condition, iterations, polynomial, coefficients, errors, then each draw's polynomial and
/// coefficients.
fn packed(solution: &Solution, drawn: &[Coefficients]) -> Vec<f64> {
    let mut out = vec![solution.condition, solution.iterations as f64];
    out.extend(solution.polynomial);
    out.extend(&solution.coefficients);
    out.extend(&solution.errors);
    for (coefficients, polynomial) in drawn {
        out.extend(polynomial);
        out.extend(coefficients);
    }
    out
}

/// The reverse of [`packed`], for `n` constraints. Whoever keeps lists answers for
/// their being whole ([`exec::Recall`]).
fn unpacked(list: &[f64], n: usize, draws: usize) -> (Solution, Vec<Coefficients>) {
    let mut rest = list.iter().copied();
    let mut take = |count: usize| -> Vec<f64> { (0..count).map(|_| rest.next().unwrap_or(0.0)).collect() };
    let head = take(2);
    let polynomial = |list: Vec<f64>| [list[0], list[1], list[2], list[3]];
    let solution = Solution {
        condition: head[0],
        iterations: head[1] as usize,
        polynomial: polynomial(take(4)),
        coefficients: take(n),
        errors: take(n),
    };
    let drawn = (0..draws).map(|_| {
        let polynomial = polynomial(take(4));
        (take(n), polynomial)
    });
    let drawn = drawn.collect();
    (solution, drawn)
}

fn report(c: &Constraints, noise: &[f64], points: &[[f64; 3]], solution: &Solution) -> FitReport {
    let coefficients = &solution.coefficients;
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
        condition: solution.condition,
        iterations: solution.iterations,
        offset_mm: [offsets.clone().fold(f64::INFINITY, f64::min), offsets.fold(0.0, f64::max)],
        side_conditions: side,
        solve_error_mm: solution.errors.iter().fold(0.0, |m, r| m.max(r.abs())),
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
