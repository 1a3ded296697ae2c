//! Many values of a cubic radial sum at once, by a tree of boxes over the targets.
//!
//! In a box the sum over the sources that keep a distance from it is smooth: it is taken at p x p x p Chebyshev nodes and
//! interpolated. A box interpolates what its parent knows already, adds the sources that have become far, and passes the
//! others down; where only few targets are left these are summed directly (the downward half of a kernel-independent
//! fast multipole method; Fong and Darve 2009). Vessels are thin, so that each level halves the sources near a box, and
//! nothing would be won by gathering sources into multipoles below 10^5 of them.
//!
//! Coefficients cancel: sum |c_i| r^3 is 1e4 to 1e5 times |f|. Order and distance are therefore chosen by measured errors
//! against the direct sum, not by a bound; docs/adr/0023 has the table. Boxes depend on the targets alone: the result has
//! the same bits for any number of threads, but not for the same target in other company.

use crate::kernel::Centres;
use crate::wide::{Wide, widest};
use exec::{Cancelled, Ctx};
use pulp::{Simd, WithSimd};
use std::sync::Arc;

/// Sources at least this many half-edges away from a box are interpolated in it, and the targets of a box that is not
/// divided further: between 1,000 and 4,000 the time is the same.
#[derive(Clone, Copy, Debug)]
struct Fineness {
    apart: f64,
    crowd: usize,
}

/// With 12 nodes per axis: errors of 2e-8 mm (docs/adr/0023).
const FINE: Fineness = Fineness { apart: 2.0, crowd: 2000 };
/// Nodes per axis, and on the second try.
const ORDER: usize = 12;
const SECOND_ORDER: usize = 16;
/// Largest error found at [`CHECKS`] of the targets, beyond which a higher order is tried, then the direct sum. Half of what
/// is promised: the checks do not meet the worst target.
const ACCEPTED: f64 = 5e-8;
const CHECKS: usize = 256;
/// Fewer targets, or fewer sources, are summed directly.
const FEW: usize = 1500;

/// sum c_i |x - x_i|^3 at each target, to 1e-7: the errors of some targets are measured, whatever the coefficients are.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn sums(sources: &Centres, targets: &[[f64; 3]], ctx: &Ctx) -> Result<Vec<f64>, Cancelled> {
    if targets.len() >= FEW && sources.len() >= FEW {
        let stride = targets.len() / CHECKS;
        let checks: Vec<usize> = (0..CHECKS).map(|k| k * stride + k % stride).collect();
        let exact = ctx.map(&checks, |&t| direct(sources, &targets[t..=t])[0])?;
        let holds = |out: &[f64]| checks.iter().zip(&exact).all(|(&t, e)| (out[t] - e).abs() <= ACCEPTED);
        let first = interpolated::<ORDER>(sources, targets, FINE, ctx)?;
        if holds(&first) {
            return Ok(first);
        }
        let second = interpolated::<SECOND_ORDER>(sources, targets, FINE, ctx)?;
        if holds(&second) {
            return Ok(second);
        }
    }
    let mut out = vec![0.0; targets.len()];
    ctx.chunks_mut(&mut out, 256, |first, chunk| sources.values(&targets[first..first + chunk.len()], chunk))?;
    Ok(out)
}

fn direct(sources: &Centres, targets: &[[f64; 3]]) -> Vec<f64> {
    let mut out = vec![0.0; targets.len()];
    sources.values(targets, &mut out);
    out
}

fn interpolated<const P: usize>(
    sources: &Centres,
    targets: &[[f64; 3]],
    fineness: Fineness,
    ctx: &Ctx,
) -> Result<Vec<f64>, Cancelled> {
    let mut out = vec![0.0; targets.len()];
    let tree = Tree::<P> { sources, targets, fineness, nodes: Nodes::new() };
    let all = (0..targets.len() as u32).collect();
    let mut level = vec![Part { targets: all, far: None, near: Arc::new((0..sources.len() as u32).collect()) }];
    let mut done = 0;
    while !level.is_empty() {
        let steps = ctx.map(&level, |part| tree.step(part))?;
        let mut next = Vec::new();
        for (part, step) in level.iter().zip(steps) {
            match step {
                Step::Values(values) => {
                    done += values.len();
                    part.targets.iter().zip(values).for_each(|(&t, v)| out[t as usize] = v);
                }
                Step::Parts(parts) => next.extend(parts),
            }
        }
        ctx.progress(done as f64 / targets.len().max(1) as f64);
        level = next;
    }
    Ok(out)
}

