//! A sparse approximate inverse of the projected system: one contrast per point, after Vecchia and Kaporin.
//!
//! In a farthest-first order, point i is predicted from its k nearest earlier points by universal kriging (the same
//! kernel, the same noise, a linear drift); the prediction's error over its standard deviation is a vector g_i of k + 1
//! weights with P'g_i = 0. The inverse of Q2'(K + D)Q2 is sum g_i g_i' when k takes all earlier points in, and close to it
//! for k = 60 (Kaporin 1994; Schaefer, Katzfuss, Owhadi, arXiv 2004.14455, made intrinsic by the drift): conjugate
//! gradients then need some 15 products where they would need thousands. 12 (k + 1) bytes per unknown.

use crate::Error;
use crate::nearest::{Search, Tree, distance2, farthest_first};
use crate::wide::{LANES, Wide, apart, fold, widest};
use exec::Ctx;
use pulp::{Simd, WithSimd};

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
        widest(Prediction { local: self, points, noise, g: &mut g })?;
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
                widest(Reflection { v: &v, tau: self.tau[k], y: column });
            }
            least = least.min(norm);
        }
        least / (m as f64).sqrt()
    }
}

/// The error of the prediction of a point from its neighbours: g = (Q2'(K + D)Q2)^-1 e within the null space of P'.
struct Prediction<'a> {
    local: &'a mut Local,
    points: &'a [[f64; 3]],
    noise: &'a [f64],
    /// e, the point itself; then g.
    g: &'a mut [f64; ROOM],
}

impl WithSimd for Prediction<'_> {
    type Output = Result<(), usize>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Result<(), usize> {
        let Self { local, points, noise, g } = self;
        let m = local.member.len();
        fill(simd, local, points, noise);
        for (v, tau) in local.v.iter().zip(local.tau) {
            two_sided(simd, &mut local.a, v, tau, m);
            reflect(simd, v, tau, g);
        }
        g[..4].fill(0.0);
        factor_and_solve(simd, &mut local.a, g, m)?;
        for (v, tau) in local.v.iter().zip(local.tau).rev() {
            reflect(simd, v, tau, g);
        }
        Ok(())
    }
}

/// Vectors of a local column.
const fn parts<S: Simd>() -> usize {
    ROOM / S::F64_LANES
}

/// K + D of the members, all of it.
#[inline(always)]
fn fill<S: Simd>(simd: S, local: &mut Local, points: &[[f64; 3]], noise: &[f64]) {
    let mut x = [[0.0; ROOM]; 3];
    for (row, &j) in local.member.iter().enumerate() {
        for a in 0..3 {
            x[a][row] = points[j as usize][a];
        }
    }
    for (column, &j) in local.member.iter().enumerate() {
        let t = points[j as usize].map(|t| Wide::splat(simd, t));
        let out = &mut local.a[column];
        for part in 0..parts::<S>() {
            let (_, r2) = apart(t, [&x[0], &x[1], &x[2]], part);
            (r2 * r2.sqrt()).put(out, part);
        }
        out[column] += noise[j as usize];
        out[local.member.len()..].fill(0.0);
    }
}

/// [`reflect`] on its own.
struct Reflection<'a> {
    v: &'a [f64; ROOM],
    tau: f64,
    y: &'a mut [f64; ROOM],
}

impl WithSimd for Reflection<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        reflect(simd, self.v, self.tau, self.y);
    }
}

#[inline(always)]
fn reflect<S: Simd>(simd: S, v: &[f64; ROOM], tau: f64, y: &mut [f64; ROOM]) {
    let s = Wide::splat(simd, tau * inner(simd, v, y));
    for part in 0..parts::<S>() {
        (Wide::of(simd, y, part) - s * Wide::of(simd, v, part)).put(y, part);
    }
}

/// Inner product in eight independent accumulators.
#[inline(always)]
fn inner<S: Simd>(simd: S, a: &[f64; ROOM], b: &[f64; ROOM]) -> f64 {
    let mut out = [0.0; LANES];
    for part in 0..Wide::<S>::PARTS {
        let mut acc = Wide::splat(simd, 0.0);
        for at in (part..parts::<S>()).step_by(Wide::<S>::PARTS) {
            acc += Wide::of(simd, a, at) * Wide::of(simd, b, at);
        }
        acc.put(&mut out, part);
    }
    fold(out)
}

/// Vectors of a column whose sums stay in registers together.
const BLOCK: usize = 4;

/// A -> H A H on the leading m columns.
#[inline(always)]
fn two_sided<S: Simd>(simd: S, a: &mut [[f64; ROOM]], v: &[f64; ROOM], tau: f64, m: usize) {
    let mut w = [0.0; ROOM];
    for block in (0..parts::<S>()).step_by(BLOCK) {
        let mut sums = [Wide::splat(simd, 0.0); BLOCK];
        for (column, v) in a[..m].iter().zip(v) {
            let v = Wide::splat(simd, *v);
            (0..BLOCK).for_each(|k| sums[k] += v * Wide::of(simd, column, block + k));
        }
        (0..BLOCK).for_each(|k| sums[k].put(&mut w, block + k));
    }
    w.iter_mut().for_each(|w| *w *= tau);
    let half = 0.5 * tau * inner(simd, v, &w);
    for l in 0..ROOM {
        w[l] -= half * v[l];
    }
    for (column, (vj, wj)) in a[..m].iter_mut().zip(v.iter().zip(w)) {
        let (vj, wj) = (Wide::splat(simd, *vj), Wide::splat(simd, wj));
        for part in 0..parts::<S>() {
            let step = Wide::of(simd, v, part) * wj + Wide::of(simd, &w, part) * vj;
            (Wide::of(simd, column, part) - step).put(column, part);
        }
    }
}

/// Cholesky of rows and columns 4..m (lower triangle), then u -> A^-1 u on the same rows.
#[inline(always)]
fn factor_and_solve<S: Simd>(simd: S, a: &mut [[f64; ROOM]], u: &mut [f64; ROOM], m: usize) -> Result<(), usize> {
    for j in 4..m {
        let (done, rest) = a.split_at_mut(j);
        let column = &mut rest[0];
        let from = subtract(simd, &done[4..], column, j);
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

/// Takes the columns before column j from it, four at once, in the rows after those that it gives; some of them lie
/// above the diagonal.
#[inline(always)]
fn subtract<S: Simd>(simd: S, before: &[[f64; ROOM]], column: &mut [f64; ROOM], j: usize) -> usize {
    let (fours, ones) = before.as_chunks::<4>();
    let first = j / S::F64_LANES / BLOCK * BLOCK;
    for block in (first..parts::<S>()).step_by(BLOCK) {
        let mut left: [Wide<S>; BLOCK] = std::array::from_fn(|k| Wide::of(simd, column, block + k));
        for four in fours {
            let f = four.each_ref().map(|column| Wide::splat(simd, column[j]));
            for (k, left) in left.iter_mut().enumerate() {
                let of = |c: usize| f[c] * Wide::of(simd, &four[c], block + k);
                *left -= (of(0) + of(1)) + (of(2) + of(3));
            }
        }
        for one in ones {
            let f = Wide::splat(simd, one[j]);
            (0..BLOCK).for_each(|k| left[k] -= f * Wide::of(simd, one, block + k));
        }
        (0..BLOCK).for_each(|k| left[k].put(column, block + k));
    }
    first * S::F64_LANES
}
