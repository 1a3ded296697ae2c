//! The wall as quadrilaterals of high order, without drawing: annuli of branches, columns around them, rows along them.
//!
//! [`layout`] divides the wall into annuli (weighted harmonic functions, separating curves drawn into the triangles),
//! [`chart`] gives each its (u, v), [`arcs`] cuts the curves at their ends into segments that neighbours share, so that
//! there are no hanging nodes. Corners and edges come from lines of equal u and v, spaced by length; the inside of a patch
//! is the Coons patch of its edges; every node is landed on f = 0. A patch that lies farther from f than allowed, or whose
//! Jacobian is not proven positive ([`bezier`]), has its row or its column halved: rows go round one annulus, columns run
//! on through separating curves to the next ends. Caps are left out: rims lie in their planes, shared edge by edge.
//!
//! Limits: a branch that ends blind, and a loop for which no section is given, have no such division and say so. Where
//! three separating curves meet (two poles per bifurcation) six patches do, with corners of 60 degrees. A rim that two caps
//! share (a vessel that leaves across an edge of the volume) is followed on f alone, and its corner is cut.
//! Rejected: nodes at equal steps of (u, v) itself. A conformal map is singular at a pole (x ~ w^(2/3)).

mod arcs;
mod bezier;
mod chart;
mod layout;
mod sheet;

use crate::land::{Approach, Flat, Tie, land};
use crate::remesh::cap_planes;
use crate::{Error, TriMesh};
use arcs::{Annulus, Item, Weave};
use bezier::{Basis, Patch};
use chart::Chart;
use exec::Ctx;
use glam::DVec3;
use imaging::CutPlane;
use implicit::Field;
use space::P3;
use std::collections::{BTreeMap, BTreeSet};

/// Settings of [`quads`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QuadSettings {
    /// Order of the patches, 2 to 8. Default 4.
    pub order: usize,
    /// Largest distance of a patch from f = 0, mm. Default .01.
    pub max_error_mm: f64,
    /// Most patches. Default 20,000.
    pub max_quads: usize,
}

impl Default for QuadSettings {
    fn default() -> Self {
        Self { order: 4, max_error_mm: 0.01, max_quads: 20_000 }
    }
}

/// The wall as quadrilaterals.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Quads {
    /// Order of the patches.
    pub order: usize,
    /// Nodes, on f = 0 to 1e-9 mm, LPS mm.
    pub nodes: Vec<P3>,
    /// Per patch (order + 1)^2 nodes, row by row, the first parameter (around the vessel) fastest; seen from outside the
    /// second (towards the end) is to the left of the first. Neighbours name the same nodes along their common edge.
    pub cells: Vec<Vec<u32>>,
    /// Per patch its branch: face id - 1 of the cap at which it ends; caps + k beside section k between junctions.
    pub branch: Vec<u32>,
    /// Where three separating curves meet.
    pub poles: Vec<P3>,
    /// Largest distance of the patches from f = 0, mm (first order, (2 p + 1)^2 points each), and where.
    pub max_error_mm: f64,
    /// Place of the largest distance.
    pub farthest_at: P3,
    /// Least sine between parameter lines over the same points.
    pub least_sine: f64,
    /// Least proven bound of the Jacobian, part of the patch's area.
    pub least_jacobian: f64,
    /// Length of the separating curves, mm.
    pub separating_mm: f64,
}

/// Rounds of halving; each divides the distance by 2^(p + 1) where f is smooth.
const ROUNDS: usize = 14;
/// A patch as far off as this many times the allowed distance is halved both ways at once.
const FAR: f64 = 20.0;

