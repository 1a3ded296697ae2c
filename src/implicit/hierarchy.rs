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
use exec::{Cancelled, Ctx};
use pulp::Arch;
use std::sync::Arc;

/// How exact and how fine.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fineness {
    /// Chebyshev nodes per axis.
    pub(crate) order: usize,
    /// Sources at least this many half-edges away from a box are interpolated in it.
    pub(crate) apart: f64,
    /// Targets of a box that is not divided further.
    pub(crate) crowd: usize,
}

impl Default for Fineness {
    /// Errors of at most 1e-8 mm (docs/adr/0023).
    fn default() -> Self {
        Self { order: 10, apart: 2.0, crowd: 1000 }
    }
}

/// sum c_i |x - x_i|^3 at each target.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn sums(
    sources: &Centres,
    targets: &[[f64; 3]],
    fineness: Fineness,
    ctx: &Ctx,
) -> Result<Vec<f64>, Cancelled> {
    let mut out = vec![0.0; targets.len()];
    let nodes = Nodes::new(fineness.order);
    let tree = Tree { sources, targets, fineness, nodes };
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
struct Part {
    targets: Vec<u32>,
    /// The sum over the sources that are not near.
    far: Option<Arc<Expansion>>,
    /// Sources not yet summed.
    near: Arc<Vec<u32>>,
}

enum Step {
    Values(Vec<f64>),
    Parts(Vec<Part>),
}

struct Tree<'a> {
    sources: &'a Centres,
    targets: &'a [[f64; 3]],
    fineness: Fineness,
    nodes: Nodes,
}

impl Tree<'_> {
    fn step(&self, part: &Part) -> Step {
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
            Some(Arc::new(self.expansion(centre, half, part.far.as_deref(), &far)))
        };
        let near = Arc::new(near);
        let parts = self.divided(&part.targets, centre, half.map(|h| h > 0.5 * widest));
        Step::Parts(
            parts.map(|targets| Part { targets, far: expansion.clone(), near: Arc::clone(&near) }).collect(),
        )
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
    fn values(&self, part: &Part) -> Vec<f64> {
        let targets: Vec<[f64; 3]> = part.targets.iter().map(|&t| self.targets[t as usize]).collect();
        let mut out = vec![0.0; targets.len()];
        self.sources.some(&part.near).values(&targets, &mut out);
        if let Some(far) = &part.far {
            Arch::new().dispatch(|| {
                for (o, t) in out.iter_mut().zip(&targets) {
                    *o += far.value(&self.nodes, *t);
                }
            });
        }
        out
    }

    fn expansion(&self, centre: [f64; 3], half: [f64; 3], parent: Option<&Expansion>, far: &[u32]) -> Expansion {
        let at = [0, 1, 2].map(|a| self.nodes.at.iter().map(|t| centre[a] + half[a] * t).collect::<Vec<f64>>());
        let points: Vec<[f64; 3]> = at[2]
            .iter()
            .flat_map(|&z| at[1].iter().map(move |&y| (y, z)))
            .flat_map(|(y, z)| at[0].iter().map(move |&x| [x, y, z]))
            .collect();
        let mut values = vec![0.0; points.len()];
        self.sources.some(far).values(&points, &mut values);
        if let Some(parent) = parent {
            let known = Arch::new().dispatch(|| parent.on_lattice(&self.nodes, &at));
            values.iter_mut().zip(known).for_each(|(v, k)| *v += k);
        }
        Expansion { centre, half, values }
    }
}

/// Chebyshev nodes of the first kind and their barycentric weights (Berrut and Trefethen 2004, eq. 5.3).
struct Nodes {
    at: Vec<f64>,
    weight: Vec<f64>,
}

/// Most nodes per axis.
const MOST: usize = 16;

impl Nodes {
    fn new(order: usize) -> Self {
        let angle = |m: usize| (2 * m + 1) as f64 * std::f64::consts::PI / (2 * order) as f64;
        let sign = |m: usize| if m.is_multiple_of(2) { 1.0 } else { -1.0 };
        Self {
            at: (0..order).map(|m| angle(m).cos()).collect(),
            weight: (0..order).map(|m| sign(m) * angle(m).sin()).collect(),
        }
    }

    /// Values of the Lagrange polynomials at `u`.
    #[inline(always)]
    fn basis(&self, u: f64) -> [f64; MOST] {
        let mut out = [0.0; MOST];
        let mut sum = 0.0;
        for ((o, t), w) in out.iter_mut().zip(&self.at).zip(&self.weight) {
            // at a node its own term drowns the others
            let gap = u - t;
            let gap = if gap.abs() < 1e-100 { 1e-100 } else { gap };
            *o = w / gap;
            sum += *o;
        }
        let scale = 1.0 / sum;
        out.iter_mut().for_each(|o| *o *= scale);
        out
    }
}

/// A smooth function in a box by its values at the nodes, x fastest.
struct Expansion {
    centre: [f64; 3],
    half: [f64; 3],
    values: Vec<f64>,
}

