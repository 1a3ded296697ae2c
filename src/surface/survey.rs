//! The whole way from f to a checked mesh over a table of phantoms, lattice shifts and thread counts.
#![allow(clippy::unwrap_used)]

use crate::fields::{self, Analytic};
use crate::phantoms::{Dice, Phantom, phantom};
use crate::*;
use exec::Ctx;
use imaging::CutPlane;
use space::{Faulty, P3, V3};

/// Wanted distance of the adaptive meshes, mm: coarse, for short tests.
const MAX_ERROR_MM: f64 = 0.04;

fn whole(p: &Phantom, shift: [f64; 3], sizing: Sizing, ctx: &Ctx) -> (TriMesh, RemeshReport) {
    let s = PolygoniseSettings { cell_mm: 0.5, shift, ..PolygoniseSettings::default() };
    let (raw, report) = polygonise(&p.field, &[p.seed], &s, ctx).unwrap();
    assert!(report.cells_visited as f64 <= 1.2 * report.cells as f64 + 30.0, "{report:?}");
    let (closed, _) = cut(&raw, &p.field, &p.cuts, ctx).unwrap();
    let s = RemeshSettings { sizing, max_error_mm: MAX_ERROR_MM, ..RemeshSettings::default() };
    remesh(&closed, &p.field, &p.cuts, &s, ctx).unwrap()
}

#[test]
fn twenty_phantoms_and_shifts_are_closed_and_well_shaped() {
    let ctx = Ctx::new(2).unwrap();
    let mut dice = Dice(7);
    for i in 0..20 {
        let p = phantom(&mut dice, i);
        // Every third round is aligned with the lattice.
        let shift = if i % 12 < 4 { [0.0; 3] } else { [dice.roll(), dice.roll(), dice.roll()] };
        let (sizing, least) = if i % 2 == 0 { (Sizing::Uniform(0.5), 33.0) } else { (Sizing::Curvature, 30.0) };
        let (mesh, report) = whole(&p, shift, sizing, &ctx);
        let found = check(&mesh).unwrap();
        assert_eq!((found.euler, found.components), (p.euler, 1), "phantom {i}");
        assert!(self_intersections(&mesh, &ctx).unwrap().is_empty(), "phantom {i}");
        let q = quality(&mesh, &p.field, &ctx).unwrap();
        assert!(q.min_angle_deg >= least && q.max_angle_deg <= 120.0, "phantom {i}: {q:?}");
        assert!(q.vertex_max_mm <= 1e-9, "phantom {i}: {q:?}");
        assert!(i % 2 == 0 || q.face_max_mm <= 1.2 * MAX_ERROR_MM, "phantom {i}: {q:?}");
        let calls = (report.evaluations + report.hessians) as f64 / report.vertices as f64;
        assert!(calls <= 6.0, "phantom {i}: {calls} evaluations per vertex, {report:?}");
    }
}

/// Its third branch ends in a tip that the upper plane clips: the rim's area is .2 mm2.
#[test]
fn a_tip_that_a_plane_only_just_clips_gets_a_finer_lattice() {
    let ctx = Ctx::new(2).unwrap();
    let mut dice = Dice(139 * 977 + 1);
    let p = phantom(&mut dice, 139);
    let cell = PolygoniseSettings { shift: [dice.roll(), dice.roll(), dice.roll()], ..PolygoniseSettings::default() };
    let settings = RemeshSettings { max_error_mm: MAX_ERROR_MM, ..RemeshSettings::default() };
    let found = shell(&p.field, &[p.seed], &p.cuts, &cell, &settings, &ctx).unwrap();
    assert_eq!((found.halvings, found.caps.len()), (1, 4));
    assert_eq!(check(&found.mesh).unwrap().euler, 2);
    assert!(self_intersections(&found.mesh, &ctx).unwrap().is_empty());
    let smallest = found.caps.iter().map(|c| c.area_mm2).fold(f64::INFINITY, f64::min);
    assert!(smallest < 0.3, "{smallest}");
    let q = quality(&found.mesh, &p.field, &ctx).unwrap();
    assert!(q.min_angle_deg >= 30.0 && q.max_angle_deg <= 120.0 && q.vertex_max_mm <= 1e-9, "{q:?}");
}

#[test]
fn one_and_three_threads_give_the_same_bytes() {
    let mesh = |threads| {
        let ctx = Ctx::new(threads).unwrap();
        let mesh = whole(&phantom(&mut Dice(3), 2), [0.3, 0.1, 0.7], Sizing::Curvature, &ctx).0;
        let p = patches(&mesh, &(0..mesh.face_id.iter().copied().max().unwrap()).collect::<Vec<_>>(), &ctx).unwrap();
        (mesh, p)
    };
    let ((one, p1), (three, p3)) = (mesh(1), mesh(3));
    let bits = |m: &TriMesh| m.vertices.iter().flat_map(|p| p.to_array()).map(f64::to_bits).collect::<Vec<_>>();
    assert_eq!(bits(&one), bits(&three));
    assert_eq!((one.triangles, one.face_id, p1), (three.triangles, three.face_id, p3));
}