/// Divide the wall of a closed mesh with caps into quadrilaterals of high order.
///
/// `cuts` are the planes of the caps, as for [`crate::remesh`]. `sections` cut vessels that join two junctions, each near
/// its point and within its reach; one at least for every loop.
///
/// The result covers the whole wall; patches meet edge to edge, node to node. Jacobians are positive (proof by Bernstein
/// coefficients), distances from f = 0 at most `max_error_mm`.
///
/// # Errors
/// [`Error::Patches`] with the reason and the place where there is no such division, [`Error::Settings`],
/// [`Error::CapPlane`], [`Error::PatchSolve`], [`Error::NotFinite`], [`Error::Cancelled`].
pub fn quads(
    mesh: &TriMesh,
    field: &dyn Field,
    cuts: &[CutPlane],
    sections: &[CutPlane],
    settings: &QuadSettings,
    ctx: &Ctx,
) -> Result<Quads, Error> {
    if !(2..=8).contains(&settings.order) {
        return Err(Error::Settings { field: "order", value: settings.order as f64, need: "between 2 and 8" });
    }
    if !(settings.max_error_mm.is_finite() && settings.max_error_mm > 0.0) {
        return Err(Error::Settings { field: "max_error_mm", value: settings.max_error_mm, need: "a positive length" });
    }
    crate::web::Web::weave(mesh)?;
    let planes = cap_planes(mesh, cuts)?;
    let sections: Vec<Flat> = sections.iter().filter_map(Flat::of).collect();
    let by = |attempt: usize| woven((mesh, field), (&planes, &sections), attempt, settings, ctx);
    let marks = match by(0)? {
        Ok(out) => return Ok(out),
        Err(marks) => marks,
    };
    for attempt in 1..ATTEMPTS {
        match by(attempt) {
            Ok(Ok(out)) => return Ok(out),
            Ok(Err(_)) => {}
            // no other division
            Err(Error::Patches { .. }) => break,
            Err(e) => return Err(e),
        }
    }
    Err(unsettled(&marks))
}

/// Other divisions are tried where the first one's patches do not settle, one wall in some hundreds.
const ATTEMPTS: usize = 4;

/// Patches on one division of the wall, or what was measured last of those that halving does not mend.
fn woven(
    (mesh, field): (&TriMesh, &dyn Field),
    (planes, sections): (&[Flat], &[Flat]),
    attempt: usize,
    settings: &QuadSettings,
    ctx: &Ctx,
) -> Result<Result<Quads, Vec<Mark>>, Error> {
    let layout = layout::layout(mesh, field, sections, attempt, ctx)?;
    let charts = ctx.map(&layout.regions, |r| Chart::new(r, ctx))?.into_iter().collect::<Result<Vec<_>, _>>()?;
    let mut weave = Weave::new(&layout, charts, planes)?;
    first_rows(&mut weave);
    let basis = Basis::new(settings.order);
    let mut last = Vec::new();
    for round in 0..ROUNDS {
        ctx.progress(round as f64 / ROUNDS as f64);
        let tissue = Tissue::new(&weave, field, &basis, ctx)?;
        last = ctx.map(&tissue.cells, |c| tissue.mark(c, field, &basis))?;
        if let Some(out) = settle(&mut weave, &tissue, &last, settings) {
            ctx.progress(1.0);
            return Ok(Ok(out));
        }
        if weave.patches() > settings.max_quads {
            break;
        }
    }
    Ok(Err(last))
}

/// Halving did not help: where and how far from it.
fn unsettled(marks: &[Mark]) -> Error {
    let by = |a: &&Mark, b: &&Mark| (a.jacobian <= 0.0).cmp(&(b.jacobian <= 0.0)).then(a.error.total_cmp(&b.error));
    let worst = marks.iter().max_by(by).copied().unwrap_or_default();
    let reason = format!(
        "of {} patches the worst lies {:.4} mm from the wall with a Jacobian of {:.1e} of its area, and halving does not \
         mend it",
        marks.len(),
        worst.error,
        worst.jacobian,
    );
    layout::fault(reason, worst.at)
}

/// Rows about as long as columns are wide.
fn first_rows(weave: &mut Weave) {
    for k in 0..weave.annuli.len() {
        let a = &weave.annuli[k];
        let columns = a.items(0, &weave.arcs).len();
        let girth: f64 = a.ends[0].iter().map(|u| weave.arcs[u.arc].length).sum();
        let rows = (a.length * columns as f64 / girth).round().clamp(1.0, 64.0) as usize;
        weave.annuli[k].rows = (0..=rows).map(|r| r as f64 / rows as f64).collect();
    }
}

/// What was measured of a patch.
#[derive(Clone, Copy, Debug, Default)]
struct Mark {
    error: f64,
    at: DVec3,
    jacobian: f64,
    sine: f64,
    roughness: [f64; 2],
}