/// Some targets with what is known of the sum at them.
struct Part<const P: usize> {
    targets: Vec<u32>,
    /// The sum over the sources that are not near.
    far: Option<Arc<Expansion<P>>>,
    /// Sources not yet summed.
    near: Arc<Vec<u32>>,
}

enum Step<const P: usize> {
    Values(Vec<f64>),
    Parts(Vec<Part<P>>),
}

struct Tree<'a, const P: usize> {
    sources: &'a Centres,
    targets: &'a [[f64; 3]],
    fineness: Fineness,
    nodes: Nodes<P>,
}

impl<const P: usize> Tree<'_, P> {
    fn step(&self, part: &Part<P>) -> Step<P> {
        let (centre, half) = self.cuboid(&part.targets);
        let widest = half.iter().fold(0.0, |m: f64, h| m.max(*h));
        if part.targets.len() <= self.fineness.crowd || part.near.is_empty() || widest <= 0.0 {
            return Step::Values(self.values(part));
        }
        let reach = self.fineness.apart * widest;
        let is_far = |s: &u32| {
            let x = self.sources.source(*s as usize).0;
            let gap = |a: usize| ((x[a] - centre[a]).abs() - half[a]).max(0.0);
            gap(0).powi(2) + gap(1).powi(2) + gap(2).powi(2) >= reach * reach
        };
        let (far, near): (Vec<u32>, Vec<u32>) = part.near.iter().partition(|s| is_far(s));
        let expansion = if far.is_empty() {
            part.far.clone()
        } else {
            // a flat box is given some thickness, so that its nodes differ
            let half = half.map(|h| h.max(1e-3 * widest));
            Some(Arc::new(self.expansion((centre, half), part.far.as_deref(), &far)))
        };
        let near = Arc::new(near);
        let parts = self.divided(&part.targets, centre, half.map(|h| h > 0.5 * widest));
        Step::Parts(parts.map(|targets| Part { targets, far: expansion.clone(), near: Arc::clone(&near) }).collect())
    }

    /// Centre and half-edges of the box around some targets.
    fn cuboid(&self, targets: &[u32]) -> ([f64; 3], [f64; 3]) {
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
        for &t in targets {
            for (b, x) in bounds.iter_mut().zip(self.targets[t as usize]) {
                *b = [b[0].min(x), b[1].max(x)];
            }
        }
        (bounds.map(|[lo, hi]| 0.5 * (lo + hi)), bounds.map(|[lo, hi]| 0.5 * (hi - lo)))
    }

    /// The targets by octant, divided along the `long` axes only.
    fn divided(&self, targets: &[u32], centre: [f64; 3], long: [bool; 3]) -> impl Iterator<Item = Vec<u32>> {
        let mut parts: [Vec<u32>; 8] = Default::default();
        for &t in targets {
            let x = self.targets[t as usize];
            let octant = (0..3).fold(0, |o, a| o | usize::from(long[a] && x[a] > centre[a]) << a);
            parts[octant].push(t);
        }
        parts.into_iter().filter(|p| !p.is_empty())
    }

    /// The sum at the targets of a part: interpolated from afar, directly from near.
    fn values(&self, part: &Part<P>) -> Vec<f64> {
        let targets: Vec<[f64; 3]> = part.targets.iter().map(|&t| self.targets[t as usize]).collect();
        let mut out = direct(&self.sources.some(&part.near), &targets);
        if let Some(far) = &part.far {
            widest(Interpolated { far, nodes: &self.nodes, targets: &targets, out: &mut out });
        }
        out
    }

    fn expansion(
        &self,
        (centre, half): ([f64; 3], [f64; 3]),
        parent: Option<&Expansion<P>>,
        far: &[u32],
    ) -> Expansion<P> {
        let at = [0, 1, 2].map(|a| self.nodes.at.map(|t| centre[a] + half[a] * t));
        let plane = |z: f64| at[1].iter().flat_map(move |&y| at[0].map(|x| [x, y, z]));
        let points: Vec<[f64; 3]> = at[2].iter().flat_map(|&z| plane(z)).collect();
        let sums = direct(&self.sources.some(far), &points);
        let mut values = match parent {
            Some(parent) => widest(OnLattice { parent, nodes: &self.nodes, at: &at }),
            None => vec![[0.0; P]; P * P],
        };
        values.iter_mut().flatten().zip(sums).for_each(|(v, s)| *v += s);
        Expansion { centre, half, values }
    }
}

