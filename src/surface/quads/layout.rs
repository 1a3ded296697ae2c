//! The wall as annuli: which branch each part belongs to, and the curves between them.
//!
//! The wall is cut open along the given sections (loops of the vessel, long vessels between two junctions). Every piece is
//! then a sphere with k holes. With two it is an annulus. With more, h_i is harmonic, 1 on hole i and 0 on the others, and
//! a point belongs to the hole with the largest w_i h_i; the curves of equality are drawn into the triangles. The weights
//! make up for branches of unequal length: the fluxes F_ij between holes are those of a star of conductances, F_ij =
//! g_i g_j / sum g, so that h_i = g_i / sum g where the branches meet, and w_i = 1 / g_i puts the curves there.

use super::sheet::{Crossings, NONE, Sheet, edge};
use crate::land::Flat;
use crate::sparse::{diffused, half_cotangents, harmonic};
use crate::web::next;
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use glam::DVec3;
use implicit::Field;
use space::P3;
use std::collections::{BTreeMap, BTreeSet};

/// A part of the wall with two ends: vertices around each, sheet on the left; the first end has the curves of equality
/// where there are any.
pub(crate) struct Region {
    pub(crate) sheet: Sheet,
    pub(crate) ends: [Vec<u32>; 2],
    /// Number of the cap (face id - 1) at which it ends, or caps + number of the section.
    pub(crate) branch: u32,
}

/// The whole wall.
pub(crate) struct Layout {
    pub(crate) regions: Vec<Region>,
    /// Roots of the poles.
    pub(crate) poles: BTreeSet<u32>,
    /// Face id of the cap at whose rim a root lies.
    pub(crate) rim: BTreeMap<u32, u32>,
}

/// Curves keep this part of an edge away from its ends, so that no triangle is without area.
const APART: f64 = 0.02;
/// Tries with other weights, and how much less a region weighs that has too many ends.
const TRIES: usize = 16;
const LIGHTER: f64 = 0.15;

pub(crate) fn fault(reason: String, at: DVec3) -> Error {
    Error::Patches { reason, at: P3::from_raw(at) }
}

/// Divide the wall of a closed mesh with caps; another `attempt` divides its junctions in another way.
///
/// # Errors
/// [`Error::Patches`] where no division into annuli was found, [`Error::PatchSolve`], [`Error::Cancelled`].
pub(crate) fn layout(
    mesh: &TriMesh,
    field: &dyn Field,
    sections: &[Flat],
    attempt: usize,
    ctx: &Ctx,
) -> Result<Layout, Error> {
    let caps = mesh.face_id.iter().copied().max().unwrap_or(WALL);
    let mut rim = BTreeMap::new();
    for (tri, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != WALL) {
        tri.iter().for_each(|&v| _ = rim.insert(v, id));
    }
    let mut fresh = mesh.vertices.len() as u32;
    let mut sheet = Sheet::wall(mesh);
    let mut curve = BTreeSet::new();
    let mut section_of = BTreeMap::new();
    for (k, plane) in sections.iter().enumerate() {
        let Some(crossings) = section(&sheet, plane, &curve) else {
            let reason = "the section of a vessel between two junctions does not close".to_owned();
            return Err(fault(reason, plane.point));
        };
        let from = fresh;
        let drawn = sheet.drawn(&crossings, &mut fresh);
        (from..fresh).for_each(|root| _ = section_of.insert(root, caps + k as u32));
        curve.extend(drawn.curve);
        sheet = drawn.sheet;
    }
    let mut out = Layout { regions: Vec::new(), poles: BTreeSet::new(), rim };
    for piece in sheet.opened(&curve) {
        ctx.check()?;
        let branch = |ring: &[u32], sheet: &Sheet| {
            let root = sheet.root[ring[0] as usize];
            let cap = out.rim.get(&root).map(|id| id - 1);
            cap.or(section_of.get(&root).copied()).unwrap_or(0)
        };
        let branches: Vec<u32> = piece.loops().iter().map(|ring| branch(ring, &piece)).collect();
        divide(piece, field, (&branches, attempt), &mut fresh, &mut out, ctx)?;
    }
    Ok(out)
}

