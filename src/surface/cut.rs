//! Cutting the closed wall where the data end, and closing it again with planar caps.
//!
//! One plane after the other, each for the whole mesh: what lies on its outward side goes. The section of the mesh itself
//! is taken, straight across its triangles: the mesh does not pass through itself, so neither does its section, whatever
//! the plane. Each opening gets a cap without geometry (a fan), rim edges much shorter than the mesh's collapse, and the
//! rim is triangulated in its plane (constrained Delaunay). A later plane may cut an earlier cap (planes that meet at a
//! corner of the volume inside a lumen). Only when all planes are done do rims move onto f = 0 within their planes.
//!
//! Rejected: clipping triangle by triangle with vertices snapped into the plane (wrong Euler number for one grid-aligned
//! tube in ten), and landing rim vertices on f while cutting, where neighbours nearer to each other than the wall is to
//! the mesh may change places (docs/adr/0040).

use crate::cap::recap;
use crate::fabric::Fabric;
use crate::improve::{collapse_curves, thin_out};
use crate::land::{Approach, Flat, Tie, land, landed};
use crate::topology::regions;
use crate::web::Web;
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use glam::DVec3;
use imaging::CutPlane;
use implicit::Field;
use space::P3;
use std::collections::BTreeMap;

/// One planar cap.
#[derive(Clone, Debug, PartialEq)]
pub struct Cap {
    /// Face id of its triangles, 1 or more.
    pub face_id: u32,
    /// Its plane; `outward` is a unit vector out of the lumen.
    pub plane: CutPlane,
    /// Index of the plane among those given.
    pub cut: usize,
    /// Centroid of its area, LPS mm.
    pub centroid: P3,
    /// Area, mm2.
    pub area_mm2: f64,
    /// Length of its rim, mm.
    pub perimeter_mm: f64,
}

/// What [`cut`] did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CutReport {
    /// The caps, by face id.
    pub caps: Vec<Cap>,
    /// Planes (indices as given) that cross nothing.
    pub missed: Vec<usize>,
    /// Calls of (f, grad f).
    pub evaluations: usize,
}

/// Vertices nearer to a plane than this part of their shortest edge count as outside it by as much, so that no rim edge
/// has length zero where the mesh has vertices in the plane (grid-aligned phantoms).
const APART: f64 = 1e-3;
/// Rim edges shorter than this part of the mesh's mean edge collapse: neighbours on a rim then stay in order when they
/// move onto f = 0, by at most a sagitta (.1 of an edge on a radius of one edge).
const RIM_EDGE: f64 = 0.4;
/// A rim vertex that moves farther than this times the mesh's mean edge has lost its wall.
const RIM_REACH: f64 = 2.0;
/// Sine of the angle between plane and wall below which the rim is not well defined: at .1 (6 degrees) an error of
/// .02 mm of the wall moves the rim by .2 mm.
const GRAZING: f64 = 0.1;

/// Cut a closed mesh of the wall by planes: what lies on the `outward` side of any of them is removed, each opening is
/// closed by a planar cap.
///
/// The result is closed, oriented outward; wall faces have id [`WALL`], caps ids from 1, ordered by the place of their
/// centroid (z, then y, then x, ascending, .5 mm counting as equal), so ids depend neither on the order of the planes nor
/// on the mesh. Rim vertices lie on f = 0
/// (|f| / |grad f| <= 1e-9 mm) and in their plane (1e-12 mm). Caps hold only rim vertices until [`crate::remesh`].
///
/// # Errors
/// [`Error::GrazingCut`], [`Error::NestedRims`], [`Error::CrossedRim`], [`Error::CutRunsOn`], [`Error::NothingLeft`],
/// [`Error::Projection`], [`Error::Defect`], [`Error::Settings`] (a normal of length zero), [`Error::Cancelled`].
pub fn cut(mesh: &TriMesh, field: &dyn Field, cuts: &[CutPlane], ctx: &Ctx) -> Result<(TriMesh, CutReport), Error> {
    let mut flats = Vec::with_capacity(cuts.len());
    for c in cuts {
        let value = c.outward.length();
        flats.push(Flat::of(c).ok_or(Error::Settings {
            field: "cuts",
            value,
            need: "an outward normal of length 1",
        })?);
    }
    let mut report = CutReport::default();
    // While cutting, the caps of plane k carry id k + 1.
    let mut now = tidy(mesh, field, ctx)?;
    for (k, _) in flats.iter().enumerate() {
        ctx.progress(k as f64 / flats.len() as f64);
        ctx.check()?;
        match one(&now, field, &flats, k, ctx)? {
            Some(m) => now = m,
            None => report.missed.push(k),
        }
    }
    let mut now = landed_rims(&now, field, &flats, &mut report, ctx)?;
    report.caps = number(&mut now, &flats)?;
    ctx.progress(1.0);
    Ok((now, report))
}

