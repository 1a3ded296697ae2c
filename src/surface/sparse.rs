//! The cotangent Laplacian of some triangles, and conjugate gradients on it.
//!
//! Own conjugate gradients (Jacobi preconditioner) instead of a sparse factorisation: one thread, a fixed order of
//! sums, so the bytes do not depend on the machine's parallelism; 10,000 unknowns take a few hundred iterations, tens of
//! milliseconds.

use crate::{Error, TriMesh};
use exec::Ctx;

/// Relative residual at which the solution is accepted: u and v are wanted to 1e-6.
const TOLERANCE: f64 = 1e-10;

/// Half the cotangents of a triangle's angles; entry k belongs to the edge opposite to corner k. The Dirichlet energy
/// of a linear function on the triangle is half the sum of weight times squared difference along the edge.
pub(crate) fn half_cotangents(mesh: &TriMesh, t: usize) -> [f64; 3] {
    let p = mesh.corners(t).map(|p| p.raw());
    let doubled = mesh.area_vector(t).length().max(f64::MIN_POSITIVE);
    [0, 1, 2].map(|k| 0.5 * (p[(k + 1) % 3] - p[k]).dot(p[(k + 2) % 3] - p[k]) / doubled)
}

/// Minimise the Dirichlet energy over some triangles with some vertices given.
///
/// `given` holds the value of fixed vertices and `None` for free ones; `jump` the offset of a corner's value from its
/// vertex's (for functions with a cut). Vertices outside the triangles come back as 0.
pub(crate) fn harmonic(
    mesh: &TriMesh,
    triangles: &[usize],
    given: &[Option<f64>],
    jump: impl Fn(usize, usize) -> f64,
    ctx: &Ctx,
) -> Result<Vec<f64>, Error> {
    let n = mesh.vertices.len();
    let mut row: Vec<Vec<(u32, f64)>> = vec![Vec::new(); n];
    let mut diagonal = vec![0.0; n];
    let mut b = vec![0.0; n];
    for &t in triangles {
        let (w, c) = (half_cotangents(mesh, t), mesh.triangles[t]);
        for (k, &weight) in w.iter().enumerate() {
            let (ki, kj) = ((k + 1) % 3, (k + 2) % 3);
            for (ki, kj) in [(ki, kj), (kj, ki)] {
                let (i, j) = (c[ki] as usize, c[kj] as usize);
                diagonal[i] += weight;
                b[i] += weight * (jump(t, kj) - jump(t, ki));
                match given[j] {
                    Some(x) => b[i] += weight * x,
                    None => row[i].push((c[kj], -weight)),
                }
            }
        }
    }
    let free: Vec<usize> = (0..n).filter(|&i| given[i].is_none() && diagonal[i] > 0.0).collect();
    let times = |x: &[f64], i: usize| row[i].iter().fold(diagonal[i] * x[i], |s, &(j, w)| s + w * x[j as usize]);
    let mut x: Vec<f64> = vec![0.0; n];
    let dot = |a: &[f64], b: &[f64]| free.iter().fold(0.0, |s, &i| s + a[i] * b[i]);
    let mut r = b.clone();
    let goal = dot(&b, &b).sqrt() * TOLERANCE;
    let mut z = vec![0.0; n];
    let mut p = vec![0.0; n];
    let (mut rz, most) = (0.0, 20 * free.len() + 100);
    let mut left = dot(&r, &r).sqrt();
    for round in 0..most {
        if left <= goal {
            break;
        }
        ctx.check()?;
        free.iter().for_each(|&i| z[i] = r[i] / diagonal[i]);
        let now = dot(&r, &z);
        let beta = if round == 0 { 0.0 } else { now / rz };
        rz = now;
        free.iter().for_each(|&i| p[i] = z[i] + beta * p[i]);
        let mut q = vec![0.0; n];
        free.iter().for_each(|&i| q[i] = times(&p, i));
        let alpha = rz / dot(&p, &q);
        free.iter().for_each(|&i| {
            x[i] += alpha * p[i];
            r[i] -= alpha * q[i];
        });
        left = dot(&r, &r).sqrt();
    }
    if left > 1e3 * goal || !left.is_finite() {
        return Err(Error::PatchSolve { iterations: most, residual: left / goal * TOLERANCE });
    }
    for (x, g) in x.iter_mut().zip(given) {
        *x = g.unwrap_or(*x);
    }
    Ok(x)
}