#[test]
fn cancelled_work_says_so_everywhere() {
    let ctx = Ctx::new(2).unwrap();
    let field = fields::sphere(P3::ORIGIN, 2.0);
    let seed = [P3::new(2.0, 0.0, 0.0)];
    let (mut mesh, _) = polygonise(&field, &seed, &PolygoniseSettings::default(), &ctx).unwrap();
    ctx.cancel();
    assert_eq!(polygonise(&field, &seed, &PolygoniseSettings::default(), &ctx).unwrap_err(), Error::Cancelled);
    assert_eq!(project(&mut mesh, &field, 0.5, &ctx).unwrap_err(), Error::Cancelled);
    assert_eq!(remesh(&mesh, &field, &[], &RemeshSettings::default(), &ctx).unwrap_err(), Error::Cancelled);
    assert_eq!(displacement(&mesh, &field, 0.5, &ctx).unwrap_err(), Error::Cancelled);
    assert_eq!(quality(&mesh, &field, &ctx).unwrap_err().code(), "cancelled");
}

#[test]
fn surfaces_without_a_seed_too_large_or_out_of_the_data_are_refused() {
    let ctx = Ctx::new(1).unwrap();
    let field = fields::sphere(P3::ORIGIN, 2.0);
    let run = |field: &Analytic, seed: P3, max_cells: usize| {
        let s = PolygoniseSettings { max_cells, ..PolygoniseSettings::default() };
        polygonise(field, &[seed], &s, &ctx).unwrap_err().code()
    };
    assert_eq!(run(&field, P3::new(30.0, 0.0, 0.0), 1000), "surface.no_seed");
    assert_eq!(run(&field, P3::new(2.0, 0.0, 0.0), 100), "surface.too_many_cells");
    let open = Analytic { f: Box::new(|x: P3| (x.z(), V3::Z)), bounds: field.bounds };
    assert_eq!(run(&open, P3::new(0.0, 0.0, 0.1), 100_000), "surface.leaves_data");
    let cuts = [V3::X, -V3::X, V3::Y, -V3::Y, V3::Z].map(|n| CutPlane::new(P3::ORIGIN + n * 3.0, n));
    let bounded = Bounded::new(&open, &cuts, 1.0);
    let (mesh, _) = polygonise(&bounded, &[P3::new(0.0, 0.0, 0.1)], &PolygoniseSettings::default(), &ctx).unwrap();
    assert_eq!(topology(&mesh).unwrap().euler, 2);
}

#[test]
fn a_mesh_that_passes_through_itself_is_found_out() {
    let ctx = Ctx::new(1).unwrap();
    let ball = |x: f64| {
        let field = fields::sphere(P3::new(x, 0.0, 0.0), 2.0);
        let s = PolygoniseSettings { cell_mm: 0.6, ..PolygoniseSettings::default() };
        polygonise(&field, &[P3::new(x + 2.0, 0.0, 0.0)], &s, &ctx).unwrap().0
    };
    let two = |distance: f64| {
        let (mut mesh, other) = (ball(0.0), ball(distance));
        let n = mesh.vertices.len() as u32;
        mesh.vertices.extend(other.vertices);
        mesh.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + n)));
        mesh.face_id.extend(other.face_id);
        assert_eq!(topology(&mesh).unwrap().components, 2);
        self_intersections(&mesh, &ctx).unwrap().len()
    };
    assert_eq!(two(4.5), 0);
    assert!(two(3.1) > 10);
}

#[test]
fn defects_are_named() {
    let tetrahedron = TriMesh {
        vertices: vec![P3::ORIGIN, P3::new(1.0, 0.0, 0.0), P3::new(0.0, 1.0, 0.0), P3::new(0.0, 0.0, 1.0)],
        triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
        face_id: vec![WALL; 4],
    };
    assert_eq!(check(&tetrahedron).unwrap(), Topology { euler: 2, components: 1, genus: 0 });
    let broken = |change: fn(&mut TriMesh)| {
        let mut m = tetrahedron.clone();
        change(&mut m);
        check(&m).unwrap_err().kind
    };
    let drop_one = |m: &mut TriMesh| {
        m.triangles.pop();
        m.face_id.pop();
    };
    assert_eq!(broken(drop_one), DefectKind::OpenEdge);
    assert_eq!(broken(|m| m.triangles[0] = [0, 1, 2]), DefectKind::Orientation);
    assert_eq!(broken(|m| m.triangles[0] = [0, 2, 2]), DefectKind::Degenerate);
    assert_eq!(broken(|m| m.triangles[0] = [0, 2, 9]), DefectKind::BadIndex);
    assert_eq!(broken(|m| m.triangles[0] = m.triangles[1]), DefectKind::Duplicate);
    assert_eq!(broken(|m| m.vertices.push(P3::ORIGIN)), DefectKind::LooseVertex);
    assert_eq!(broken(|m| m.vertices[3] = P3::new(1.0, 0.0, 0.0)), DefectKind::Degenerate);
}