/// The wall without its slivers: edges shorter than the mean collapse onto vertices that stay, no evaluation of f. On
/// the slivers of a raw lattice mesh the rim of an oblique cut crosses itself (trifurcation of the tests, at .5 mm).
fn tidy(mesh: &TriMesh, field: &dyn Field, ctx: &Ctx) -> Result<TriMesh, Error> {
    let mut wall = mesh.clone();
    wall.face_id.fill(WALL);
    let mut fabric = Fabric::new(&wall, field, Vec::new())?;
    thin_out(&mut fabric, 1.0, ctx)?;
    Ok(fabric.web.mesh())
}

/// Cut by plane k; `None` when nothing lies outside.
fn one(mesh: &TriMesh, field: &dyn Field, flats: &[Flat], k: usize, ctx: &Ctx) -> Result<Option<TriMesh>, Error> {
    let web = Web::weave(mesh)?;
    let plane = flats[k];
    let mut height: Vec<f64> = web.at.iter().map(|&x| plane.beyond(x)).collect();
    let all_within = height.iter().all(|&h| h < 0.0);
    for (v, height) in height.iter_mut().enumerate() {
        let shortest = web.spokes(v as u32).map(|h| web.length(h)).fold(f64::INFINITY, f64::min);
        if *height > -APART * shortest {
            *height = height.max(APART * shortest);
        }
    }
    let inside: Vec<bool> = height.iter().map(|&h| h < 0.0).collect();
    if !inside.contains(&true) {
        return Err(Error::NothingLeft { plane: k, at: P3::from_raw(plane.point) });
    }
    // The whole surface inside, up to vertices that graze the plane from within: nothing to remove.
    if all_within || !inside.contains(&false) {
        return Ok(None);
    }
    let mut clipped = Clipped::new(&web, &inside);
    let crossed = (0..web.origin.len() as u32)
        .filter(|&h| inside[web.origin[h as usize] as usize] && !inside[web.target(h) as usize]);
    let mut number = BTreeMap::new();
    for h in crossed {
        let (a, b) = (web.origin[h as usize] as usize, web.target(h) as usize);
        if height[a] == f64::NEG_INFINITY {
            return Err(Error::CutRunsOn { plane: k, reach_mm: plane.reach, at: P3::from_raw(web.at[b]) });
        }
        let place = web.at[a].lerp(web.at[b], height[a] / (height[a] - height[b]));
        number.insert(h, clipped.mesh.vertices.len() as u32);
        clipped.mesh.vertices.push(P3::from_raw(place - plane.normal * plane.height(place)));
    }
    let boundary = clipped.triangles(&web, &inside, &number);
    for ring in loops(&boundary) {
        clipped.fan(&ring, k as u32 + 1);
    }
    let mut fabric = Fabric::new(&clipped.mesh, field, flats.to_vec())?;
    collapse_curves(&mut fabric, RIM_EDGE, ctx)?;
    recap(&fabric.web, flats).map(Some)
}

