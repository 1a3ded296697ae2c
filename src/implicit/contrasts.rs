//! A sparse approximate inverse of the projected system: one contrast per point, after Vecchia and Kaporin.
//!
//! In a farthest-first order, point i is predicted from its k nearest earlier points by universal kriging (the same
//! kernel, the same noise, a linear drift); the prediction's error over its standard deviation is a vector g_i of k + 1
//! weights with P'g_i = 0. The inverse of Q2'(K + D)Q2 is sum g_i g_i' when k takes all earlier points in, and close to it
//! for k = 60 (Kaporin 1994; Schaefer, Katzfuss, Owhadi, arXiv 2004.14455, made intrinsic by the drift): conjugate
//! gradients then need some 15 products where they would need thousands. 12 (k + 1) bytes per unknown.

use crate::Error;
use crate::nearest::{Search, Tree, distance2, farthest_first};
use exec::Ctx;
use pulp::Arch;

/// Neighbours per point; with the point itself and padding the local systems have [`ROOM`] rows.
const NEIGHBOURS: usize = 60;
/// Rows of a local matrix, a multiple of the vector width.
const ROOM: usize = 64;
/// Below this spread (see [`Local::reflect`]) neighbours count as coplanar and the four corners of the order join them.
const FLAT: f64 = 1e-3;
/// Points per parallel chunk.
const CHUNK: usize = 128;

/// The vectors g_i, for all points but the first four of the order.
pub(crate) struct Contrasts {
    /// Per vector [`ROOM`] point numbers would be too many: `NEIGHBOURS + 1`, padded by weight 0.
    index: Vec<u32>,
    weight: Vec<f64>,
    n: usize,
}

const WIDTH: usize = NEIGHBOURS + 1;

impl Contrasts {
    /// For scaled points and noise D.
    ///
    /// # Errors
    /// [`Error::Singular`] where coincident points without noise leave nothing to predict; [`Error::Cancelled`].
    pub(crate) fn new(points: &[[f64; 3]], noise: &[f64], ctx: &Ctx) -> Result<Self, Error> {
        let n = points.len();
        let mut tree = Tree::new(points);
        let order = farthest_first(&tree, ctx)?;
        ctx.progress(0.3);
        let mut rank = vec![0; n];
        order.iter().enumerate().for_each(|(r, &i)| rank[i as usize] = r as u32);
        tree.rank(&rank);
        let later = order.get(4..).unwrap_or_default();
        let chunks = ctx.map_range(later.len().div_ceil(CHUNK), |chunk| {
            let own = &later[chunk * CHUNK..later.len().min((chunk + 1) * CHUNK)];
            let mut local = Local::new();
            let mut search = Search::default();
            let mut out = (vec![0_u32; own.len() * WIDTH], vec![0.0; own.len() * WIDTH]);
            for (row, &i) in own.iter().enumerate() {
                tree.earlier(i as usize, NEIGHBOURS, &rank, &mut search);
                let near = search.found.iter().map(|f| f.1);
                let span = row * WIDTH..(row + 1) * WIDTH;
                let vector = (&mut out.0[span.clone()], &mut out.1[span]);
                local
                    .contrast(points, noise, (i, near, &order[..4]), vector)
                    .map_err(|pivot| Error::Singular { constraints: n, pivot })?;
            }
            Ok::<_, Error>(out)
        })?;
        let (mut index, mut weight) = (Vec::with_capacity(n * WIDTH), Vec::with_capacity(n * WIDTH));
        for chunk in chunks {
            let (i, w): (Vec<u32>, Vec<f64>) = chunk?;
            index.extend(i);
            weight.extend(w);
        }
        ctx.progress(1.0);
        Ok(Self { index, weight, n })
    }

