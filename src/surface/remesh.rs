//! A closed mesh to one that a solver accepts: every wall vertex on f = 0, every angle wide, edges of the wanted size.
//!
//! Botsch and Kobbelt, "A remeshing approach to multiresolution modeling" (2004), with the surface given by f instead of
//! by the old mesh: vertices follow f by their neighbours' normals while the mesh changes, are landed on f = 0 once
//! in between and exactly at the end, sizes come from the exact curvature of f, and a last pass mends single triangles ([`crate::polish`]).
//! Projection on the old mesh (what pmp-library does) was rejected: 1.4e-2 mm rms against 5.4e-3 at the same size.

use crate::fabric::Fabric;
use crate::improve::{collapse_short, flip_to_valence, meet_fresh, smooth, split_long, thin_out};
use crate::land::{Approach, Flat, PROMISED_MM};
use crate::polish::polish;
use crate::sizing::{Rule, grade, meet};
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use imaging::CutPlane;
use implicit::Field;
use space::P3;

/// How long edges should be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sizing {
    /// The same length everywhere, mm.
    Uniform(f64),
    /// By the exact curvature of f, for [`RemeshSettings::max_error_mm`], within [`RemeshSettings::edge_mm`].
    Curvature,
}

/// Settings of [`remesh`].
#[derive(Clone, Debug, PartialEq)]
pub struct RemeshSettings {
    /// Shortest and longest wanted edge, mm. Default [.15, 1].
    pub edge_mm: [f64; 2],
    /// Wanted distance between triangles and wall, mm. Default .02. Not met where the shortest edge forbids it.
    pub max_error_mm: f64,
    /// Rounds of the four passes. Default 6: after 5 the number of vertices moves by .2 %.
    pub iterations: usize,
    /// Edge lengths. Default by curvature.
    pub sizing: Sizing,
    /// Smallest angle up to which single triangles are mended, degrees. Default 36.
    pub goal_angle_deg: f64,
    /// Most triangles. Default 4 million (a wall of half as many while its edges are split).
    pub max_triangles: usize,
}

impl Default for RemeshSettings {
    fn default() -> Self {
        Self {
            edge_mm: [0.15, 1.0],
            max_error_mm: 0.02,
            iterations: 6,
            sizing: Sizing::Curvature,
            goal_angle_deg: 36.0,
            max_triangles: 4_000_000,
        }
    }
}

/// What [`remesh`] did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RemeshReport {
    /// Calls of (f, grad f).
    pub evaluations: usize,
    /// Calls of (f, grad f, second derivatives).
    pub hessians: usize,
    /// Vertices of the result.
    pub vertices: usize,
    /// Changes of the last, mending pass.
    pub mended: usize,
    /// Smallest angle of the result, degrees.
    pub min_angle_deg: f64,
    /// Smallest cosine between a triangle's normal and the surface's.
    pub min_facing: f64,
}

/// The round before which every vertex is landed and measured anew: the passes before it have done most of their moving.
const LANDING_ROUND: usize = 3;
/// Rounds of the mending pass; phantoms need 3 to 6.
const MENDING_ROUNDS: usize = 12;
/// A cap's vertices may stand off its plane by this much on input, mm.
const CAP_SLACK_MM: f64 = 1e-6;

/// Remesh a closed mesh of the wall (and caps) of f.
///
/// `cuts` are the planes by which the caps were cut, in any order (each cap takes the one that it lies in). The result
/// is closed and 2-manifold like the input; wall and rim vertices have |f| / |grad f| <= 1e-9 mm, caps stay planar, rims
/// stay rims, face ids stay. Not promised: the goal angle (see the report), and |distance| <= `max_error_mm` where
/// `edge_mm` forbids it. Cost: 4 to 5 calls of f per vertex of the
/// result, by curvature about 2 of them with second derivatives (docs/adr/0041).
///
/// # Errors
/// [`Error::Defect`] for an open or broken mesh, [`Error::CapPlane`], [`Error::TooManyTriangles`],
/// [`Error::Projection`], [`Error::Folded`], [`Error::NotFinite`], [`Error::Settings`], [`Error::Cancelled`].
pub fn remesh(
    mesh: &TriMesh,
    field: &dyn Field,
    cuts: &[CutPlane],
    settings: &RemeshSettings,
    ctx: &Ctx,
) -> Result<(TriMesh, RemeshReport), Error> {
    thinned(mesh, field, cuts, settings, THIN, ctx)
}