/// Rim vertices on f = 0 within their planes (corners: within both), and the caps triangulated anew.
fn landed_rims(
    mesh: &TriMesh,
    field: &dyn Field,
    flats: &[Flat],
    report: &mut CutReport,
    ctx: &Ctx,
) -> Result<TriMesh, Error> {
    let mut fabric = Fabric::new(mesh, field, flats.to_vec())?;
    let reach = fabric.mean_edge();
    let rim: Vec<(u32, Tie, usize)> = (fabric.living().into_iter().filter(|&v| fabric.on_crease(v)))
        .filter_map(|v| {
            let (tie, plane) = rim_tie(&fabric, flats, v);
            tie.wall.then_some((v, tie, plane))
        })
        .collect();
    let landings =
        ctx.map(&rim, |(v, tie, _)| land(field, fabric.web.at[*v as usize], tie, Approach::exact(0.5 * reach)))?;
    for (&(v, tie, plane), l) in rim.iter().zip(&landings) {
        let sine = tie.free(l.gradient).length() / l.gradient.length();
        let moved = l.at.distance(fabric.web.at[v as usize]);
        if sine.is_nan() || sine < GRAZING || moved > RIM_REACH * reach {
            return Err(Error::GrazingCut { plane, sine, at: P3::from_raw(fabric.web.at[v as usize]) });
        }
        landed(v as usize, l)?;
        fabric.take(v, l);
    }
    report.evaluations += fabric.evaluations;
    recap(&fabric.web, flats)
}

/// What a rim vertex is tied to, and one of the planes it lies in.
fn rim_tie(fabric: &Fabric<'_>, flats: &[Flat], v: u32) -> (Tie, usize) {
    let mut ids: Vec<u32> = fabric.web.spokes(v).map(|h| fabric.web.id(h)).collect();
    ids.sort_unstable();
    ids.dedup();
    let mut planes = ids.iter().filter(|&&id| id != WALL).map(|&id| id as usize - 1);
    let (first, second) = (planes.next(), planes.next());
    let flat = |k: Option<usize>| k.and_then(|k| flats.get(k)).copied();
    (Tie { wall: ids.contains(&WALL), planes: [flat(first), flat(second)] }, first.unwrap_or(0))
}

/// Rim vertices are numbered after the kept ones.
const NEW: u32 = u32::MAX;

/// The kept part while it is being put together.
struct Clipped {
    mesh: TriMesh,
    /// New number of each kept vertex.
    number: Vec<u32>,
}

impl Clipped {
    fn new(web: &Web, inside: &[bool]) -> Self {
        let mut mesh = TriMesh::default();
        let mut number = vec![NEW; inside.len()];
        for (v, _) in inside.iter().enumerate().filter(|(_, i)| **i) {
            number[v] = mesh.vertices.len() as u32;
            mesh.vertices.push(P3::from_raw(web.at[v]));
        }
        Self { mesh, number }
    }

    /// Keep the inner part of every triangle; gives the directed boundary edges (first vertex -> next), as the cap sees
    /// them.
    fn triangles(&mut self, web: &Web, inside: &[bool], rim: &BTreeMap<u32, u32>) -> BTreeMap<u32, u32> {
        let mut boundary = BTreeMap::new();
        for t in 0..web.face_id.len() {
            let mut polygon = Vec::with_capacity(4);
            let mut ends = [None; 2];
            for h in 3 * t as u32..3 * t as u32 + 3 {
                let a = web.origin[h as usize];
                if inside[a as usize] {
                    polygon.push(self.number[a as usize]);
                }
                let (leaves, enters) = (rim.get(&h), rim.get(&web.twin[h as usize]));
                if let Some(&v) = leaves.or(enters) {
                    ends[usize::from(enters.is_some())] = Some(v);
                    polygon.push(v);
                }
            }
            for i in 2..polygon.len() {
                self.mesh.triangles.push([polygon[0], polygon[i - 1], polygon[i]]);
                self.mesh.face_id.push(web.face_id[t]);
            }
            if let [Some(leaves), Some(enters)] = ends {
                // The kept part runs leaves -> enters; the cap runs the other way.
                boundary.insert(enters, leaves);
            }
        }
        boundary
    }
}

