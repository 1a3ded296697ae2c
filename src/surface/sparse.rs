//! The cotangent Laplacian of some triangles, and its solution by a sparse Cholesky factor.
//!
//! One thread, so the bytes do not depend on the machine's parallelism; 10,000 unknowns take some 20 ms, 300,000 a few
//! seconds. Rejected: conjugate gradients with the diagonal as preconditioner; their iterations grow with the number of
//! vertices along the vessel, and an aorta's tree took ten minutes.

use crate::{Error, TriMesh};
use exec::Ctx;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::cholesky::{SymmetricOrdering, factorize_symbolic_cholesky};
use faer::sparse::{SparseColMat, Triplet};
use faer::{ColMut, Conj, Par, Side};

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
    harmonic_by(mesh, triangles, given, jump, |t| half_cotangents(mesh, t), ctx)
}

/// As [`harmonic`] with other weights, in the order of [`half_cotangents`].
pub(crate) fn harmonic_by(
    mesh: &TriMesh,
    triangles: &[usize],
    given: &[Option<f64>],
    jump: impl Fn(usize, usize) -> f64,
    weights: impl Fn(usize) -> [f64; 3],
    ctx: &Ctx,
) -> Result<Vec<f64>, Error> {
    let (diagonal, b) = (vec![0.0; mesh.vertices.len()], vec![0.0; mesh.vertices.len()]);
    minimum(System { mesh, triangles, given, diagonal, b }, jump, weights, ctx)
}

/// Values after heat has flowed for a time, mm2, in one implicit step; no flow through the border but to given values.
pub(crate) fn diffused(
    mesh: &TriMesh,
    start: &[f64],
    given: &[Option<f64>],
    time: f64,
    ctx: &Ctx,
) -> Result<Vec<f64>, Error> {
    let all: Vec<usize> = (0..mesh.triangles.len()).collect();
    let mut mass = vec![0.0; start.len()];
    for &t in &all {
        // A third of its area to each corner.
        let share = mesh.area_vector(t).length() / (6.0 * time);
        mesh.triangles[t].iter().for_each(|&v| mass[v as usize] += share);
    }
    let b = mass.iter().zip(start).map(|(m, s)| m * s).collect();
    let system = System { mesh, triangles: &all, given, diagonal: mass, b };
    minimum(system, |_, _| 0.0, |t| half_cotangents(mesh, t), ctx)
}

/// What is solved, but for the weights.
struct System<'a> {
    mesh: &'a TriMesh,
    triangles: &'a [usize],
    given: &'a [Option<f64>],
    diagonal: Vec<f64>,
    b: Vec<f64>,
}

/// Minimise half x A x - b x, A being the weights' Laplacian and a diagonal.
fn minimum(
    system: System<'_>,
    jump: impl Fn(usize, usize) -> f64,
    weights: impl Fn(usize) -> [f64; 3],
    ctx: &Ctx,
) -> Result<Vec<f64>, Error> {
    let System { mesh, triangles, given, mut diagonal, mut b } = system;
    let n = mesh.vertices.len();
    let mut row: Vec<Vec<(u32, f64)>> = vec![Vec::new(); n];
    for &t in triangles {
        let (w, c) = (weights(t), mesh.triangles[t]);
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
    let mut x: Vec<f64> = vec![0.0; n];
    if !free.is_empty() {
        ctx.check()?;
        let solution = solved(&free, &row, &diagonal, &b)?;
        free.iter().zip(solution).for_each(|(&i, s)| x[i] = s);
    }
    ctx.check()?;
    for (x, g) in x.iter_mut().zip(given) {
        *x = g.unwrap_or(*x);
    }
    Ok(x)
}

/// Solve the free rows; the pattern of `row` is symmetric and may name an entry twice (the two sides of an edge).
fn solved(free: &[usize], row: &[Vec<(u32, f64)>], diagonal: &[f64], b: &[f64]) -> Result<Vec<f64>, Error> {
    let mut number = vec![usize::MAX; row.len()];
    free.iter().enumerate().for_each(|(k, &i)| number[i] = k);
    let mut entries: Vec<Triplet<usize, usize, f64>> = Vec::with_capacity(4 * free.len());
    for (k, &i) in free.iter().enumerate() {
        entries.push(Triplet::new(k, k, diagonal[i]));
        let below = row[i].iter().map(|&(j, w)| (number[j as usize], w)).filter(|&(j, _)| j < k);
        entries.extend(below.map(|(j, w)| Triplet::new(k, j, w)));
    }
    let fault = |e: &dyn std::fmt::Debug| Error::PatchSolve { unknowns: free.len(), reason: format!("{e:?}") };
    let a =
        SparseColMat::<usize, f64>::try_new_from_triplets(free.len(), free.len(), &entries).map_err(|e| fault(&e))?;
    let (side, par) = (Side::Lower, Par::Seq);
    let symbolic = factorize_symbolic_cholesky(a.symbolic(), side, SymmetricOrdering::Amd, Default::default())
        .map_err(|e| fault(&e))?;
    let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(par, Default::default());
    let scratch = scratch.or(symbolic.solve_in_place_scratch::<f64>(1, par));
    let mut memory = MemBuffer::try_new(scratch).map_err(|e| fault(&e))?;
    let mut values = vec![0.0; symbolic.len_val()];
    let factor = symbolic
        .factorize_numeric_llt(
            &mut values,
            a.as_ref(),
            side,
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|e| fault(&e))?;
    let mut x: Vec<f64> = free.iter().map(|&i| b[i]).collect();
    factor.solve_in_place_with_conj(
        Conj::No,
        ColMut::from_slice_mut(&mut x).as_mat_mut(),
        par,
        MemStack::new(&mut memory),
    );
    Ok(x)
}