/// Chebyshev nodes of the first kind and their barycentric weights (Berrut and Trefethen 2004, eq. 5.3).
struct Nodes<const P: usize> {
    at: [f64; P],
    weight: [f64; P],
}

impl<const P: usize> Nodes<P> {
    fn new() -> Self {
        let angle = |m: usize| (2 * m + 1) as f64 * std::f64::consts::PI / (2 * P) as f64;
        let sign = |m: usize| if m.is_multiple_of(2) { 1.0 } else { -1.0 };
        Self { at: std::array::from_fn(|m| angle(m).cos()), weight: std::array::from_fn(|m| sign(m) * angle(m).sin()) }
    }

    /// Values of the Lagrange polynomials at `u`.
    #[inline(always)]
    fn basis(&self, u: f64) -> [f64; P] {
        let mut out = [0.0; P];
        for ((o, t), w) in out.iter_mut().zip(&self.at).zip(&self.weight) {
            // at a node its own term drowns the others
            let gap = u - t;
            *o = w / if gap.abs() < 1e-100 { 1e-100 } else { gap };
        }
        let scale = 1.0 / out.iter().fold(0.0, |s, o| s + o);
        out.map(|o| o * scale)
    }
}

/// A smooth function in a box by its values at the nodes.
struct Expansion<const P: usize> {
    centre: [f64; 3],
    half: [f64; 3],
    /// Lines along x; y runs faster than z.
    values: Vec<[f64; P]>,
}

impl<const P: usize> Expansion<P> {
    /// The function at one target.
    #[inline(always)]
    fn value<S: Simd>(&self, simd: S, nodes: &Nodes<P>, t: [f64; 3]) -> f64 {
        let [x, y, z] = [0, 1, 2].map(|a| nodes.basis((t[a] - self.centre[a]) / self.half[a]));
        let mut sum = [0.0; P];
        for (plane, wz) in self.values.chunks_exact(P).zip(&z) {
            let mut line = [0.0; P];
            for (row, wy) in plane.iter().zip(&y) {
                add(simd, &mut line, row, *wy);
            }
            add(simd, &mut sum, &line, *wz);
        }
        inner(&sum, &x)
    }
}

/// Adds the function at some targets to what is known there.
struct Interpolated<'a, const P: usize> {
    far: &'a Expansion<P>,
    nodes: &'a Nodes<P>,
    targets: &'a [[f64; 3]],
    out: &'a mut [f64],
}

impl<const P: usize> WithSimd for Interpolated<'_, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (o, t) in self.out.iter_mut().zip(self.targets) {
            *o += self.far.value(simd, self.nodes, *t);
        }
    }
}

/// Values at all (x, y, z) of three lists of coordinates, axis by axis, in lines along x.
struct OnLattice<'a, const P: usize> {
    parent: &'a Expansion<P>,
    nodes: &'a Nodes<P>,
    at: &'a [[f64; P]; 3],
}