impl Clipped {
    /// Close a ring with triangles to a vertex in its middle.
    fn fan(&mut self, ring: &[u32], id: u32) {
        let sum = ring.iter().fold(DVec3::ZERO, |s, &v| s + self.mesh.vertices[v as usize].raw());
        let middle = self.mesh.vertices.len() as u32;
        self.mesh.vertices.push(P3::from_raw(sum / ring.len() as f64));
        for (i, &v) in ring.iter().enumerate() {
            self.mesh.triangles.push([v, ring[(i + 1) % ring.len()], middle]);
            self.mesh.face_id.push(id);
        }
    }
}

/// The closed loops of a set of directed edges, each from its smallest vertex.
pub(crate) fn loops(edges: &BTreeMap<u32, u32>) -> Vec<Vec<u32>> {
    let mut left = edges.clone();
    let mut loops = Vec::new();
    while let Some((first, mut now)) = left.pop_first() {
        let mut ring = vec![first];
        while now != first {
            ring.push(now);
            match left.remove(&now) {
                Some(v) => now = v,
                None => break,
            }
        }
        loops.push(ring);
    }
    loops
}

/// Coordinates of cap centres that differ by less count as equal, mm: caps in one plane differ by rounding alone, and the
/// same cap on two meshes by up to .05 mm.
const SAME_PLACE_MM: f64 = 0.5;

/// Sort by the first axis in runs without gaps of [`SAME_PLACE_MM`], each run by the next axis.
fn by_place(order: &mut [usize], place: &impl Fn(usize) -> [f64; 3], axes: &[usize]) {
    let Some((&axis, rest)) = axes.split_first() else { return };
    order.sort_by(|&i, &j| place(i)[axis].total_cmp(&place(j)[axis]));
    for run in order.chunk_by_mut(|&i, &j| place(j)[axis] - place(i)[axis] < SAME_PLACE_MM) {
        by_place(run, place, rest);
    }
}