/// The finished patches, or `None` after halving what is not good enough.
fn settle(weave: &mut Weave, tissue: &Tissue, marks: &[Mark], settings: &QuadSettings) -> Option<Quads> {
    let (mut rows, mut columns) = (BTreeSet::new(), BTreeSet::new());
    for (cell, m) in tissue.cells.iter().zip(marks) {
        let ratio = m.error / settings.max_error_mm;
        let broken = m.jacobian.is_nan() || m.jacobian <= 0.0;
        if ratio.is_nan() || ratio > 1.0 || broken {
            let both = broken || ratio > FAR;
            if both || m.roughness[0] > m.roughness[1] {
                columns.insert((cell.annulus, cell.column));
            }
            if both || m.roughness[1] >= m.roughness[0] {
                rows.insert((cell.annulus, cell.row));
            }
        }
    }
    if !(rows.is_empty() && columns.is_empty()) {
        weave.split_columns(&columns);
        weave.split_rows(&rows);
        return None;
    }
    let worst = marks.iter().max_by(|a, b| a.error.total_cmp(&b.error)).copied().unwrap_or_default();
    let separating = weave.arcs.iter().filter(|a| !a.closed());
    let mut poles: Vec<(u32, DVec3)> = separating
        .clone()
        .flat_map(|a| {
            [(a.roots[0], a.points[0])].into_iter().chain(a.roots.last().copied().zip(a.points.last().copied()))
        })
        .collect();
    poles.sort_by_key(|p| p.0);
    poles.dedup_by_key(|p| p.0);
    Some(Quads {
        order: settings.order,
        nodes: tissue.nodes.iter().map(|&x| P3::from_raw(x)).collect(),
        cells: tissue.cells.iter().map(|c| c.nodes.clone()).collect(),
        branch: tissue.cells.iter().map(|c| weave.annuli[c.annulus].branch).collect(),
        poles: poles.into_iter().map(|p| P3::from_raw(p.1)).collect(),
        max_error_mm: worst.error,
        farthest_at: P3::from_raw(worst.at),
        least_sine: marks.iter().map(|m| m.sine).fold(1.0, f64::min),
        least_jacobian: marks.iter().map(|m| m.jacobian).fold(f64::INFINITY, f64::min),
        separating_mm: separating.map(|a| a.length).sum(),
    })
}

/// One patch.
struct Cell {
    annulus: usize,
    row: usize,
    column: usize,
    nodes: Vec<u32>,
}

/// All patches of one round.
struct Tissue {
    nodes: Vec<DVec3>,
    cells: Vec<Cell>,
}

/// What every annulus needs.
struct Loom<'a> {
    weave: &'a Weave,
    field: &'a dyn Field,
    p: usize,
    ctx: &'a Ctx,
}

/// Samples per node step of a line before it is spaced by length.
const FINE: usize = 4;
/// Longest Newton step of a landing, mm.
const STEP_MM: f64 = 0.5;

impl Tissue {
    fn new(weave: &Weave, field: &dyn Field, basis: &Basis, ctx: &Ctx) -> Result<Self, Error> {
        let mut out = Self { nodes: Vec::new(), cells: Vec::new() };
        let on_arcs = out.arc_nodes(weave, field, basis.order, ctx)?;
        let loom = Loom { weave, field, p: basis.order, ctx };
        for k in 0..weave.annuli.len() {
            ctx.check()?;
            out.fill(&loom, k, &on_arcs)?;
        }
        match out.nodes.iter().find(|x| !x.is_finite()) {
            Some(_) => Err(Error::NotFinite { at: P3::ORIGIN }),
            None => Ok(out),
        }
    }

    fn add(&mut self, x: DVec3) -> u32 {
        self.nodes.push(x);
        self.nodes.len() as u32 - 1
    }

    /// Nodes along every arc; poles and the starts of closed arcs are shared.
    fn arc_nodes(&mut self, weave: &Weave, field: &dyn Field, p: usize, ctx: &Ctx) -> Result<Vec<Vec<u32>>, Error> {
        let wanted: Vec<(usize, f64)> = (weave.arcs.iter().enumerate())
            .flat_map(|(a, arc)| {
                let inner =
                    move |w: &[f64]| (0..p).map(|k| w[0] + (w[1] - w[0]) * k as f64 / p as f64).collect::<Vec<_>>();
                arc.cuts.windows(2).flat_map(inner).chain([1.0]).map(move |part| (a, part))
            })
            .collect();
        let placed = ctx.map(&wanted, |&(a, part)| {
            let arc = &weave.arcs[a];
            land(field, arc.at(part), &arc.tie, Approach::exact(STEP_MM)).at
        })?;
        let mut ends: BTreeMap<u32, u32> = BTreeMap::new();
        let mut out = vec![Vec::new(); weave.arcs.len()];
        for (&(a, part), &x) in wanted.iter().zip(&placed) {
            let roots = &weave.arcs[a].roots;
            let end = if part == 0.0 { roots.first() } else { roots.last().filter(|_| part == 1.0) };
            let id = match end {
                Some(&root) => *ends.entry(root).or_insert_with(|| self.add(x)),
                None => self.add(x),
            };
            out[a].push(id);
        }
        Ok(out)
    }