impl<const P: usize> WithSimd for OnLattice<'_, P> {
    type Output = Vec<[f64; P]>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<[f64; P]> {
        let Self { parent, nodes, at } = self;
        let [x, y, z] = [0, 1, 2].map(|a| at[a].map(|t| nodes.basis((t - parent.centre[a]) / parent.half[a])));
        let mut by_z = vec![[0.0; P]; P * P];
        for (out, w) in by_z.chunks_exact_mut(P).zip(&z) {
            for (plane, w) in parent.values.chunks_exact(P).zip(w) {
                out.iter_mut().zip(plane).for_each(|(o, row)| add(simd, o, row, *w));
            }
        }
        let mut out = Vec::with_capacity(P * P);
        for plane in by_z.chunks_exact(P) {
            for w in &y {
                let mut line = [0.0; P];
                plane.iter().zip(w).for_each(|(row, w)| add(simd, &mut line, row, *w));
                out.push(x.map(|w| inner(&line, &w)));
            }
        }
        out
    }
}

#[inline(always)]
fn add<S: Simd, const P: usize>(simd: S, to: &mut [f64; P], row: &[f64; P], weight: f64) {
    let whole = P / S::F64_LANES;
    let w = Wide::splat(simd, weight);
    for part in 0..whole {
        (Wide::of(simd, to, part) + w * Wide::of(simd, row, part)).put(to, part);
    }
    for m in whole * S::F64_LANES..P {
        to[m] += weight * row[m];
    }
}