impl Expansion {
    #[inline(always)]
    fn value(&self, nodes: &Nodes, t: [f64; 3]) -> f64 {
        let p = nodes.at.len();
        let [x, y, z] = [0, 1, 2].map(|a| nodes.basis((t[a] - self.centre[a]) / self.half[a]));
        let mut line = [0.0; MOST];
        for (plane, wz) in self.values.chunks_exact(p * p).zip(&z) {
            for (row, wy) in plane.chunks_exact(p).zip(&y) {
                let w = wz * wy;
                line.iter_mut().zip(row).for_each(|(l, v)| *l += w * v);
            }
        }
        line.iter().zip(&x).fold(0.0, |s, (l, w)| s + l * w)
    }

    /// Values at all (x, y, z) of three lists of as many coordinates as there are nodes, axis by axis.
    #[inline(always)]
    fn on_lattice(&self, nodes: &Nodes, at: &[Vec<f64>; 3]) -> Vec<f64> {
        let p = nodes.at.len();
        let basis = |a: usize| at[a].iter().map(move |t| nodes.basis((t - self.centre[a]) / self.half[a]));
        let mut by_z = vec![0.0; p * p * p];
        for (out, w) in by_z.chunks_exact_mut(p * p).zip(basis(2)) {
            for (plane, w) in self.values.chunks_exact(p * p).zip(&w) {
                out.iter_mut().zip(plane).for_each(|(o, v)| *o += w * v);
            }
        }
        let y: Vec<[f64; MOST]> = basis(1).collect();
        let x: Vec<[f64; MOST]> = basis(0).collect();
        let mut out = Vec::with_capacity(p * p * p);
        for plane in by_z.chunks_exact(p * p) {
            for w in &y {
                let mut line = [0.0; MOST];
                for (row, w) in plane.chunks_exact(p).zip(w) {
                    line.iter_mut().zip(row).for_each(|(l, v)| *l += w * v);
                }
                out.extend(x.iter().map(|w| line.iter().zip(w).fold(0.0, |s, (l, w)| s + l * w)));
            }
        }
        out
    }
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
        let noise: Vec<f64> = values.iter().map(|v| 1e-9 + 1e-6 * v + 1e-4 * sigma_mm * sigma_mm).collect();
        interpolant(&points, (&values, &noise), 1e-8, Method::Iterative, ctx).unwrap().0
    }

    /// Points of a lattice of .8 mm within `band` mm of the wall.
    fn band(f: &Variational, band: f64) -> Vec<P3> {
        let b = f.bounds();
        let n = (b.size() / 0.8).to_array().map(|x| x as usize);
        (0..n[0] * n[1] * n[2])
            .map(|i| b.min + space::V3::new((i % n[0]) as f64, (i / n[0] % n[1]) as f64, (i / n[0] / n[1]) as f64) * 0.8)
            .filter(|p| {
                let x = p.x() - 0.002 * p.z() * p.z();
                (x.hypot(p.y()) - 10.0).abs() < band
            })
            .collect()
    }

    fn worst(f: &Variational, at: &[P3], fineness: Fineness, ctx: &Ctx) -> f64 {
        let targets: Vec<[f64; 3]> = at.iter().map(|&x| f.scale.apply(x)).collect();
        let fast = sums(&f.centres, &targets, fineness, ctx).unwrap();
        let stride = (targets.len() / 20_000).max(1);
        let checked: Vec<usize> = (0..targets.len()).step_by(stride).collect();
        let off = ctx.map(&checked, |&i| {
            let mut direct = [0.0];
            f.centres.values(&targets[i..=i], &mut direct);
            (fast[i] - direct[0]).abs()
        });
        off.unwrap().into_iter().fold(0.0, f64::max)
    }

    /// The table of docs/adr/0023: `cargo test --release -p implicit -- --ignored --nocapture errors_by_order`.
    #[test]
    #[ignore = "a survey of a minute"]
    fn errors_by_order_and_distance() {
        let ctx = Ctx::new(2).unwrap();
        for (rings, sigma) in [(40, 0.0), (40, 0.2), (200, 0.0), (200, 0.2)] {
            let f = vessel(rings, sigma, &ctx);
            let at = band(&f, 4.0);
            for order in [6, 8, 10, 12] {
                for apart in [1.0, 1.5, 2.0] {
                    for crowd in [300, 1000, 3000] {
                        let fineness = Fineness { order, apart, crowd };
                        let start = std::time::Instant::now();
                        let targets: Vec<[f64; 3]> = at.iter().map(|&x| f.scale.apply(x)).collect();
                        sums(&f.centres, &targets, fineness, &ctx).unwrap();
                        let seconds = start.elapsed().as_secs_f64();
                        let error = worst(&f, &at, fineness, &ctx);
                        println!(
                            "{} centres, sigma {sigma}, {} targets, order {order}, apart {apart}, crowd {crowd}: {error:.1e} mm, {seconds:.3} s",
                            f.centres.len(),
                            at.len()
                        );
                    }
                }
            }
        }
    }
}