/// [`remesh`] of a raw mesh that is first thinned out to `thin` times its mean edge.
pub(crate) fn thinned(
    mesh: &TriMesh,
    field: &dyn Field,
    cuts: &[CutPlane],
    settings: &RemeshSettings,
    thin: f64,
    ctx: &Ctx,
) -> Result<(TriMesh, RemeshReport), Error> {
    let rule = rule(settings)?;
    let mut fabric = Fabric::new(mesh, field, cap_planes(mesh, cuts)?)?;
    let longest = rule.edge_mm[1];
    start(&mut fabric, &rule, thin, ctx)?;
    for round in 0..settings.iterations {
        ctx.progress(0.8 * round as f64 / settings.iterations as f64);
        if round == LANDING_ROUND {
            let all = fabric.living();
            meet(&mut fabric, &all, &rule, ctx)?;
        }
        grade(&mut fabric);
        let first = fabric.web.at.len();
        split_long(&mut fabric, &rule, settings.max_triangles, ctx)?;
        grade(&mut fabric);
        collapse_short(&mut fabric, ctx)?;
        flip_to_valence(&mut fabric, ctx)?;
        meet_fresh(&mut fabric, first, &rule, ctx)?;
        smooth(&mut fabric, longest, ctx)?;
        if round == 0 {
            fabric.compact()?;
        }
    }
    for _ in 0..2 {
        flip_to_valence(&mut fabric, ctx)?;
        smooth(&mut fabric, longest, ctx)?;
    }
    let mended = polish(&mut fabric, settings.goal_angle_deg, MENDING_ROUNDS, ctx)?;
    finish(fabric, mended, longest, ctx)
}

/// Share of triangles below [`SLIVER`] above which a mesh is taken for a raw one: lattice meshes have 10 % and more,
/// remeshed ones none.
const RAW: f64 = 0.02;
/// Raw meshes are thinned out to this times their mean edge (.3 mm at a cell of .5 mm): the second derivatives are then
/// asked for at 1.1 times the final number of vertices, at 1 it was 2.8 times.
pub(crate) const THIN: f64 = 1.6;
/// Cotangent of 20 degrees.
const SLIVER: f64 = 2.75;

/// First landing and sizes. A raw lattice mesh has two to three times the vertices that are wanted: it is thinned out
/// before f is asked.
fn start(fabric: &mut Fabric<'_>, rule: &Rule, thin: f64, ctx: &Ctx) -> Result<(), Error> {
    let n = fabric.web.face_id.len();
    let slivers = (0..n).filter(|&t| fabric.worth_at(3 * t as u32).cot > SLIVER).count();
    if slivers as f64 > RAW * n as f64 {
        thin_out(fabric, thin, ctx)?;
    }
    if let Sizing::Uniform(h) = rule.sizing {
        fabric.size.fill(h);
        collapse_short(fabric, ctx)?;
    }
    fabric.compact()?;
    let all = fabric.living();
    meet(fabric, &all, rule, ctx)
}

/// Land every vertex exactly and account for the result.
fn finish(mut fabric: Fabric<'_>, mended: usize, longest: f64, ctx: &Ctx) -> Result<(TriMesh, RemeshReport), Error> {
    fabric.compact()?;
    let all = fabric.living();
    let distance = fabric.settle(&all, Approach::exact(longest), ctx)?;
    for (&v, &distance_mm) in all.iter().zip(&distance) {
        if distance_mm.is_nan() || distance_mm > PROMISED_MM {
            let at = P3::from_raw(fabric.web.at[v as usize]);
            return Err(Error::Projection { vertex: v as usize, distance_mm, at });
        }
    }
    let mut report = RemeshReport {
        evaluations: fabric.evaluations,
        hessians: fabric.hessians,
        vertices: all.len(),
        mended,
        min_angle_deg: f64::INFINITY,
        min_facing: f64::INFINITY,
    };
    for t in 0..fabric.web.face_id.len() {
        let w = fabric.worth_at(3 * t as u32);
        report.min_angle_deg = report.min_angle_deg.min(w.angle_deg());
        if w.facing <= 0.0 {
            let at = P3::from_raw(fabric.web.at[fabric.web.origin[3 * t] as usize]);
            return Err(Error::Folded { face: t, at });
        }
        report.min_facing = report.min_facing.min(w.facing);
    }
    ctx.progress(1.0);
    Ok((fabric.web.mesh(), report))
}