/// Number the caps by the places of their centroids and describe them.
fn number(mesh: &mut TriMesh, flats: &[Flat]) -> Result<Vec<Cap>, Error> {
    let web = Web::weave(mesh)?;
    let (piece, count) = regions(&web, |h| !web.is_feature(h));
    let mut caps: Vec<Option<Cap>> = vec![None; count];
    for t in 0..mesh.triangles.len() {
        let id = mesh.face_id[t];
        let Some(plane) = flats.get((id as usize).wrapping_sub(1)) else { continue };
        let cap = caps[piece[t]].get_or_insert_with(|| Cap {
            face_id: 0,
            plane: plane.cut(),
            cut: id as usize - 1,
            centroid: P3::ORIGIN,
            area_mm2: 0.0,
            perimeter_mm: 0.0,
        });
        let area = 0.5 * mesh.area_vector(t).length();
        let centre = mesh.corners(t).iter().fold(DVec3::ZERO, |s, p| s + p.raw()) / 3.0;
        cap.centroid = P3::from_raw(cap.centroid.raw() + centre * area);
        cap.area_mm2 += area;
        let around = (3 * t as u32..3 * t as u32 + 3).filter(|&h| web.is_feature(h));
        cap.perimeter_mm += around.fold(0.0, |s, h| s + web.length(h));
    }
    let mut order: Vec<usize> = (0..count).filter(|&p| caps[p].is_some()).collect();
    for cap in caps.iter_mut().flatten() {
        cap.centroid = P3::from_raw(cap.centroid.raw() / cap.area_mm2);
    }
    let place = |p: usize| caps[p].as_ref().map_or([0.0; 3], |c| c.centroid.to_array());
    by_place(&mut order, &place, &[2, 1, 0]);
    let mut id_of = vec![WALL; count];
    let mut out = Vec::with_capacity(order.len());
    for (i, &p) in order.iter().enumerate() {
        id_of[p] = i as u32 + 1;
        if let Some(mut cap) = caps[p].take() {
            cap.face_id = i as u32 + 1;
            out.push(cap);
        }
    }
    for (id, &p) in mesh.face_id.iter_mut().zip(&piece) {
        *id = id_of[p];
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{PolygoniseSettings, RemeshSettings, Sizing, check, fields, polygonise, quality, remesh, topology};
    use space::V3;

    fn wall(field: &dyn Field, seed: P3, cell_mm: f64, ctx: &Ctx) -> TriMesh {
        let s = PolygoniseSettings { cell_mm, ..PolygoniseSettings::default() };
        let mut mesh = polygonise(field, &[seed], &s, ctx).unwrap().0;
        crate::project(&mut mesh, field, cell_mm, ctx).unwrap();
        mesh
    }

    fn ends(height: f64) -> Vec<CutPlane> {
        vec![CutPlane::new(P3::new(0.0, 0.0, height), V3::Z), CutPlane::new(P3::new(0.0, 0.0, -height), -V3::Z)]
    }

    #[test]
    fn the_benchmark_gets_three_flat_caps_and_keeps_its_angles() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        // The end planes of a stack, aligned with the lattice; the graft is cut at 45 degrees.
        let cuts = &ends(15.0);
        let (mesh, report) = cut(&wall(&field, fields::tips()[0], 0.5, &ctx), &field, cuts, &ctx).unwrap();
        assert_eq!(topology(&mesh).unwrap().euler, 2);
        assert_eq!(report.caps.len(), 3);
        for sizing in [Sizing::Uniform(0.5), Sizing::Curvature] {
            let s = RemeshSettings { sizing, ..RemeshSettings::default() };
            let (mesh, r) = remesh(&mesh, &field, cuts, &s, &ctx).unwrap();
            let q = quality(&mesh, &field, &ctx).unwrap();
            assert_eq!(r.vertices, mesh.vertices.len());
            assert_eq!(check(&mesh).unwrap().euler, 2);
            assert_eq!(crate::self_intersections(&mesh, &ctx).unwrap(), Vec::<[usize; 2]>::new());
            assert!(q.min_angle_deg >= 30.0 && q.max_angle_deg <= 115.0, "{q:?}");
            for cap in &report.caps {
                for (tri, _) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id == cap.face_id) {
                    for &v in tri {
                        let off = (mesh.vertices[v as usize] - cap.plane.point).dot(cap.plane.outward);
                        assert!(off.abs() <= 1e-9, "{off}");
                    }
                }
            }
        }
    }

    #[test]
    fn planes_that_meet_within_a_lumen_leave_two_caps_with_a_common_edge() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::tree(vec![(V3::Z, 24.0, 3.0), (-V3::Z, 24.0, 3.0)], vec![1e-6]);
        let mut cuts = ends(10.0);
        cuts.push(CutPlane::new(P3::new(1.0, 0.0, 9.0), V3::new(0.6, 0.0, 0.8)));
        let (mesh, report) = cut(&wall(&field, fields::tips()[0], 0.5, &ctx), &field, &cuts, &ctx).unwrap();
        assert_eq!(report.caps.len(), 3);
        let s = RemeshSettings { sizing: Sizing::Uniform(0.5), ..RemeshSettings::default() };
        let (mesh, _) = remesh(&mesh, &field, &cuts, &s, &ctx).unwrap();
        assert_eq!(check(&mesh).unwrap().euler, 2);
        let q = quality(&mesh, &field, &ctx).unwrap();
        assert!(q.vertex_max_mm <= 1e-9, "{q:?}");
    }

    #[test]
    fn a_local_cut_past_which_the_wall_runs_on_is_refused_with_the_place() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::tree(vec![(V3::Z, 24.0, 3.0), (-V3::Z, 24.0, 3.0)], vec![1e-6]);
        let mesh = wall(&field, fields::tips()[0], 0.5, &ctx);
        // half-way along a tube of radius 3: the ball of 5 mm ends on its wall, 4 mm past the plane
        let middle = CutPlane::new(P3::new(0.0, 0.0, 5.0), V3::Z).within(5.0);
        match cut(&mesh, &field, &[middle], &ctx) {
            Err(Error::CutRunsOn { plane: 0, reach_mm: 5.0, at }) => assert!((at.z() - 9.0).abs() < 1.0, "{at:?}"),
            other => panic!("{:?}", other.map(|o| o.1)),
        }
    }

    #[test]
    fn ids_follow_the_place_and_not_the_order_of_the_planes() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        let mesh = wall(&field, fields::tips()[0], 0.7, &ctx);
        let mut cuts = ends(15.2);
        let one = cut(&mesh, &field, &cuts, &ctx).unwrap().1;
        cuts.reverse();
        let two = cut(&mesh, &field, &cuts, &ctx).unwrap().1;
        for (a, b) in one.caps.iter().zip(&two.caps) {
            // Which rim vertices stay depends on the order, so the polygons differ within the mesh's own error.
            assert!(a.centroid.distance(b.centroid) < 5e-3 && a.face_id == b.face_id);
        }
        // The host's section is a circle; its polygon is a little smaller.
        let area = std::f64::consts::PI * 9.0;
        assert!((one.caps[1].area_mm2 - area).abs() < 0.03 * area || (one.caps[2].area_mm2 - area).abs() < 0.03 * area);
    }

    #[test]
    fn caps_in_one_plane_are_numbered_across_it_whatever_the_mesh() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        for cell_mm in [0.45, 0.6, 0.7] {
            let caps = cut(&wall(&field, fields::tips()[0], cell_mm, &ctx), &field, &ends(15.03), &ctx).unwrap().1.caps;
            assert_eq!(caps.len(), 3);
            assert!(caps[1].centroid.x() < 1.0 && caps[2].centroid.x() > 10.0, "{caps:?}");
        }
    }

    #[test]
    fn any_plane_cuts_or_is_refused_with_a_reason() {
        use space::Faulty;
        let ctx = Ctx::new(2).unwrap();
        let field = fields::anastomosis();
        let mesh = wall(&field, fields::tips()[0], 0.6, &ctx);
        let mut dice = crate::phantoms::Dice(11);
        let mut done = 0;
        for _ in 0..20 {
            let plane = |dice: &mut crate::phantoms::Dice| {
                let mut roll = |half: f64| dice.between(-half, half);
                let n = V3::new(roll(1.0), roll(1.0), roll(1.0)).normalised().unwrap();
                CutPlane::new(P3::ORIGIN + n * roll(9.0).abs(), n)
            };
            let mut cuts = vec![plane(&mut dice), plane(&mut dice), plane(&mut dice)];
            let outcome = |cuts: &[CutPlane]| match cut(&mesh, &field, cuts, &ctx) {
                Ok((m, r)) => {
                    assert!(topology(&m).is_ok());
                    r.caps.len()
                }
                Err(e) => {
                    let known =
                        ["surface.grazing_cut", "surface.nested_rims", "surface.nothing_left", "surface.crossed_rim"];
                    assert!(known.contains(&e.code()), "{e}");
                    assert!(e.place().position.is_some(), "{e}");
                    0
                }
            };
            done += usize::from(outcome(&cuts) > 0);
            cuts.reverse();
            outcome(&cuts);
        }
        assert!(done >= 8, "{done} of 20");
    }

    #[test]
    fn a_section_with_a_hole_and_a_plane_that_removes_everything_are_refused() {
        let ctx = Ctx::new(1).unwrap();
        let field = fields::torus(6.0, 2.0);
        let mesh = wall(&field, P3::new(8.0, 0.0, 0.0), 0.5, &ctx);
        let flat = |z: f64, n: V3| [CutPlane::new(P3::new(0.0, 0.0, z), n)];
        assert!(matches!(cut(&mesh, &field, &flat(0.3, V3::Z), &ctx), Err(Error::NestedRims { plane: 0, .. })));
        assert!(matches!(cut(&mesh, &field, &flat(-3.0, V3::Z), &ctx), Err(Error::NothingLeft { plane: 0, .. })));
        assert_eq!(cut(&mesh, &field, &flat(5.0, V3::Z), &ctx).unwrap().1.missed, vec![0]);
        let across = [CutPlane::new(P3::ORIGIN, V3::X)];
        assert_eq!(cut(&mesh, &field, &across, &ctx).unwrap().1.caps.len(), 2);
    }
}
