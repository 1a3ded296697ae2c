//! How long an edge should be: everywhere the same, or by the exact curvature of f.
//!
//! A triangle of edge h inscribed in a sphere of curvature kappa stands h^2 kappa / 6 off it (exactly: h^2 = 6 eps /
//! kappa - 3 eps^2). kappa is the larger principal curvature of f = 0 from the second derivatives of f, not an estimate
//! from the mesh, so the acute crotch is resolved from the first pass on. Sizes are graded: they grow by at most
//! [`GRADING`] per unit of way.

use crate::fabric::{Fabric, Seat};
use crate::{Error, Sizing};
use exec::Ctx;
use glam::{DMat3, DVec3};
use space::P3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Growth of the wanted size per unit of way along edges: neighbouring edges then differ by at most 1.3.
const GRADING: f64 = 0.3;

/// The larger absolute principal curvature of the level set through a point, 1/mm, from gradient g and Hessian H: the
/// eigenvalues of P H P / |g|, P the projector on the tangent plane.
pub(crate) fn largest_curvature(g: DVec3, hessian: DMat3) -> f64 {
    let slope = g.length();
    let n = g / slope;
    let (u, v) = n.any_orthonormal_pair();
    let (hu, hv) = (hessian * u, hessian * v);
    let (a, b, c) = (u.dot(hu), u.dot(hv), v.dot(hv));
    let (mean, spread) = (0.5 * (a + c), (0.25 * (a - c) * (a - c) + b * b).sqrt());
    (mean.abs() + spread) / slope
}

/// Curvature in the plane with normal `n` of the level curve through a point, 1/mm.
fn curve_curvature(g: DVec3, hessian: DMat3, n: DVec3) -> f64 {
    let free = g - n * n.dot(g);
    let t = n.cross(free).normalize_or_zero();
    (t.dot(hessian * t) / free.length()).abs()
}

/// Edges come out between 4/5 and 4/3 of the wanted length; with sizes taken at this fraction the largest distance
/// inside faces of the benchmark anastomosis falls from 1.2 to .9 times the wanted error (.88 leaves 1.13 with its caps).
const SAFETY: f64 = 0.83;

/// The edge length at which a triangle stands `error` off a surface of a curvature, mm.
fn edge_for(curvature: f64, error: f64, [least, most]: [f64; 2]) -> f64 {
    let square = 6.0 * error / curvature.max(1e-12) - 3.0 * error * error;
    (SAFETY * square.max(0.0).sqrt()).clamp(least, most)
}

/// Wanted sizes at some vertices by the sizing rule, before grading. Caps take the longest; grading brings them down.
pub(crate) fn measure(fabric: &mut Fabric<'_>, vertices: &[u32], rule: &Rule, ctx: &Ctx) -> Result<(), Error> {
    let sizes: Vec<(f64, usize)> = match rule.sizing {
        Sizing::Uniform(h) => vec![(h, 0); vertices.len()],
        Sizing::Curvature => ctx.map(vertices, |&v| {
            let (wall, plane) = match fabric.seat(v) {
                Seat::Face(tie) => (tie.wall, None),
                Seat::Crease(tie, _) => (tie.wall, tie.planes[0].or(tie.planes[1])),
                Seat::Fixed => (true, None),
            };
            if !wall {
                return (rule.edge_mm[1], 0);
            }
            let (_, g, hessian) = fabric.field.hessian(P3::from_raw(fabric.web.at[v as usize]));
            let along = plane.map_or(0.0, |p| curve_curvature(g.raw(), hessian, p.normal));
            (edge_for(largest_curvature(g.raw(), hessian).max(along), rule.max_error_mm, rule.edge_mm), 1)
        })?,
    };
    for (&v, (h, evaluations)) in vertices.iter().zip(sizes) {
        if !h.is_finite() {
            return Err(Error::NotFinite { at: P3::from_raw(fabric.web.at[v as usize]) });
        }
        fabric.size[v as usize] = h;
        fabric.hessians += evaluations;
    }
    Ok(())
}

/// What sizes follow.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rule {
    pub(crate) sizing: Sizing,
    pub(crate) edge_mm: [f64; 2],
    pub(crate) max_error_mm: f64,
}

/// Limit the growth of sizes along edges: the largest function below the present sizes with slope [`GRADING`].
pub(crate) fn grade(fabric: &mut Fabric<'_>) {
    // Positive floats order as their bits do.
    let mut open: BinaryHeap<Reverse<(u64, u32)>> =
        fabric.living().into_iter().map(|v| Reverse((fabric.size[v as usize].to_bits(), v))).collect();
    while let Some(Reverse((bits, v))) = open.pop() {
        if bits != fabric.size[v as usize].to_bits() {
            continue;
        }
        let reached: Vec<(u32, f64)> = (fabric.web.spokes(v))
            .map(|h| (fabric.web.target(h), fabric.size[v as usize] + GRADING * fabric.web.length(h)))
            .collect();
        for (u, size) in reached {
            if size < fabric.size[u as usize] {
                fabric.size[u as usize] = size;
                open.push(Reverse((size.to_bits(), u)));
            }
        }
    }
}
