//! The same system as [`crate::system`] by preconditioned conjugate gradients, matrix-free.
//!
//! All vectors stay in the null space of P', where K + D is positive definite; [`Contrasts`] precondition, [`Product`]
//! multiplies. Memory is 12 (k + 1) + 256 bytes and some vectors per unknown, about 1.3 kB in all, against 8 n bytes of
//! the dense factor. The true residual is taken by the plain sum, which shares nothing with [`Product`]; where the
//! recursion has drifted from it the iteration begins again on what is left.

use crate::Error;
use crate::contrasts::Contrasts;
use crate::product::Product;
use crate::system::{Reflections, dot, residual};
use exec::Ctx;

/// Most iterations per round. Constraints of vessels take 10 to 30; random clouds without noise up to 60.
const MOST_ITERATIONS: usize = 250;
/// Rounds on what the recursion lost. The second gains what rounding cost the first; a fourth never gained.
const ROUNDS: usize = 3;

/// A solved system and how it was solved.
#[derive(Clone, Debug)]
pub(crate) struct Solution {
    pub(crate) coefficients: Vec<f64>,
    pub(crate) polynomial: [f64; 4],
    /// y - (K + D) c - P b by the plain sum.
    pub(crate) errors: Vec<f64>,
    /// Products with K + D, or 0 of a dense solution.
    pub(crate) iterations: usize,
    /// Estimated 2-norm condition of Q2'(K + D)Q2.
    pub(crate) condition: f64,
}

/// Coefficients c and polynomial b.
pub(crate) type Coefficients = (Vec<f64>, [f64; 4]);

/// The system with its preconditioner.
pub(crate) struct Iterative<'a> {
    points: &'a [[f64; 3]],
    noise: &'a [f64],
    reflections: Reflections,
    contrasts: Contrasts,
    product: Product,
}

impl<'a> Iterative<'a> {
    /// # Errors
    /// [`Error::Coplanar`], [`Error::Singular`], [`Error::Cancelled`].
    pub(crate) fn new(points: &'a [[f64; 3]], noise: &'a [f64], ctx: &Ctx) -> Result<Self, Error> {
        let reflections = Reflections::spanning(points)?;
        let contrasts = Contrasts::new(points, noise, ctx)?;
        Ok(Self { points, noise, reflections, contrasts, product: Product::new(points, noise) })
    }

    /// Coefficients whose largest true residual is at most `tolerance` (in the unit of y), or what rounding lets it come
    /// to, at most `limit`.
    ///
    /// # Errors
    /// [`Error::Stalled`], [`Error::Cancelled`].
    pub(crate) fn solve(&self, y: &[f64], [tolerance, limit]: [f64; 2], ctx: &Ctx) -> Result<Solution, Error> {
        let n = y.len();
        let mut c = vec![0.0; n];
        let mut errors = y.to_vec();
        let mut iterations = 0;
        for round in 1..=ROUNDS {
            let ([step], count) = self.descent([&errors], 0.5 * tolerance, ctx)?;
            iterations += count;
            c.iter_mut().zip(&step).for_each(|(c, s)| *c += s);
            // the side conditions drift by rounding: put c back into the null space
            c = self.reflections.projected(&c).0;
            let left = residual(self.points, self.noise, y, (&c, &[0.0; 4]), ctx)?;
            let b = self.reflections.polynomial(self.reflections.projected(&left).1);
            errors = self.less_polynomial(&left, &b);
            if largest(&errors) <= if round == ROUNDS { limit } else { tolerance } {
                let condition = self.condition(ctx)?;
                return Ok(Solution { coefficients: c, polynomial: b, errors, iterations, condition });
            }
        }
        Err(Error::Stalled { constraints: n, iterations, residual_mm: largest(&errors), wanted_mm: limit })
    }

    /// Coefficients and polynomials for B right-hand sides to a residual of `tolerance`, at most `limit`, by descents that
    /// share their products; the residual is one more shared product. Says nothing of the condition.
    ///
    /// # Errors
    /// As [`Self::solve`].
    pub(crate) fn solve_many<const B: usize>(
        &self,
        y: [&[f64]; B],
        [tolerance, limit]: [f64; 2],
        ctx: &Ctx,
    ) -> Result<[Coefficients; B], Error> {
        let (steps, _) = self.descent(y, 0.5 * tolerance, ctx)?;
        let c = steps.map(|step| self.reflections.projected(&step).0);
        let products = self.product.times(c.each_ref().map(Vec::as_slice), ctx)?;
        let mut out = c.map(|c| (c, [0.0; 4]));
        for ((y, product), out) in y.iter().zip(&products).zip(&mut out) {
            let left: Vec<f64> = y.iter().zip(product).map(|(y, q)| y - q).collect();
            out.1 = self.reflections.polynomial(self.reflections.projected(&left).1);
            if largest(&self.less_polynomial(&left, &out.1)) > limit {
                let again = self.solve(y, [tolerance, limit], ctx)?;
                *out = (again.coefficients, again.polynomial);
            }
        }
        Ok(out)
    }

