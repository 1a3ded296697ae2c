//! One linear system, solved by the method that fits its size; and the plain interpolant of scattered values.

use crate::conjugate::{Coefficients, Iterative, Solution};
use crate::system::{Factor, Scale, residual};
use crate::variational::Variational;
use crate::{Error, Method};
use exec::Ctx;
use space::P3;

/// Up to here the dense factor is as fast as conjugate gradients, and it is the oracle.
const DENSE: usize = 1000;
/// Up to here the dense factor (512 MB, 6 CPU-s) answers where conjugate gradients stall.
const FALLBACK: usize = 8000;

/// Right-hand sides that share products: with eight the sums no longer fit the registers.
const TOGETHER: usize = 4;

/// A system in scaled coordinates: (K + D) c + P b = y, P'c = 0.
pub(crate) struct Problem<'a> {
    pub(crate) points: &'a [[f64; 3]],
    /// Diagonal of D.
    pub(crate) noise: &'a [f64],
    /// y.
    pub(crate) values: &'a [f64],
    /// Largest true residual wanted and largest that is accepted where rounding allows no better, in the unit of y.
    pub(crate) tolerance: [f64; 2],
}

/// A prepared system: solves for any right-hand side.
pub(crate) enum Solver<'a> {
    Dense { factor: Box<Factor>, points: &'a [[f64; 3]], noise: &'a [f64] },
    Iterative(Box<Iterative<'a>>),
}

impl<'a> Solver<'a> {
    fn dense(problem: &Problem<'a>, ctx: &Ctx) -> Result<Self, Error> {
        let factor = Box::new(Factor::new(problem.points, problem.noise, ctx)?);
        Ok(Self::Dense { factor, points: problem.points, noise: problem.noise })
    }

    fn iterative(problem: &Problem<'a>, ctx: &Ctx) -> Result<Self, Error> {
        Ok(Self::Iterative(Box::new(Iterative::new(problem.points, problem.noise, ctx)?)))
    }

    /// Solve for the values y. `tolerance` as in [`Problem`]; the dense factor always gives all that rounding allows.
    ///
    /// # Errors
    /// [`Error::Stalled`], [`Error::Cancelled`].
    pub(crate) fn solve(&self, values: &[f64], tolerance: [f64; 2], ctx: &Ctx) -> Result<Solution, Error> {
        match self {
            Self::Iterative(system) => system.solve(values, tolerance, ctx),
            Self::Dense { factor, points, noise } => refined(factor, points, (noise, values), ctx),
        }
    }

    /// Coefficients and polynomials for many values y, [`TOGETHER`] at a time, in order.
    ///
    /// # Errors
    /// As [`Solver::solve`].
    pub(crate) fn solve_many(
        &self,
        values: &[Vec<f64>],
        tolerance: [f64; 2],
        ctx: &Ctx,
    ) -> Result<Vec<Coefficients>, Error> {
        match self {
            Self::Iterative(system) => {
                let none = vec![0.0; values.first().map_or(0, Vec::len)];
                let together = |k: usize| {
                    let y = std::array::from_fn(|b| values.get(k * TOGETHER + b).unwrap_or(&none).as_slice());
                    system.solve_many::<TOGETHER>(y, tolerance, ctx)
                };
                let solved = ctx.map_range(values.len().div_ceil(TOGETHER), together)?;
                let solved = solved.into_iter().collect::<Result<Vec<_>, Error>>()?;
                Ok(solved.into_iter().flatten().take(values.len()).collect())
            }
            Self::Dense { factor, .. } => Ok(ctx.map(values, |y| factor.solve(y))?),
        }
    }
}

/// The solution by the method asked for, and what it was solved with.
///
/// # Errors
/// [`Error::Coplanar`], [`Error::Singular`], [`Error::Stalled`], [`Error::Cancelled`].
pub(crate) fn solved<'a>(problem: &Problem<'a>, method: Method, ctx: &Ctx) -> Result<(Solution, Solver<'a>), Error> {
    let n = problem.points.len();
    let by = |solver: Result<Solver<'a>, Error>, ctx: &Ctx| {
        let solver = solver?;
        Ok((solver.solve(problem.values, problem.tolerance, ctx)?, solver))
    };
    let dense = || by(Solver::dense(problem, &ctx.part(0.0, 0.9)), &ctx.part(0.9, 1.0));
    let iterative = || by(Solver::iterative(problem, &ctx.part(0.0, 0.3)), &ctx.part(0.3, 1.0));
    match method {
        Method::Dense => dense(),
        Method::Iterative => iterative(),
        Method::BySize if n <= DENSE => dense(),
        Method::BySize => match iterative() {
            Err(Error::Stalled { .. } | Error::Singular { .. }) if n <= FALLBACK => dense(),
            outcome => outcome,
        },
    }
}

/// The factor's solution after one step of refinement: the factor's own rounding is the largest error left.
fn refined(
    factor: &Factor,
    points: &[[f64; 3]],
    (noise, values): (&[f64], &[f64]),
    ctx: &Ctx,
) -> Result<Solution, Error> {
    let (mut coefficients, mut polynomial) = factor.solve(values);
    let r = residual(points, noise, values, (&coefficients, &polynomial), ctx)?;
    let (dc, db) = factor.solve(&r);
    coefficients.iter_mut().zip(&dc).for_each(|(c, d)| *c += d);
    polynomial.iter_mut().zip(&db).for_each(|(b, d)| *b += d);
    let errors = residual(points, noise, values, (&coefficients, &polynomial), ctx)?;
    ctx.progress(1.0);
    Ok(Solution { coefficients, polynomial, errors, iterations: 0, condition: factor.condition() })
}