fn rule(s: &RemeshSettings) -> Result<Rule, Error> {
    let length = "lengths must be positive and finite, the shortest edge not above the longest";
    let [least, most] = s.edge_mm;
    let fail = |field, value, need| Err(Error::Settings { field, value, need });
    if !(least.is_finite() && least > 0.0) {
        return fail("edge_mm", least, length);
    }
    if !(most.is_finite() && most >= least) {
        return fail("edge_mm", most, length);
    }
    if !(s.max_error_mm.is_finite() && s.max_error_mm > 0.0) {
        return fail("max_error_mm", s.max_error_mm, "a positive length");
    }
    let edge_mm = match s.sizing {
        Sizing::Uniform(h) if !(h.is_finite() && h > 0.0) => return fail("sizing", h, length),
        Sizing::Uniform(h) => [h, h],
        Sizing::Curvature => s.edge_mm,
    };
    Ok(Rule { sizing: s.sizing, edge_mm, max_error_mm: s.max_error_mm })
}

/// The plane of each cap, by face id - 1.
pub(crate) fn cap_planes(mesh: &TriMesh, cuts: &[CutPlane]) -> Result<Vec<Flat>, Error> {
    let most = mesh.face_id.iter().copied().max().unwrap_or(WALL);
    let flats: Vec<Flat> = cuts.iter().filter_map(Flat::of).collect();
    let mut off = vec![vec![0.0_f64; flats.len()]; most as usize];
    let mut seen = vec![None::<P3>; most as usize];
    for (tri, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != WALL) {
        for &v in tri {
            let Some(&at) = mesh.vertices.get(v as usize) else { continue };
            seen[id as usize - 1] = Some(at);
            for (o, f) in off[id as usize - 1].iter_mut().zip(&flats) {
                *o = o.max(f.height(at.raw()).abs());
            }
        }
    }
    let mut planes = Vec::with_capacity(off.len());
    for (k, off) in off.iter().enumerate() {
        let near = (0..off.len()).min_by(|&i, &j| off[i].total_cmp(&off[j]));
        match near {
            Some(i) if off[i] <= CAP_SLACK_MM => planes.push(flats[i]),
            _ => {
                let distance_mm = near.map_or(f64::INFINITY, |i| off[i]);
                let at = seen[k].unwrap_or_default();
                return Err(Error::CapPlane { cap: k as u32 + 1, planes: cuts.len(), distance_mm, at });
            }
        }
    }
    Ok(planes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{PolygoniseSettings, check, fields, polygonise, quality};

    pub(crate) fn raw(field: &dyn Field, seed: P3, cell_mm: f64, ctx: &Ctx) -> TriMesh {
        let s = PolygoniseSettings { cell_mm, ..PolygoniseSettings::default() };
        polygonise(field, &[seed], &s, ctx).unwrap().0
    }

    #[test]
    fn the_benchmark_keeps_its_bars_at_uniform_size() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        let mesh = raw(&field, fields::tips()[0], 0.5, &ctx);
        // .485 mm gives the 19 thousand triangles of the published figures.
        let s = RemeshSettings { sizing: Sizing::Uniform(0.485), ..RemeshSettings::default() };
        let (mesh, report) = remesh(&mesh, &field, &[], &s, &ctx).unwrap();
        let q = quality(&mesh, &field, &ctx).unwrap();
        assert_eq!((check(&mesh).unwrap().euler, report.vertices), (2, mesh.vertices.len()));
        assert!(q.min_angle_deg >= 33.0 && q.max_angle_deg <= 110.0, "{q:?}");
        assert!(q.face_rms_mm <= 5.5e-3 && q.vertex_max_mm <= 1e-9, "{q:?}");
    }

    #[test]
    fn the_benchmark_keeps_its_bars_at_adaptive_size() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        let mesh = raw(&field, fields::tips()[0], 0.5, &ctx);
        let (mesh, report) = remesh(&mesh, &field, &[], &RemeshSettings::default(), &ctx).unwrap();
        let q = quality(&mesh, &field, &ctx).unwrap();
        assert_eq!((check(&mesh).unwrap().euler, report.vertices), (2, mesh.vertices.len()));
        assert!(q.min_angle_deg >= 30.0 && q.max_angle_deg <= 115.0, "{q:?}");
        assert!(q.face_max_mm <= 0.02 && mesh.triangles.len() <= 30_000 && q.vertex_max_mm <= 1e-9, "{q:?}");
    }
}