    fn less_polynomial(&self, v: &[f64], b: &[f64; 4]) -> Vec<f64> {
        v.iter().zip(self.points).map(|(v, p)| v - b[0] - b[1] * p[0] - b[2] * p[1] - b[3] * p[2]).collect()
    }

    /// Conjugate gradients for right-hand sides `y` from zero, until each one's recursion has a small residual or the
    /// iterations are used up. Each is on its own but for the shared products.
    fn descent<const B: usize>(
        &self,
        y: [&[f64]; B],
        tolerance: f64,
        ctx: &Ctx,
    ) -> Result<([Vec<f64>; B], usize), Error> {
        let mut runs = y.map(|y| Run::new(self.reflections.projected(y).0));
        let start = runs.iter().fold(0.0_f64, |m, run| m.max(largest(&run.r)));
        for iteration in 0..MOST_ITERATIONS {
            let mut now = 0.0_f64;
            for run in runs.iter_mut().filter(|run| run.open) {
                let size = largest(&run.r);
                now = now.max(size);
                run.open = size > tolerance;
                if run.open {
                    run.turn(&self.contrasts.apply(&run.r, ctx)?);
                }
            }
            if runs.iter().all(|run| !run.open) {
                return Ok((runs.map(|run| run.c), iteration));
            }
            ctx.progress((start / now).ln().max(0.0) / (start / tolerance).ln());
            let products = self.product.times(runs.each_ref().map(|run| run.p.as_slice()), ctx)?;
            for (run, product) in runs.iter_mut().zip(products).filter(|(run, _)| run.open) {
                run.advance(&self.reflections.projected(&product).0);
            }
        }
        Ok((runs.map(|run| run.c), MOST_ITERATIONS))
    }

    /// Largest eigenvalue by two products from a quadratic (the kernel's largest eigenvector is smooth), smallest by
    /// power steps on the preconditioner, which is the inverse up to a small factor. To a factor of about 2.
    fn condition(&self, ctx: &Ctx) -> Result<f64, Error> {
        let quadratic: Vec<f64> = self.points.iter().map(|p| p.iter().fold(0.0, |s, x| s + x * x)).collect();
        let unit = |v: Vec<f64>| {
            let length = dot(&v, &v).sqrt().max(f64::MIN_POSITIVE);
            (v.iter().map(|x| x / length).collect::<Vec<f64>>(), length)
        };
        let (v, _) = unit(self.reflections.projected(&quadratic).0);
        let (_, largest) = unit(self.reflections.projected(&self.product.times([&v], ctx)?[0]).0);
        let mut v: Vec<f64> = (0..self.points.len()).map(|i| 1.0 + (i as f64 * 0.7).sin()).collect();
        let mut inverse = 0.0;
        for _ in 0..10 {
            let (u, _) = unit(v);
            v = self.contrasts.apply(&u, ctx)?;
            inverse = dot(&v, &v).sqrt();
        }
        Ok(largest * inverse)
    }
}

/// One right-hand side's conjugate gradients: solution, residual and direction.
struct Run {
    c: Vec<f64>,
    r: Vec<f64>,
    p: Vec<f64>,
    /// r'z of this iteration.
    rz: f64,
    open: bool,
}

impl Run {
    fn new(r: Vec<f64>) -> Self {
        Self { c: vec![0.0; r.len()], p: vec![0.0; r.len()], rz: f64::INFINITY, open: true, r }
    }

    /// The next direction, from the preconditioned residual z.
    fn turn(&mut self, z: &[f64]) {
        let rz = dot(&self.r, z);
        let beta = rz / self.rz;
        self.rz = rz;
        self.p.iter_mut().zip(z).for_each(|(p, z)| *p = z + beta * *p);
    }

    /// The step along the direction, whose product is q.
    fn advance(&mut self, q: &[f64]) {
        let pq = dot(&self.p, q);
        // rounding has eaten the descent: what is left is for the next round
        if pq.is_nan() || pq <= 0.0 || self.rz <= 0.0 {
            self.open = false;
            return;
        }
        let alpha = self.rz / pq;
        self.c.iter_mut().zip(&self.p).for_each(|(c, p)| *c += alpha * p);
        self.r.iter_mut().zip(q).for_each(|(r, q)| *r -= alpha * q);
    }
}