    /// sum g_i (g_i'r), about (K + D)^-1 r within the null space of P'.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub(crate) fn apply(&self, r: &[f64], ctx: &Ctx) -> Result<Vec<f64>, Error> {
        let mut products = vec![0.0; self.weight.len() / WIDTH];
        ctx.chunks_mut(&mut products, 1024, |first, chunk| {
            for (k, o) in chunk.iter_mut().enumerate() {
                let span = (first + k) * WIDTH..(first + k + 1) * WIDTH;
                let pairs = self.index[span.clone()].iter().zip(&self.weight[span]);
                *o = pairs.fold(0.0, |s, (&i, w)| s + w * r[i as usize]);
            }
        })?;
        let mut out = vec![0.0; self.n];
        for (row, p) in products.iter().enumerate() {
            let span = row * WIDTH..(row + 1) * WIDTH;
            for (&i, w) in self.index[span.clone()].iter().zip(&self.weight[span]) {
                out[i as usize] += w * p;
            }
        }
        Ok(out)
    }
}

/// The system of one point and its neighbours.
struct Local {
    /// Point numbers; the point itself comes last.
    member: Vec<u32>,
    /// Column-major, [`ROOM`] rows per column.
    a: Vec<[f64; ROOM]>,
    v: [[f64; ROOM]; 4],
    tau: [f64; 4],
}

impl Local {
    fn new() -> Self {
        Self { member: Vec::new(), a: vec![[0.0; ROOM]; ROOM], v: [[0.0; ROOM]; 4], tau: [0.0; 4] }
    }

    /// Writes g_i; `Err` gives the pivot that was not positive.
    fn contrast(
        &mut self,
        points: &[[f64; 3]],
        noise: &[f64],
        (i, near, corners): (u32, impl Iterator<Item = u32>, &[u32]),
        (index, weight): (&mut [u32], &mut [f64]),
    ) -> Result<(), usize> {
        self.member.clear();
        self.member.extend(near);
        self.member.push(i);
        if self.reflect(points) < FLAT {
            self.widen(i, corners);
            self.reflect(points);
        }
        let m = self.member.len();
        let mut g = [0.0; ROOM];
        g[m - 1] = 1.0;
        Arch::new().dispatch(|| {
            self.fill(points, noise);
            for k in 0..4 {
                two_sided(&mut self.a, &self.v[k], self.tau[k], m);
                reflect(&self.v[k], self.tau[k], &mut g);
            }
            g[..4].fill(0.0);
            factor_and_solve(&mut self.a, &mut g, m)?;
            for k in (0..4).rev() {
                reflect(&self.v[k], self.tau[k], &mut g);
            }
            Ok::<(), usize>(())
        })?;
        // g_i of the projector's inverse has the weight of its own point as its squared norm
        let own = g[m - 1];
        if own.is_nan() || own <= 0.0 {
            return Err(m - 1);
        }
        let scale = 1.0 / own.sqrt();
        index.fill(i);
        for (k, &j) in self.member.iter().enumerate() {
            (index[k], weight[k]) = (j, g[k] * scale);
        }
        Ok(())
    }

    /// Replaces the farthest neighbours by the corners of the order, where they are not among them.
    fn widen(&mut self, i: u32, corners: &[u32]) {
        self.member.pop();
        let missing: Vec<u32> = corners.iter().copied().filter(|c| !self.member.contains(c)).collect();
        self.member.truncate(NEIGHBOURS - missing.len());
        self.member.extend(missing);
        self.member.push(i);
    }

    /// Reflections that annihilate the local P; gives the smallest |R_kk| over sqrt(m), with coordinates relative to
    /// the point in units of the farthest member's distance.
    fn reflect(&mut self, points: &[[f64; 3]]) -> f64 {
        let m = self.member.len();
        let x = points[self.member[m - 1] as usize];
        let far = self.member.iter().fold(0.0_f64, |f, &j| f.max(distance2(&points[j as usize], &x))).sqrt();
        let unit = if far > 0.0 { 1.0 / far } else { 1.0 };
        let mut p = [[0.0; ROOM]; 4];
        for (row, &j) in self.member.iter().enumerate() {
            p[0][row] = 1.0;
            for a in 0..3 {
                p[a + 1][row] = (points[j as usize][a] - x[a]) * unit;
            }
        }
        let mut least = f64::INFINITY;
        for k in 0..4 {
            let norm = p[k][k..].iter().fold(0.0, |s, x| s + x * x).sqrt();
            let alpha = if p[k][k] > 0.0 { -norm } else { norm };
            let mut v = p[k];
            v[..k].fill(0.0);
            v[k] -= alpha;
            let vv = v.iter().fold(0.0, |s, x| s + x * x);
            self.tau[k] = if vv > 0.0 { 2.0 / vv } else { 0.0 };
            self.v[k] = v;
            for column in p.iter_mut().skip(k) {
                reflect(&v, self.tau[k], column);
            }
            least = least.min(norm);
        }
        least / (m as f64).sqrt()
    }