/// The loop in which a plane cuts the vessel around its point.
fn section(sheet: &Sheet, plane: &Flat, taken: &BTreeSet<(u32, u32)>) -> Option<Crossings> {
    let height: Vec<f64> = (0..sheet.root.len() as u32).map(|v| plane.height(sheet.place(v))).collect();
    let part = |h: u32| {
        let (a, b) = (sheet.origin(h), sheet.target(h));
        let (p, q) = (height[a as usize], height[b as usize]);
        ((p < 0.0) != (q < 0.0)).then(|| {
            let part = p / (p - q);
            (sheet.place(a).lerp(sheet.place(b), part), if a < b { part } else { 1.0 - part })
        })
    };
    let nearest = (0..sheet.twin.len() as u32)
        .filter_map(|h| part(h).map(|(at, _)| (at.distance(plane.point), h)))
        .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))?;
    let mut out = Crossings::default();
    let mut now = nearest.1;
    loop {
        let (at, part_here) = part(now)?;
        let key = edge(sheet.origin(now), sheet.target(now));
        if taken.contains(&key) || at.distance(plane.point) > plane.reach {
            return None;
        }
        if out.on_edge.insert(key, part_here.clamp(APART, 1.0 - APART)).is_some() {
            return (now == nearest.1 || sheet.twin[now as usize] == nearest.1).then_some(out);
        }
        let other = [next(now), next(next(now))].into_iter().find(|&h| part(h).is_some())?;
        now = sheet.twin[other as usize];
        if now == NONE {
            return None;
        }
    }
}

/// One annulus per hole of a piece.
fn divide(
    piece: Sheet,
    field: &dyn Field,
    (branches, attempt): (&[u32], usize),
    fresh: &mut u32,
    out: &mut Layout,
    ctx: &Ctx,
) -> Result<(), Error> {
    let loops = piece.loops();
    let at = piece.mesh.vertices.first().map_or(DVec3::ZERO, |p| p.raw());
    let genus = 2 - loops.len() as i64 - piece.euler();
    if genus != 0 {
        return Err(fault("a part of the wall has a loop that no section opens".to_owned(), at));
    }
    match &loops[..] {
        [] => Err(fault("a closed piece has no end to start from".to_owned(), at)),
        [_] => Err(fault("a part of the wall has one end only, as a blind sac has".to_owned(), at)),
        [a, b] => {
            let (ends, branch) = ([a.clone(), b.clone()], branches[0].min(branches[1]));
            out.regions.push(Region { sheet: piece, ends, branch });
            Ok(())
        }
        _ => star((&piece, field), &loops, (branches, attempt), fresh, out, ctx),
    }
}

/// A piece with three holes or more.
fn star(
    (piece, field): (&Sheet, &dyn Field),
    loops: &[Vec<u32>],
    (branches, attempt): (&[u32], usize),
    fresh: &mut u32,
    out: &mut Layout,
    ctx: &Ctx,
) -> Result<(), Error> {
    let k = loops.len();
    let mut hole = vec![None; piece.root.len()];
    for (i, ring) in loops.iter().enumerate() {
        ring.iter().for_each(|&v| hole[v as usize] = Some(i));
    }
    let all: Vec<usize> = (0..piece.mesh.triangles.len()).collect();
    let mut h = ctx
        .map_range(k - 1, |i| {
            let given: Vec<Option<f64>> = hole.iter().map(|o| o.map(|o| f64::from(u8::from(o == i)))).collect();
            harmonic(&piece.mesh, &all, &given, |_, _| 0.0, ctx)
        })?
        .into_iter()
        .collect::<Result<Vec<_>, _>>()?;
    h.push((0..hole.len()).map(|v| h.iter().fold(1.0, |s, h| s - h[v])).collect());
    let girth = |ring: &Vec<u32>| {
        let n = ring.len();
        (0..n).fold(0.0, |s, i| s + piece.place(ring[i]).distance(piece.place(ring[(i + 1) % n])))
    };
    let radius = loops.iter().map(girth).fold(f64::INFINITY, f64::min) / std::f64::consts::TAU;
    let star = Star { piece, field, h, hole, branches, time: (FLOW * radius).powi(2) };
    let base = conductances(piece, &star.h);
    let mut found: Vec<Divided> = star.divided(base.clone(), *fresh, ctx)?.into_iter().collect();
    // With four vessels or more in a plane two poles may all but meet: one vessel a little heavier keeps them apart.
    let heavier = HEAVIER.iter().flat_map(|&by| (0..k).map(move |i| (i, by)));
    for (i, by) in heavier.filter(|_| k > 3 || attempt > 0) {
        ctx.check()?;
        let mut weigh = base.clone();
        weigh[i] -= by;
        found.extend(star.divided(weigh, *fresh, ctx)?);
    }
    if k > 3 {
        found.sort_by(|a, b| b.shortest.total_cmp(&a.shortest));
    }
    let best = found.into_iter().nth(attempt);
    let Some(divided) = best else {
        let at = loops.iter().fold(DVec3::ZERO, |s, ring| s + piece.place(ring[0])) / k as f64;
        return Err(fault(format!("no division of a junction of {k} vessels into one annulus for each was found"), at));
    };
    out.poles.extend(divided.poles);
    out.regions.extend(divided.regions);
    *fresh = divided.fresh;
    Ok(())
}