fn largest(v: &[f64]) -> f64 {
    // a NaN must not pass for a small residual
    v.iter().fold(0.0_f64, |m, x| if x.is_nan() { f64::INFINITY } else { m.max(x.abs()) })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::system::Factor;

    /// Rings of wall and interior points with different noise, as the fit has them, `turn` radians oblique.
    fn vessel(n: usize, turn: f64) -> (Vec<[f64; 3]>, Vec<f64>, Vec<f64>) {
        let (s, c) = turn.sin_cos();
        let per_ring = 40;
        let rings = n / (2 * per_ring);
        let mut out = (Vec::new(), Vec::new(), Vec::new());
        for (inside, ring, k) in
            (0..2).flat_map(|i| (0..rings).flat_map(move |r| (0..per_ring).map(move |k| (i, r, k))))
        {
            let angle = (k as f64 + 0.618 * ring as f64) / per_ring as f64 * std::f64::consts::TAU;
            let wobble = 1.0 + 0.1 * (3.0 * angle).sin();
            let radius = (if inside == 1 { 0.6 } else { 1.0 }) * wobble * 0.12;
            let z = 2.0 * (ring as f64 + 0.5) / rings as f64 - 1.0;
            let (x, y) = (radius * angle.cos(), radius * angle.sin());
            out.0.push([x * c - z * s, y, x * s + z * c]);
            out.1.push(if inside == 1 { 1e-6 } else { 1e-8 });
            out.2.push(f64::from(inside));
        }
        out
    }

    #[test]
    fn coefficients_are_those_of_the_dense_oracle() {
        let ctx = Ctx::new(2).unwrap();
        for (n, turn) in [(400, 0.0), (1040, 0.0), (2000, 0.6)] {
            let (points, noise, y) = vessel(n, turn);
            let (c, b) = Factor::new(&points, &noise, &ctx).unwrap().solve(&y);
            let found = Iterative::new(&points, &noise, &ctx).unwrap().solve(&y, [1e-10; 2], &ctx).unwrap();
            let norm = dot(&c, &c).sqrt();
            let off: f64 = c.iter().zip(&found.coefficients).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
            assert!(off < 1e-6 * norm, "{n}: {:e} after {} iterations", off / norm, found.iterations);
            assert!(b.iter().zip(found.polynomial).all(|(a, b)| (a - b).abs() < 1e-6));
            assert!(found.iterations < 40, "{}", found.iterations);
            let dense = Factor::new(&points, &noise, &ctx).unwrap().condition();
            let ratio = found.condition / dense;
            assert!((0.3..3.0).contains(&ratio), "{:e} {dense:e}", found.condition);
        }
    }

    #[test]
    fn solutions_have_the_same_bits_for_any_thread_count() {
        let (points, noise, y) = vessel(1200, 0.3);
        let solve = |threads| {
            let ctx = Ctx::new(threads).unwrap();
            Iterative::new(&points, &noise, &ctx).unwrap().solve(&y, [1e-9; 2], &ctx).unwrap()
        };
        let one = solve(1);
        for threads in [2, 3] {
            let other = solve(threads);
            assert!(one.coefficients.iter().zip(&other.coefficients).all(|(a, b)| a.to_bits() == b.to_bits()));
            assert_eq!(one.condition.to_bits(), other.condition.to_bits());
        }
    }

    #[test]
    fn coincident_points_are_solved_with_noise_and_refused_without() {
        let ctx = Ctx::new(1).unwrap();
        let (mut points, noise, y) = vessel(800, 0.0);
        points[7] = points[6];
        points[9] = points[8].map(|x| x + 1e-13);
        let found = Iterative::new(&points, &noise, &ctx).unwrap().solve(&y, [1e-9; 2], &ctx).unwrap();
        assert!(largest(&found.errors) <= 1e-9);
        let exact = vec![0.0; points.len()];
        let outcome = Iterative::new(&points, &exact, &ctx).and_then(|s| s.solve(&y, [1e-9; 2], &ctx));
        assert!(
            matches!(outcome, Err(Error::Singular { .. } | Error::Stalled { .. })),
            "{:?}",
            outcome.map(|s| s.iterations)
        );
    }

    #[test]
    fn solutions_in_company_are_those_alone() {
        let ctx = Ctx::new(2).unwrap();
        let (points, noise, y) = vessel(1200, 0.3);
        let other: Vec<f64> = points.iter().map(|p| (7.0 * p[0]).sin() + p[2]).collect();
        let system = Iterative::new(&points, &noise, &ctx).unwrap();
        let none = vec![0.0; y.len()];
        let both = system.solve_many([&y, &none, &other], [1e-7; 2], &ctx).unwrap();
        assert!(both[1].0.iter().all(|c| *c == 0.0));
        for (y, (c, b)) in [(&y, &both[0]), (&other, &both[2])] {
            let alone = system.solve(y, [1e-7; 2], &ctx).unwrap();
            let worst = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
            let left = residual(&points, &noise, y, (c, b), &ctx).unwrap();
            assert!(largest(&left) < 1.1e-7, "{:e}", largest(&left));
            assert!(worst(c, &alone.coefficients) < 1e-3 * largest(&alone.coefficients));
        }
    }

    #[test]
    fn a_wish_beyond_rounding_is_a_stall() {
        let ctx = Ctx::new(1).unwrap();
        let (points, noise, y) = vessel(400, 0.0);
        let outcome = Iterative::new(&points, &noise, &ctx).unwrap().solve(&y, [1e-30; 2], &ctx);
        assert!(matches!(outcome, Err(Error::Stalled { .. })));
    }

    #[test]
    fn cancelled_work_says_so() {
        let (points, noise, y) = vessel(400, 0.0);
        let ctx = Ctx::new(1).unwrap();
        let system = Iterative::new(&points, &noise, &ctx).unwrap();
        ctx.cancel();
        assert!(matches!(system.solve(&y, [1e-9; 2], &ctx), Err(Error::Cancelled)));
        assert!(matches!(Iterative::new(&points, &noise, &ctx), Err(Error::Cancelled)));
    }
}