    /// K + D of the members, all of it.
    #[inline(always)]
    fn fill(&mut self, points: &[[f64; 3]], noise: &[f64]) {
        let mut x = [[0.0; ROOM]; 3];
        for (row, &j) in self.member.iter().enumerate() {
            for a in 0..3 {
                x[a][row] = points[j as usize][a];
            }
        }
        for (column, &j) in self.member.iter().enumerate() {
            let t = points[j as usize];
            let out = &mut self.a[column];
            for l in 0..ROOM {
                let d = [x[0][l] - t[0], x[1][l] - t[1], x[2][l] - t[2]];
                let r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                out[l] = r2 * r2.sqrt();
            }
            out[column] += noise[j as usize];
            out[self.member.len()..].fill(0.0);
        }
    }
}

#[inline(always)]
fn reflect(v: &[f64; ROOM], tau: f64, y: &mut [f64; ROOM]) {
    let s = tau * inner(v, y);
    for l in 0..ROOM {
        y[l] -= s * v[l];
    }
}

/// Inner product in eight independent accumulators.
#[inline(always)]
fn inner(a: &[f64; ROOM], b: &[f64; ROOM]) -> f64 {
    let mut acc = [0.0; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for l in 0..8 {
            acc[l] += x[l] * y[l];
        }
    }
    crate::kernel::fold(acc)
}

/// A -> H A H on the leading m columns.
#[inline(always)]
fn two_sided(a: &mut [[f64; ROOM]], v: &[f64; ROOM], tau: f64, m: usize) {
    let mut w = [0.0; ROOM];
    for j in 0..m {
        for l in 0..ROOM {
            w[l] += v[j] * a[j][l];
        }
    }
    w.iter_mut().for_each(|w| *w *= tau);
    let half = 0.5 * tau * inner(v, &w);
    for l in 0..ROOM {
        w[l] -= half * v[l];
    }
    for j in 0..m {
        for l in 0..ROOM {
            a[j][l] -= v[l] * w[j] + w[l] * v[j];
        }
    }
}

/// Cholesky of rows and columns 4..m (lower triangle), then u -> A^-1 u on the same rows.
#[inline(always)]
fn factor_and_solve(a: &mut [[f64; ROOM]], u: &mut [f64; ROOM], m: usize) -> Result<(), usize> {
    for j in 4..m {
        let (done, rest) = a.split_at_mut(j);
        let column = &mut rest[0];
        let from = j / 8 * 8;
        // four columns at once: one pass over the target
        let mut before = done[4..].chunks_exact(4);
        for four in before.by_ref() {
            let f = [four[0][j], four[1][j], four[2][j], four[3][j]];
            for l in from..ROOM {
                column[l] -= (f[0] * four[0][l] + f[1] * four[1][l]) + (f[2] * four[2][l] + f[3] * four[3][l]);
            }
        }
        for one in before.remainder() {
            let f = one[j];
            for l in from..ROOM {
                column[l] -= f * one[l];
            }
        }
        let pivot = column[j];
        if pivot.is_nan() || pivot <= 0.0 {
            return Err(j);
        }
        let root = pivot.sqrt();
        let inverse = 1.0 / root;
        column[from..].iter_mut().for_each(|x| *x *= inverse);
        column[j] = root;
        column[from..j].fill(0.0);
        u[j] *= inverse;
        let uj = u[j];
        for l in j + 1..ROOM {
            u[l] -= uj * column[l];
        }
    }
    for j in (4..m).rev() {
        let below = (j + 1..m).fold(0.0, |s, l| s + a[j][l] * u[l]);
        u[j] = (u[j] - below) / a[j][j];
    }
    Ok(())
}
