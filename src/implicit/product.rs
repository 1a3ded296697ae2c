//! The symmetric product (K + D) c with K_ij = |x_i - x_j|^3, matrix-free: every pair's root is taken once.
//!
//! Points lie in tiles of [`TILE`]; a pair of tiles adds to both sides. Tiles are dealt to a fixed number of tasks, each
//! with sums of its own that are folded in order, so the bits do not depend on the number of threads. Half the roots of
//! the plain sum, and the root is what limits both.

use crate::wide::{LANES, Lanes, Wide, apart, fold, widest};
use exec::{Cancelled, Ctx};
use pulp::{Simd, WithSimd};

/// Points per tile: positions, coefficients and sums of one tile are 10 KiB, a third of the first cache.
const TILE: usize = 256;
const GROUPS: usize = TILE / LANES;
/// Tasks, fixed: also the number of partial sums per point (256 bytes per unknown).
const TASKS: usize = 32;

/// Points and noise, ready for products.
pub(crate) struct Product {
    n: usize,
    position: Vec<[Lanes; 3]>,
    noise: Vec<f64>,
}

impl Product {
    pub(crate) fn new(points: &[[f64; 3]], noise: &[f64]) -> Self {
        let n = points.len();
        let mut position = vec![[[0.0; LANES]; 3]; n.div_ceil(TILE) * GROUPS];
        for (i, p) in points.iter().enumerate() {
            for a in 0..3 {
                position[i / LANES][a][i % LANES] = p[a];
            }
        }
        Self { n, position, noise: noise.to_vec() }
    }

    /// (K + D) c for B vectors c at once: the roots, which cost most, are shared. Cost: n^2 / 2 roots; four vectors take
    /// the time of two to two and a half. Transient memory: 256 B bytes per unknown.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn times<const B: usize>(&self, c: [&[f64]; B], ctx: &Ctx) -> Result<[Vec<f64>; B], Cancelled> {
        let tiles = self.position.len() / GROUPS;
        let mut packed = vec![[[0.0; LANES]; B]; self.position.len()];
        for (b, c) in c.iter().enumerate() {
            c.iter().enumerate().for_each(|(i, c)| packed[i / LANES][b][i % LANES] = *c);
        }
        let tasks = TASKS.min(tiles);
        let parts = ctx.map_range(tasks, |task| {
            let mut sums = vec![[[0.0; LANES]; B]; packed.len()];
            let mine = |row: &usize| [task, 2 * tasks - 1 - task].contains(&(row % (2 * tasks)));
            for row in (0..tiles).filter(mine) {
                ctx.check()?;
                widest(TileRow { product: self, row, c: &packed, sums: &mut sums });
            }
            Ok(sums)
        })?;
        let parts: Vec<Vec<[Lanes; B]>> = parts.into_iter().collect::<Result<_, Cancelled>>()?;
        let mut out = [(); B].map(|()| vec![0.0; self.n]);
        for (b, (out, c)) in out.iter_mut().zip(c).enumerate() {
            ctx.chunks_mut(out, TILE, |first, chunk| {
                for (k, o) in chunk.iter_mut().enumerate() {
                    let i = first + k;
                    *o = parts.iter().fold(self.noise[i] * c[i], |s, p| s + p[i / LANES][b][i % LANES]);
                }
            })?;
        }
        Ok(out)
    }
}

/// All pairs of a tile with itself and with the tiles after it.
struct TileRow<'a, const B: usize> {
    product: &'a Product,
    row: usize,
    c: &'a [[Lanes; B]],
    sums: &'a mut [[Lanes; B]],
}

