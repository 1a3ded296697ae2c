//! Coordinates of an annulus: u harmonic, 0 on its first end and 1 on its second; v its conjugate, growing by 1 around.

use super::layout::{Region, fault};
use super::sheet::{NONE, Sheet};
use crate::Error;
use crate::sparse::{half_cotangents, harmonic_by};
use crate::web::{next, prev};
use exec::Ctx;
use glam::DVec3;
use std::collections::VecDeque;

/// A region unrolled onto the strip 0 <= u <= 1, v periodic; (v, u) is right-handed seen from outside.
pub(crate) struct Chart {
    at: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    /// Per triangle and corner (v, u), v continuous within the triangle.
    place: Vec<[[f64; 2]; 3]>,
    /// Triangles by cell of [`CELLS`] x [`CELLS`], with the turns to be added to v.
    cells: Vec<Vec<(u32, f64)>>,
    /// Around each end in the direction of growing v: vertex, and its v (one turn from first to last, the last being the
    /// first again).
    pub(crate) ends: [Vec<(u32, f64)>; 2],
}

const CELLS: usize = 64;

impl Chart {
    pub(crate) fn new(region: &Region, ctx: &Ctx) -> Result<Self, Error> {
        let sheet = &region.sheet;
        let n = sheet.root.len();
        let all: Vec<usize> = (0..sheet.mesh.triangles.len()).collect();
        let mut end = vec![None; n];
        for (e, ring) in region.ends.iter().enumerate() {
            ring.iter().for_each(|&v| end[v as usize] = Some(e as f64));
        }
        let weights = positive(sheet);
        let u = harmonic_by(&sheet.mesh, &all, &end, |_, _| 0.0, |t| weights[t], ctx)?;
        let lost = || fault("the two ends of a branch are not joined".to_owned(), sheet.place(region.ends[0][0]));
        let path = path(sheet, &end).ok_or_else(lost)?;
        let jump = jumps(sheet, &path);
        let mut given = vec![None; n];
        given[sheet.origin(path[0]) as usize] = Some(0.0);
        let v = harmonic_by(&sheet.mesh, &all, &given, |t, k| jump[t][k], |t| weights[t], ctx)?;
        let mut place: Vec<[[f64; 2]; 3]> = (sheet.mesh.triangles.iter().zip(&jump))
            .map(|(tri, j)| [0, 1, 2].map(|k| [v[tri[k] as usize] + j[k], u[tri[k] as usize].clamp(0.0, 1.0)]))
            .collect();
        let area =
            place.iter().fold(0.0, |s, [a, b, c]| s + (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]));
        if area < 0.0 {
            place.iter_mut().flatten().for_each(|p| p[0] = -p[0]);
        }
        if let Some(at) = sac(sheet, &place) {
            return Err(fault("a vessel ends blind, as a sac or behind a tight stenosis".to_owned(), at));
        }
        let mut chart = Self {
            at: sheet.mesh.vertices.iter().map(|p| p.raw()).collect(),
            triangles: sheet.mesh.triangles.clone(),
            cells: buckets(&place),
            place,
            ends: [Vec::new(), Vec::new()],
        };
        chart.ends = [0, 1].map(|e| chart.around(sheet, &region.ends[e], e == 1));
        Ok(chart)
    }

    /// One end in the direction of growing v; the loop has the sheet on its left, so the second runs the other way.
    fn around(&self, sheet: &Sheet, ring: &[u32], backwards: bool) -> Vec<(u32, f64)> {
        let n = ring.len();
        let border: std::collections::BTreeMap<u32, u32> = (0..sheet.twin.len() as u32)
            .filter(|&h| sheet.twin[h as usize] == NONE)
            .map(|h| (sheet.origin(h), h))
            .collect();
        let step = |v: u32| {
            border.get(&v).map_or(0.0, |&h| {
                let (t, k) = (h as usize / 3, h as usize % 3);
                self.place[t][(k + 1) % 3][0] - self.place[t][k][0]
            })
        };
        let first = border.get(&ring[0]).map_or(0.0, |&h| self.place[h as usize / 3][h as usize % 3][0]);
        let mut out = vec![(ring[0], first)];
        let mut now = first;
        for i in 0..n {
            now += step(ring[i]);
            out.push((ring[(i + 1) % n], now));
        }
        if backwards {
            out.reverse();
        }
        out
    }

    /// The point at (u, v).
    pub(crate) fn point(&self, u: f64, v: f64) -> DVec3 {
        let v = v.rem_euclid(1.0);
        let cell = |x: f64| ((x * CELLS as f64) as usize).min(CELLS - 1);
        let mut best = (f64::NEG_INFINITY, DVec3::ZERO);
        for &(t, turns) in &self.cells[cell(u) * CELLS + cell(v)] {
            let [a, b, c] = self.place[t as usize].map(|p| [p[0] + turns, p[1]]);
            let area =
                |p: [f64; 2], q: [f64; 2], r: [f64; 2]| (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
            let x = [v, u];
            let whole = area(a, b, c);
            if whole <= 0.0 {
                continue;
            }
            let w = [area(x, b, c) / whole, area(a, x, c) / whole, area(a, b, x) / whole];
            let inside = w[0].min(w[1]).min(w[2]);
            if inside > best.0 {
                let w = w.map(|w| w.max(0.0));
                let p = self.triangles[t as usize].map(|i| self.at[i as usize]);
                best = (inside, (p[0] * w[0] + p[1] * w[1] + p[2] * w[2]) / (w[0] + w[1] + w[2]));
            }
        }
        best.1
    }
}