/// What a solution says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct SolveReport {
    /// Iterations of conjugate gradients, 0 of the dense factor.
    pub iterations: usize,
    /// Largest residual of the system by a sum of its own, in the unit of the values.
    pub residual_max: f64,
    /// Estimated 2-norm condition of the projected system.
    pub condition: f64,
    /// Coefficients c_i in scaled coordinates (the farthest point at distance 1).
    pub coefficients: Vec<f64>,
}

/// The function through scattered values: f(x_i) + noise_i c_i = y_i, with noise in units of the kernel in scaled
/// coordinates (the farthest point from the mean at distance 1), to a largest true residual of `tolerance`.
///
/// # Errors
/// [`Error::Coplanar`], [`Error::Singular`], [`Error::Stalled`], [`Error::Cancelled`].
pub fn interpolant(
    points: &[P3],
    (values, noise): (&[f64], &[f64]),
    tolerance: f64,
    method: Method,
    ctx: &Ctx,
) -> Result<(Variational, SolveReport), Error> {
    let scale = Scale::of(points);
    let scaled: Vec<[f64; 3]> = points.iter().map(|&p| scale.apply(p)).collect();
    let (solution, _) = solved(&Problem { points: &scaled, noise, values, tolerance: [tolerance; 2] }, method, ctx)?;
    let report = SolveReport {
        iterations: solution.iterations,
        residual_max: solution.errors.iter().fold(0.0, |m, r| m.max(r.abs())),
        condition: solution.condition,
        coefficients: solution.coefficients.clone(),
    };
    Ok((Variational::new(points.to_vec(), scale, &solution)?, report))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::Field;

    /// Rings of wall and interior points of a bent tube, mm.
    fn vessel() -> (Vec<P3>, Vec<f64>) {
        let mut out = (Vec::new(), Vec::new());
        for i in 0..700 {
            let (ring, k) = (i / 28, i % 28);
            let angle = (f64::from(k) + 0.618 * f64::from(ring)) / 28.0 * std::f64::consts::TAU;
            let z = 1.5 * f64::from(ring);
            for inside in [0.0, 1.0] {
                let r = 3.0 + 0.3 * (2.0 * angle).sin() - inside;
                out.0.push(P3::new(r * angle.cos() + 0.01 * z * z, r * angle.sin(), z));
                out.1.push(inside);
            }
        }
        out
    }

    fn values_at(points: &[P3], values: &[f64], targets: &[P3]) -> Vec<f64> {
        let noise: Vec<f64> = values.iter().map(|v| 1e-8 + 1e-6 * v).collect();
        let ctx = Ctx::new(2).unwrap();
        let (f, report) = interpolant(points, (values, &noise), 1e-9, Method::BySize, &ctx).unwrap();
        assert!(report.iterations > 0 && report.residual_max <= 1e-9);
        targets.iter().map(|&t| f.value(t)).collect()
    }

    #[test]
    fn f_is_the_same_after_motion_reversal_permutation_and_in_other_units() {
        let (points, values) = vessel();
        let targets: Vec<P3> =
            (0..40).map(|i| P3::new(2.0, 0.1 * f64::from(i) - 2.0, 0.7 * f64::from(i) + 3.0)).collect();
        let before = values_at(&points, &values, &targets);
        let same = |name: &str, after: Vec<f64>| {
            let off = before.iter().zip(&after).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
            assert!(off < 1e-8, "{name}: {off:e}");
        };
        let (s, c) = 0.7_f64.sin_cos();
        let moved = |p: &P3| P3::new(c * p.x() - s * p.z() + 40.0, p.y() - 130.0, s * p.x() + c * p.z() + 900.0);
        let all = |f: &dyn Fn(&P3) -> P3, of: &[P3]| of.iter().map(f).collect::<Vec<P3>>();
        same("motion", values_at(&all(&moved, &points), &values, &all(&moved, &targets)));
        let inches = |p: &P3| P3::new(p.x() / 25.4, p.y() / 25.4, p.z() / 25.4);
        same("units", values_at(&all(&inches, &points), &values, &all(&inches, &targets)));
        let (mut p, mut v) = (points.clone(), values.clone());
        p.reverse();
        v.reverse();
        same("reversal", values_at(&p, &v, &targets));
        let shuffled: Vec<usize> = (0..points.len()).map(|i| i * 601 % points.len()).collect();
        let pick = |i: &usize| (points[*i], values[*i]);
        let (p, v): (Vec<P3>, Vec<f64>) = shuffled.iter().map(pick).unzip();
        same("permutation", values_at(&p, &v, &targets));
    }

    #[test]
    fn a_single_slice_is_refused_by_every_method() {
        let (points, values) = vessel();
        let flat: Vec<P3> = points.iter().map(|p| P3::new(p.x(), p.y(), 7.5)).collect();
        let noise = vec![1e-6; flat.len()];
        for method in [Method::BySize, Method::Dense, Method::Iterative] {
            let outcome = interpolant(&flat, (&values, &noise), 1e-9, method, &Ctx::new(1).unwrap());
            assert!(matches!(outcome, Err(Error::Coplanar { points: 1400 })), "{method:?}");
        }
    }
}