impl<const B: usize> WithSimd for TileRow<'_, B> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { product, row, c, sums } = self;
        let position = &product.position;
        let own = row * GROUPS;
        let targets = own * LANES..((own + GROUPS) * LANES).min(product.n);
        let at = |i: usize| [0, 1, 2].map(|a| Wide::splat(simd, position[i / LANES][a][i % LANES]));
        for i in targets.clone() {
            // within the tile every pair is met from both sides
            let within = one_sided(simd, &position[own..own + GROUPS], at(i), &c[own..own + GROUPS]);
            (0..B).for_each(|b| sums[i / LANES][b][i % LANES] += within[b]);
        }
        for other in (own + GROUPS..position.len()).step_by(GROUPS) {
            let theirs = other..other + GROUPS;
            for i in targets.clone() {
                let (g, l) = (i / LANES, i % LANES);
                let tile = (&position[theirs.clone()], &c[theirs.clone()]);
                let sum = two_sided(simd, tile, at(i), c[g].map(|c| c[l]), &mut sums[theirs.clone()]);
                (0..B).for_each(|b| sums[g][b][l] += sum[b]);
            }
        }
    }
}

/// sum c_j r_j^3 over a few groups.
#[inline(always)]
fn one_sided<S: Simd, const B: usize>(simd: S, position: &[[Lanes; 3]], t: [Wide<S>; 3], c: &[[Lanes; B]]) -> [f64; B] {
    let mut out = [[0.0; LANES]; B];
    for part in 0..Wide::<S>::PARTS {
        let mut acc = [Wide::splat(simd, 0.0); B];
        for (group, c) in position.iter().zip(c) {
            let (_, r2) = apart(t, [&group[0], &group[1], &group[2]], part);
            let cube = r2 * r2.sqrt();
            (0..B).for_each(|b| acc[b] += Wide::of(simd, &c[b], part) * cube);
        }
        (0..B).for_each(|b| acc[b].put(&mut out[b], part));
    }
    out.map(fold)
}

/// The same, which also adds own r_j^3 to every `sums` j.
#[inline(always)]
fn two_sided<S: Simd, const B: usize>(
    simd: S,
    (position, c): (&[[Lanes; 3]], &[[Lanes; B]]),
    t: [Wide<S>; 3],
    own: [f64; B],
    sums: &mut [[Lanes; B]],
) -> [f64; B] {
    let own = own.map(|own| Wide::splat(simd, own));
    let mut out = [[0.0; LANES]; B];
    for part in 0..Wide::<S>::PARTS {
        let mut acc = [Wide::splat(simd, 0.0); B];
        for ((group, c), sums) in position.iter().zip(c).zip(&mut *sums) {
            let (_, r2) = apart(t, [&group[0], &group[1], &group[2]], part);
            let cube = r2 * r2.sqrt();
            for b in 0..B {
                acc[b] += Wide::of(simd, &c[b], part) * cube;
                (Wide::of(simd, &sums[b], part) + own[b] * cube).put(&mut sums[b], part);
            }
        }
        (0..B).for_each(|b| acc[b].put(&mut out[b], part));
    }
    out.map(fold)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_product_is_the_plain_sum_with_the_same_bits_for_any_thread_count() {
        for n in [1, 7, 256, 257, 3000] {
            let f = |i: usize, a: f64| ((i as f64 * a).sin() * 43_758.545).fract();
            let points: Vec<[f64; 3]> = (0..n).map(|i| [f(i + 1, 12.98), f(i + 1, 78.23), f(i + 1, 37.72)]).collect();
            let c: Vec<f64> = (0..n).map(|i| f(i, 3.3)).collect();
            let noise = vec![0.25; n];
            let product = Product::new(&points, &noise);
            let [out] = product.times([&c], &Ctx::new(1).unwrap()).unwrap();
            for (i, o) in out.iter().enumerate().step_by(17) {
                let plain = points
                    .iter()
                    .zip(&c)
                    .fold(0.25 * c[i], |s, (p, c)| s + c * crate::nearest::distance2(p, &points[i]).powf(1.5));
                assert!((o - plain).abs() < 1e-11 * (1.0 + n as f64), "{o} {plain}");
            }
            for threads in [2, 3] {
                let d: Vec<f64> = c.iter().map(|c| 1.0 - c).collect();
                // in company of other vectors too
                let [_, other, _, _] = product.times([&d, &c, &d, &d], &Ctx::new(threads).unwrap()).unwrap();
                assert!(out.iter().zip(&other).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
        }
    }
}