/// A sac of depth d and radius r shrinks in (u, v) by exp(1.84 d / r): beyond this, two radii and more, its patches
/// would be needles.
const SHRUNK: f64 = 40.0;

/// Where triangles shrink much more than they do in the median.
fn sac(sheet: &Sheet, place: &[[[f64; 2]; 3]]) -> Option<DVec3> {
    let scale = |t: usize| {
        let [a, b, c] = place[t];
        let flat = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
        sheet.mesh.area_vector(t).length() / flat.max(f64::MIN_POSITIVE)
    };
    let mut all: Vec<(f64, usize)> = (0..place.len()).map(|t| (scale(t), t)).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    // One in a hundred may be a sliver beside a curve.
    let &(largest, t) = all.get(all.len() - 1 - all.len() / 100)?;
    let median = all[all.len() / 2].0;
    (largest > SHRUNK * SHRUNK * median).then(|| sheet.place(sheet.mesh.triangles[t][0]))
}

/// Least weight of an edge.
const LEAST: f64 = 0.02;

/// Half the weight of each edge for each of its triangles: the cotangents' sum where it is positive. With positive weights
/// no triangle folds in (u, v) (Gortler, Gotsman, Thurston 2006, on the annulus doubled to a torus); with the
/// cotangents themselves some do, beside obtuse pairs.
fn positive(sheet: &Sheet) -> Vec<[f64; 3]> {
    let own: Vec<[f64; 3]> = (0..sheet.mesh.triangles.len()).map(|t| half_cotangents(&sheet.mesh, t)).collect();
    // The edge opposite to corner k is half-edge k + 1.
    let of = |h: u32| own[h as usize / 3][(h as usize % 3 + 2) % 3];
    let shared = |t: usize, k: usize| {
        let h = (3 * t + (k + 1) % 3) as u32;
        match sheet.twin[h as usize] {
            NONE => of(h).max(LEAST),
            o => 0.5 * (of(h) + of(o)).max(LEAST),
        }
    };
    (0..own.len()).map(|t| [0, 1, 2].map(|k| shared(t, k))).collect()
}

/// Triangles by the cells that their boxes touch.
fn buckets(place: &[[[f64; 2]; 3]]) -> Vec<Vec<(u32, f64)>> {
    let mut cells = vec![Vec::new(); CELLS * CELLS];
    let margin = 1e-9;
    for (t, p) in place.iter().enumerate() {
        let range =
            |k: usize| p.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), q| (lo.min(q[k]), hi.max(q[k])));
        let (v, u) = (range(0), range(1));
        let cell = |x: f64| (x * CELLS as f64).floor().clamp(0.0, CELLS as f64 - 1.0) as usize;
        let mut turns = -v.1.floor();
        while v.0 + turns < 1.0 {
            let (from, to) = (cell(v.0 + turns - margin), cell(v.1 + turns + margin));
            for row in cell(u.0 - margin)..=cell(u.1 + margin) {
                (from..=to).for_each(|c| cells[row * CELLS + c].push((t as u32, turns)));
            }
            turns += 1.0;
        }
    }
    cells
}

/// A shortest path of half-edges from the second end to the first, through the inside.
fn path(sheet: &Sheet, end: &[Option<f64>]) -> Option<Vec<u32>> {
    let first = (0..end.len()).find(|&v| end[v] == Some(1.0))? as u32;
    let mut leaving: Vec<Vec<u32>> = vec![Vec::new(); end.len()];
    // An edge inside has a half-edge from each of its ends.
    for h in (0..sheet.twin.len() as u32).filter(|&h| sheet.twin[h as usize] != NONE) {
        leaving[sheet.origin(h) as usize].push(h);
    }
    let mut came = vec![NONE; end.len()];
    let mut open = VecDeque::from([first]);
    while let Some(v) = open.pop_front() {
        if end[v as usize] == Some(0.0) {
            let (mut path, mut at) = (Vec::new(), v);
            while at != first {
                path.push(came[at as usize]);
                at = sheet.origin(came[at as usize]);
            }
            path.reverse();
            return Some(path);
        }
        for &h in &leaving[v as usize] {
            let o = sheet.target(h);
            if end[o as usize] != Some(1.0) && came[o as usize] == NONE {
                came[o as usize] = h;
                open.push_back(o);
            }
        }
    }
    None
}

/// Per triangle and corner 1 for corners on the path whose triangle lies on its left.
fn jumps(sheet: &Sheet, path: &[u32]) -> Vec<[f64; 3]> {
    let mut jump = vec![[0.0; 3]; sheet.mesh.triangles.len()];
    let mut mark = |h: u32| jump[h as usize / 3][h as usize % 3] = 1.0;
    for (i, &h) in path.iter().enumerate() {
        let back = if i > 0 { sheet.twin[path[i - 1] as usize] } else { NONE };
        let mut s = h;
        loop {
            mark(s);
            s = sheet.twin[prev(s) as usize];
            if s == NONE || s == back {
                break;
            }
        }
    }
    if let Some(&last) = path.last() {
        let mut s = next(last);
        loop {
            mark(s);
            let o = sheet.twin[s as usize];
            if o == NONE {
                break;
            }
            s = next(o);
        }
    }
    jump
}