/// How much heavier, as a logarithm.
const HEAVIER: [f64; 3] = [0.1, 0.2, 0.4];

/// A piece with its harmonic functions.
struct Star<'a> {
    piece: &'a Sheet,
    field: &'a dyn Field,
    h: Vec<Vec<f64>>,
    hole: Vec<Option<usize>>,
    branches: &'a [u32],
    /// Time of the heat's flow, mm2.
    time: f64,
}

/// Its division by some weights.
struct Divided {
    regions: Vec<Region>,
    /// Roots.
    poles: Vec<u32>,
    /// The next free root.
    fresh: u32,
    /// Length of the shortest curve between two poles, mm.
    shortest: f64,
}

impl Star<'_> {
    /// Divide by weights exp(-x); regions with too many ends are made lighter until every region is an annulus.
    fn divided(&self, mut weigh: Vec<f64>, fresh: u32, ctx: &Ctx) -> Result<Option<Divided>, Error> {
        for _ in 0..TRIES {
            let score = self.score(&weigh, ctx)?;
            let label = labels(&score, &self.hole);
            let (mut number, mut regions, mut sound) = (fresh, Vec::new(), true);
            let mut drawn = self.piece.drawn(&crossings(self.piece, &score, &label), &mut number);
            drawn.relax(self.field);
            for part in drawn.sheet.opened(&drawn.curve) {
                match annulus(part, self.piece, &self.hole, self.branches) {
                    Ok(region) => regions.push(region),
                    Err(too_many) => {
                        sound = false;
                        too_many.into_iter().for_each(|i| weigh[i] += LIGHTER);
                    }
                }
            }
            if sound && regions.len() == self.h.len() {
                let poles: Vec<u32> = drawn.poles.iter().map(|&v| drawn.sheet.root[v as usize]).collect();
                let shortest = regions.iter().map(|r| shortest(r, &poles)).fold(f64::INFINITY, f64::min);
                return Ok(Some(Divided { regions, poles, fresh: number, shortest }));
            }
        }
        Ok(None)
    }

    /// How much each vertex belongs to each hole: shares h_i^s exp(-s x_i) of a whole, after heat has flowed. Borders
    /// between diffused shares meet at 120 degrees (Merriman, Bence and Osher 1992); those of the harmonic functions
    /// themselves meet at any angle, 2 degrees in one of twelve random vessels.
    fn score(&self, weigh: &[f64], ctx: &Ctx) -> Result<Vec<Vec<f64>>, Error> {
        let n = self.hole.len();
        let k = weigh.len();
        let share = |v: usize| -> Vec<f64> {
            let raw = (0..k).map(|i| (self.h[i][v].max(0.0) * (-weigh[i]).exp()).powf(SHARP));
            let raw: Vec<f64> = raw.collect();
            let whole = raw.iter().fold(f64::MIN_POSITIVE, |s, r| s + r);
            raw.iter().map(|r| r / whole).collect()
        };
        let shares: Vec<Vec<f64>> = (0..n).map(share).collect();
        let mut out = ctx
            .map_range(k - 1, |i| {
                let start: Vec<f64> = shares.iter().map(|s| s[i]).collect();
                let given: Vec<Option<f64>> =
                    self.hole.iter().map(|o| o.map(|o| f64::from(u8::from(o == i)))).collect();
                diffused(&self.piece.mesh, &start, &given, self.time, ctx)
            })?
            .into_iter()
            .collect::<Result<Vec<_>, _>>()?;
        out.push((0..n).map(|v| out.iter().fold(1.0, |s, h| s - h[v])).collect());
        Ok(out)
    }
}

/// Exponent of the shares: the border is then a tenth of a radius wide.
const SHARP: f64 = 6.0;
/// Way of the heat, part of the smallest hole's radius.
const FLOW: f64 = 0.8;

/// The shortest way between two poles along a region's first end.
fn shortest(region: &Region, poles: &[u32]) -> f64 {
    let ring = &region.ends[0];
    let n = ring.len();
    let is_pole = |i: usize| poles.contains(&region.sheet.root[ring[i % n] as usize]);
    let Some(start) = (0..n).find(|&i| is_pole(i)) else { return f64::INFINITY };
    let (mut way, mut least) = (0.0, f64::INFINITY);
    for i in start..start + n {
        way += region.sheet.place(ring[i % n]).distance(region.sheet.place(ring[(i + 1) % n]));
        if is_pole(i + 1) {
            least = f64::min(least, way);
            way = 0.0;
        }
    }
    least
}