#[inline(always)]
fn inner<const P: usize>(a: &[f64; P], b: &[f64; P]) -> f64 {
    a.iter().zip(b).fold(0.0, |s, (a, b)| s + a * b)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Field, Method, Variational, interpolant};
    use space::P3;

    /// A fit of a bent, slightly oval tube with `rings` slices of 1.5 mm and radius 10 mm, 24 wall and as many inner points
    /// each; `sigma_mm` is the error of its points.
    fn vessel(rings: usize, sigma_mm: f64, ctx: &Ctx) -> Variational {
        let mut points = Vec::new();
        let mut values = Vec::new();
        let per_ring = 24;
        for i in 0..rings * per_ring {
            let (ring, k) = (i / per_ring, i % per_ring);
            let angle = (k as f64 + 0.618 * ring as f64) / per_ring as f64 * std::f64::consts::TAU;
            let z = 1.5 * ring as f64;
            let error = sigma_mm * 1.73 * (2.0 * ((i as f64 * 12.9898).sin() * 43_758.545).fract().abs() - 1.0);
            for inside in [0.0, 1.0] {
                let r = 10.0 + 0.5 * (2.0 * angle).sin() + error - inside;
                points.push(P3::new(r * angle.cos() + 0.002 * z * z, r * angle.sin(), z));
                values.push(inside);
            }
        }
        let noise: Vec<f64> = values.iter().map(|v| 1e-9 + 1e-6 * v + 1e-2 * sigma_mm * sigma_mm).collect();
        interpolant(&points, (&values, &noise), 1e-6, Method::Iterative, ctx).unwrap().0
    }

    /// Points of a lattice of `step` mm within `band` mm of the wall.
    fn band(f: &Variational, band: f64, step: f64) -> Vec<P3> {
        let b = f.bounds();
        let n = (b.size() / step).to_array().map(|x| x as usize);
        (0..n[0] * n[1] * n[2])
            .map(|i| {
                b.min + space::V3::new((i % n[0]) as f64, (i / n[0] % n[1]) as f64, (i / n[0] / n[1]) as f64) * step
            })
            .filter(|p| {
                let x = p.x() - 0.002 * p.z() * p.z();
                (x.hypot(p.y()) - 10.0).abs() < band
            })
            .collect()
    }

    /// Largest error at 5,000 of the points, mm, and the time of the fast sums, s.
    fn worst(f: &Variational, at: &[P3], order: usize, fineness: Fineness, ctx: &Ctx) -> (f64, f64) {
        let start = std::time::Instant::now();
        let targets: Vec<[f64; 3]> = at.iter().map(|&x| f.scale.apply(x)).collect();
        let fast = match order {
            10 => interpolated::<10>(&f.centres, &targets, fineness, ctx),
            12 => interpolated::<12>(&f.centres, &targets, fineness, ctx),
            14 => interpolated::<14>(&f.centres, &targets, fineness, ctx),
            _ => interpolated::<16>(&f.centres, &targets, fineness, ctx),
        }
        .unwrap();
        let seconds = start.elapsed().as_secs_f64();
        let stride = (targets.len() / 5_000).max(1);
        let checked: Vec<usize> = (0..targets.len()).step_by(stride).collect();
        let off = ctx.map(&checked, |&i| {
            let mut direct = [0.0];
            f.centres.values(&targets[i..=i], &mut direct);
            (fast[i] - direct[0]).abs()
        });
        (off.unwrap().into_iter().fold(0.0, f64::max), seconds)
    }

    #[test]
    fn sums_are_the_direct_ones_to_1e_7_with_the_same_bits_for_any_thread_count() {
        for sigma in [0.0, 0.2] {
            let f = vessel(40, sigma, &Ctx::new(2).unwrap());
            let at = band(&f, 4.0, 0.8);
            let targets: Vec<[f64; 3]> = at.iter().map(|&x| f.scale.apply(x)).collect();
            let one = sums(&f.centres, &targets, &Ctx::new(1).unwrap()).unwrap();
            let exact = direct(&f.centres, &targets);
            let off = one.iter().zip(&exact).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
            assert!(off > 0.0, "the tree was not used");
            assert!(off < 1e-7, "sigma {sigma}: {off:e}");
            for threads in [2, 3] {
                let other = sums(&f.centres, &targets, &Ctx::new(threads).unwrap()).unwrap();
                assert!(one.iter().zip(&other).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
        }
    }

    #[test]
    fn coefficients_too_large_for_the_order_are_noticed() {
        let f = vessel(40, 0.0, &Ctx::new(2).unwrap());
        let ctx = Ctx::new(2).unwrap();
        let targets: Vec<[f64; 3]> = band(&f, 3.0, 1.2).iter().map(|&x| f.scale.apply(x)).collect();
        let (points, small): (Vec<_>, Vec<_>) = (0..f.centres.len()).map(|i| f.centres.source(i)).unzip();
        let large: Vec<f64> = small.iter().map(|c| 1e6 * c).collect();
        let centres = Centres::new(&points, &large);
        let (exact, out) = (direct(&centres, &targets), sums(&centres, &targets, &ctx).unwrap());
        assert!(out.iter().zip(&exact).all(|(a, b)| (a - b).abs() < 1e-7));
        // flat and coincident targets
        let twin = vec![targets[0]; 3000];
        assert!(
            sums(&f.centres, &twin, &ctx).unwrap().iter().all(|v| (v - direct(&f.centres, &twin[..1])[0]).abs() < 1e-7)
        );
    }

    /// The table of docs/adr/0023: `cargo test --release -p implicit -- --ignored --nocapture errors_by_order`.
    #[test]
    #[ignore = "a survey of a minute"]
    fn errors_by_order_and_distance() {
        let ctx = Ctx::new(2).unwrap();
        for (rings, sigma) in [(200, 0.0), (200, 0.2)] {
            let f = vessel(rings, sigma, &ctx);
            let at = band(&f, 4.0, 0.5);
            let start = std::time::Instant::now();
            let direct: Vec<P3> = at.iter().step_by(10).copied().collect();
            ctx.map(&direct, |x| f.value(*x)).unwrap();
            println!("direct: {} s", start.elapsed().as_secs_f64() * 10.0);
            for (order, apart, crowd) in [
                (10, 2.0, 700),
                (12, 1.0, 1000),
                (12, 1.5, 1000),
                (12, 2.0, 300),
                (12, 2.0, 1000),
                (12, 2.0, 3000),
                (14, 1.5, 1000),
                (16, 1.0, 1000),
            ] {
                let (error, seconds) = worst(&f, &at, order, Fineness { apart, crowd }, &ctx);
                println!(
                    "{} centres, sigma {sigma}, {} targets, order {order}, apart {apart}, crowd {crowd}: {error:.1e} mm, {seconds:.2} s",
                    f.centres.len(),
                    at.len()
                );
            }
        }
    }
}