    /// Nodes and patches of an annulus.
    fn fill(&mut self, loom: &Loom<'_>, k: usize, on_arcs: &[Vec<u32>]) -> Result<(), Error> {
        let Loom { weave, field, p, ctx } = *loom;
        let a = &weave.annuli[k];
        let grid = Grid::new(a, weave);
        let (m, n) = (a.rows.len() - 1, grid.items[0].len());
        let (height, width) = (m * p + 1, n * p);
        let mut id = vec![u32::MAX; height * width];
        for (end, row) in [(0, 0), (1, height - 1)] {
            for (j, i) in grid.items[end].iter().enumerate() {
                for s in 0..p {
                    let along = i.segment * p + if i.forward { s } else { p - s };
                    id[row * width + j * p + s] = on_arcs[i.arc][along];
                }
            }
        }
        let mut set = |out: &mut Self, row: usize, column: usize, x: DVec3| {
            let at = &mut id[row * width + column % width];
            if *at == u32::MAX {
                *at = out.add(x);
            }
        };
        let corners: Vec<(usize, usize)> = (1..m).flat_map(|r| (0..n).map(move |j| (r, j))).collect();
        let placed = ctx.map(&corners, |&(r, j)| landed(field, grid.point(a.rows[r], j, 0.0)))?;
        corners.iter().zip(placed).for_each(|(&(r, j), x)| set(self, r * p, j * p, x));
        // Lines between corners: along the vessel, then around it.
        let lines: Vec<(usize, usize, bool)> = (0..m)
            .flat_map(|r| (0..n).map(move |j| (r, j, true)))
            .chain((1..m).flat_map(|r| (0..n).map(move |j| (r, j, false))))
            .collect();
        let here = |row: usize, column: usize| self.nodes[id[row * width + column % width] as usize];
        let drawn = ctx.map(&lines, |&(r, j, along)| {
            let steps = FINE * p;
            let mut points: Vec<DVec3> = (0..=steps)
                .map(|s| {
                    let part = s as f64 / steps as f64;
                    match along {
                        true => grid.point(a.rows[r] + part * (a.rows[r + 1] - a.rows[r]), j, 0.0),
                        false => grid.point(a.rows[r], j, part),
                    }
                })
                .collect();
            points[0] = here(r * p, j * p);
            points[steps] = if along { here((r + 1) * p, j * p) } else { here(r * p, (j + 1) * p) };
            spaced(&points, p).into_iter().map(|x| landed(field, x)).collect::<Vec<_>>()
        })?;
        for (&(r, j, along), inner) in lines.iter().zip(drawn) {
            for (s, x) in inner.into_iter().enumerate() {
                let (row, column) = if along { (r * p + s + 1, j * p) } else { (r * p, j * p + s + 1) };
                let at = &mut id[row * width + column];
                self.nodes.push(x);
                *at = self.nodes.len() as u32 - 1;
            }
        }
        self.patches(loom, k, [m, n], &mut id)
    }

    /// The insides, and the patches themselves.
    fn patches(&mut self, loom: &Loom<'_>, k: usize, [m, n]: [usize; 2], id: &mut [u32]) -> Result<(), Error> {
        let Loom { field, p, ctx, .. } = *loom;
        let width = n * p;
        let all: Vec<(usize, usize)> = (0..m).flat_map(|r| (0..n).map(move |j| (r, j))).collect();
        let insides = ctx.map(&all, |&(r, j)| {
            let at = |b: usize, a: usize| self.nodes[id[(r * p + b) * width + (j * p + a) % width] as usize];
            let inner = (1..p).flat_map(|b| (1..p).map(move |a| (b, a)));
            inner.map(|(b, a)| landed(field, coons(&at, b, a, p))).collect::<Vec<_>>()
        })?;
        for (&(r, j), inside) in all.iter().zip(insides) {
            for (s, x) in inside.into_iter().enumerate() {
                let (b, a) = (s / (p - 1) + 1, s % (p - 1) + 1);
                id[(r * p + b) * width + j * p + a] = self.add(x);
            }
        }
        for (row, column) in all {
            let nodes = (0..=p).flat_map(|b| (0..=p).map(move |a| (b, a)));
            let nodes = nodes.map(|(b, a)| id[(row * p + b) * width + (column * p + a) % width]).collect();
            self.cells.push(Cell { annulus: k, row, column, nodes });
        }
        Ok(())
    }