/// log g_i up to a constant: least squares of log F_ij = x_i + x_j, with the fluxes from the Dirichlet energies.
fn conductances(piece: &Sheet, h: &[Vec<f64>]) -> Vec<f64> {
    let k = h.len();
    let mut flux = vec![vec![0.0; k]; k];
    for (t, tri) in piece.mesh.triangles.iter().enumerate() {
        for (c, w) in half_cotangents(&piece.mesh, t).into_iter().enumerate() {
            let (p, q) = (tri[(c + 1) % 3] as usize, tri[(c + 2) % 3] as usize);
            for i in 0..k {
                for j in (0..k).filter(|&j| j != i) {
                    flux[i][j] -= w * (h[i][p] - h[i][q]) * (h[j][p] - h[j][q]);
                }
            }
        }
    }
    let row: Vec<f64> =
        (0..k).map(|i| (0..k).filter(|&j| j != i).map(|j| flux[i][j].max(1e-12).ln()).sum::<f64>()).collect();
    let whole = row.iter().fold(0.0, |s, r| s + r) / (2 * k - 2) as f64;
    row.iter().map(|r| (r - whole) / (k - 2) as f64).collect()
}

fn labels(score: &[Vec<f64>], hole: &[Option<usize>]) -> Vec<usize> {
    let largest = |v: usize| (0..score.len()).fold(0, |b, i| if score[i][v] > score[b][v] { i } else { b });
    hole.iter().enumerate().map(|(v, h)| h.unwrap_or_else(|| largest(v))).collect()
}

/// Where two scores are equal along an edge between two labels, and three within a triangle between three.
fn crossings(piece: &Sheet, score: &[Vec<f64>], label: &[usize]) -> Crossings {
    let mut out = Crossings::default();
    for (t, tri) in piece.mesh.triangles.iter().enumerate() {
        let l = tri.map(|v| label[v as usize]);
        for k in 0..3 {
            let (a, b) = edge(tri[k], tri[(k + 1) % 3]);
            let (i, j) = (label[a as usize], label[b as usize]);
            if i != j {
                let lead = |v: u32| score[i][v as usize] - score[j][v as usize];
                let part = lead(a) / (lead(a) - lead(b));
                let part = if part.is_finite() { part.clamp(APART, 1.0 - APART) } else { 0.5 };
                out.on_edge.insert((a, b), part);
            }
        }
        if l[0] != l[1] && l[1] != l[2] && l[2] != l[0] {
            let x = [0, 1, 2].map(|k| {
                let (a, b) = edge(tri[k], tri[(k + 1) % 3]);
                let part = out.on_edge.get(&(a, b)).copied().unwrap_or(0.5);
                piece.place(a).lerp(piece.place(b), part)
            });
            out.pole.insert(t, pole(tri.map(|v| l.map(|i| score[i][v as usize])), tri.map(|v| piece.place(v)), x));
        }
    }
    out
}

/// The point of a triangle at which three linear functions are equal, or the middle of the crossings where that lies
/// outside of their triangle.
fn pole(score: [[f64; 3]; 3], corner: [DVec3; 3], crossing: [DVec3; 3]) -> DVec3 {
    // Barycentric b: sum b = 1, and the differences of the scores vanish.
    let lead = |v: usize| [score[v][0] - score[v][1], score[v][1] - score[v][2]];
    let [p, q, r] = [lead(0), lead(1), lead(2)].map(|l| DVec3::new(l[0], l[1], 1.0));
    let m = glam::DMat3::from_cols(p, q, r);
    let b = m.inverse() * DVec3::Z;
    let middle = (crossing[0] + crossing[1] + crossing[2]) / 3.0;
    if b.is_finite() && b.min_element() > APART { corner[0] * b.x + corner[1] * b.y + corner[2] * b.z } else { middle }
}

/// A part as an annulus between its hole and the curves; otherwise the holes whose regions have too many ends.
fn annulus(part: Sheet, piece: &Sheet, hole: &[Option<usize>], branches: &[u32]) -> Result<Region, Vec<usize>> {
    let of_root: BTreeMap<u32, usize> =
        hole.iter().enumerate().filter_map(|(v, h)| h.map(|h| (piece.root[v], h))).collect();
    let loops = part.loops();
    let owner = |ring: &Vec<u32>| of_root.get(&part.root[ring[0] as usize]).copied();
    let holes: Vec<usize> = loops.iter().filter_map(owner).collect();
    match (&loops[..], &holes[..]) {
        ([a, b], &[i]) if part.euler() == 0 => {
            let ends = if owner(a).is_none() { [a.clone(), b.clone()] } else { [b.clone(), a.clone()] };
            Ok(Region { sheet: part, ends, branch: branches[i] })
        }
        _ => Err(holes),
    }
}