    fn mark(&self, cell: &Cell, field: &dyn Field, basis: &Basis) -> Mark {
        let patch = Patch { basis, nodes: cell.nodes.iter().map(|&i| self.nodes[i as usize]).collect() };
        let n = 2 * basis.order;
        let mut out = Mark { sine: patch.least_sine(), roughness: patch.roughness(), ..Mark::default() };
        let mut area = 0.0;
        for k in 0..(n + 1) * (n + 1) {
            let [x, a, b] = patch.at((k % (n + 1)) as f64 / n as f64, (k / (n + 1)) as f64 / n as f64);
            let (f, g) = field.gradient(P3::from_raw(x));
            let off = f.abs() / g.length();
            area += a.cross(b).length() / ((n + 1) * (n + 1)) as f64;
            if off.is_nan() || off > out.error {
                (out.error, out.at) = (off, x);
            }
        }
        out.jacobian = patch.least_jacobian() / area;
        out
    }
}

fn landed(field: &dyn Field, x: DVec3) -> DVec3 {
    land(field, x, &Tie::WALL, Approach::exact(STEP_MM)).at
}

/// The columns of an annulus: v between its ends.
struct Grid<'a> {
    annulus: &'a Annulus,
    items: [Vec<Item>; 2],
    /// v at the left of every column at both ends; one more for the turn.
    v: [Vec<f64>; 2],
}

impl<'a> Grid<'a> {
    fn new(annulus: &'a Annulus, weave: &Weave) -> Self {
        let items = [0, 1].map(|e| annulus.items(e, &weave.arcs));
        let mut v = [0, 1].map(|e| items[e].iter().map(|i| i.v).chain([items[e][0].v + 1.0]).collect::<Vec<f64>>());
        let turns = (v[1][0] - v[0][0]).round();
        v[1].iter_mut().for_each(|x| *x -= turns);
        Self { annulus, items, v }
    }

    /// A point at a part of the way along, a part of the way through a column.
    fn point(&self, along: f64, column: usize, through: f64) -> DVec3 {
        let level = &self.annulus.level;
        let s = along * (level.len() - 1) as f64;
        let i = (s as usize).min(level.len() - 2);
        let u = level[i] + (s - i as f64) * (level[i + 1] - level[i]);
        let v = [0, 1].map(|e| self.v[e][column] + through * (self.v[e][column + 1] - self.v[e][column]));
        self.annulus.chart.point(u, v[0] + along * (v[1] - v[0]))
    }
}

/// p - 1 points between the ends of a polyline at equal parts of its length.
fn spaced(points: &[DVec3], p: usize) -> Vec<DVec3> {
    let mut way = vec![0.0];
    for w in points.windows(2) {
        way.push(way[way.len() - 1] + w[0].distance(w[1]));
    }
    let last = points.len() - 1;
    let at = |want: f64| {
        let i = way.partition_point(|&w| w <= want).clamp(1, last) - 1;
        let step = way[i + 1] - way[i];
        points[i].lerp(points[i + 1], if step > 0.0 { (want - way[i]) / step } else { 0.0 })
    };
    (1..p).map(|k| at(way[last] * k as f64 / p as f64)).collect()
}

/// The Coons patch of a lattice's border at one of its inner points.
fn coons(at: &impl Fn(usize, usize) -> DVec3, b: usize, a: usize, p: usize) -> DVec3 {
    let (x, y) = (a as f64 / p as f64, b as f64 / p as f64);
    let ruled = at(b, 0) * (1.0 - x) + at(b, p) * x + at(0, a) * (1.0 - y) + at(p, a) * y;
    let corners = (at(0, 0) * (1.0 - x) + at(0, p) * x) * (1.0 - y) + (at(p, 0) * (1.0 - x) + at(p, p) * x) * y;
    ruled - corners
}

#[cfg(test)]
mod tests;
