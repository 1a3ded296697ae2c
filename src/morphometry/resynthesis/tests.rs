#![allow(clippy::unwrap_used, clippy::panic)]
use super::*;
use crate::fit_helix;
use imaging::{Curve, Plane};
use space::DVec3;

const PROXIMAL: V3Array = [0.0, 0.0, 1.0];
type V3Array = [f64; 3];

fn section(position: P3, tangent: V3, radius: f64, clear: bool) -> ModelSection {
    let first = tangent.any_orthonormal();
    let outline = SectionOutline { centre: position, first, radii_mm: vec![radius; 48] };
    ModelSection { position, tangent, outline: clear.then_some(outline) }
}

/// A straight round branch from the origin; what lies within `clear_from` of it is junction.
fn branch(id: usize, role: Role, direction: V3Array, radius: f64, clear_from: f64) -> ModelBranch {
    let d = V3::from(direction).normalised().unwrap();
    let at = |k: usize| P3::ORIGIN + d * (0.3 * k as f64);
    let sections = (0..100).map(|k| section(at(k), d, radius, 0.3 * k as f64 >= clear_from)).collect();
    ModelBranch { id, role, nodes: [0, id + 1], tip: [false; 2], direction: Some(d), sections }
}

/// A host of radius 3 along z and a graft of radius 2.5 at 45 degrees in the plane of x and z.
fn model() -> Model {
    Model {
        pixel_mm: 0.5,
        branches: vec![
            branch(0, Role::Proximal, PROXIMAL, 3.0, 9.0),
            branch(1, Role::Distal, [0.0, 0.0, -1.0], 3.0, 4.0),
            branch(2, Role::Graft, [1.0, 0.0, 1.0], 2.5, 10.0),
        ],
        junctions: vec![ModelJunction { node: 0, point: P3::ORIGIN, plane_normal: Some(V3::Y) }],
    }
}

fn graft(what: What) -> [Change; 1] {
    [Change { branch: Which::Role(Role::Graft), what }]
}

fn wall_points(curve: &Curve, plane: &Plane) -> Vec<P3> {
    let n = 60;
    let points = (0..n).map(|k| curve.at(plane, curve.length_mm() * k as f64 / n as f64));
    points.filter(|p| !p.on_border).map(|p| p.position).collect()
}

fn off_ray(p: P3, direction: V3) -> f64 {
    let v = p - P3::ORIGIN;
    if v.dot(direction) > 0.0 { (v - direction * v.dot(direction)).length() } else { v.length() }
}

#[test]
fn without_a_change_every_wall_point_lies_on_one_tube_and_outside_the_others() {
    let model = model();
    let made = resynthesise(&model, &[]).unwrap();
    let (mut seen, mut hidden) = (0, 0);
    for curve in &made.contours.curves {
        let plane = &made.contours.planes[curve.plane];
        let points = wall_points(curve, plane);
        hidden += 60 - points.len();
        for p in points {
            let tube = |b: &ModelBranch| {
                let radius = b.sections[99].outline.as_ref().unwrap().radii_mm[0];
                off_ray(p, b.direction.unwrap()) - radius
            };
            let nearest = model.branches.iter().map(tube).fold(f64::INFINITY, f64::min);
            assert!(nearest.abs() < 2e-4, "{nearest} mm off the wall at {p:?}");
            seen += 1;
        }
    }
    assert!(seen > 3000 && hidden > 150, "{seen} points seen, {hidden} hidden");
    assert_eq!(made.contours.cuts.len(), 3);
    assert!(made.roles.graft.is_some_and(|p| off_ray(p, V3::from([1.0, 0.0, 1.0]).normalised().unwrap()) < 1e-9));
}

#[test]
fn sections_keep_their_areas_on_a_changed_line() {
    let helix = graft(What::Helix { curvature_per_mm: 0.08, torsion_per_mm: 0.05 });
    for changes in [&graft(What::Angle { deg: 70.0, to: Which::Role(Role::Proximal) })[..], &helix[..]] {
        let made = resynthesise(&model(), changes).unwrap();
        for curve in made.contours.curves.iter().filter(|c| c.border.is_empty()) {
            let radius = (curve.spline.area() / std::f64::consts::PI).sqrt();
            assert!((radius - 3.0).abs() < 1e-4 || (radius - 2.5).abs() < 1e-4, "radius {radius}");
        }
    }
}

/// The graft's ring centres, from its first clear one.
fn graft_centres(made: &Resynthesis) -> Vec<P3> {
    let clear = made.contours.curves.iter().filter(|c| c.border.is_empty());
    let radius = |c: &Curve| (c.spline.area() / std::f64::consts::PI).sqrt();
    clear.filter(|c| (radius(c) - 2.5).abs() < 1e-3).map(|c| made.contours.planes[c.plane].origin).collect()
}

#[test]
fn a_turned_branch_has_the_wanted_angle() {
    for deg in [30.0, 60.0, 90.0] {
        let made = resynthesise(&model(), &graft(What::Angle { deg, to: Which::Role(Role::Proximal) })).unwrap();
        let centres = graft_centres(&made);
        let direction = centres[centres.len() - 1] - centres[0];
        assert!((direction.angle_to(V3::from(PROXIMAL)).to_degrees() - deg).abs() < 1e-9);
        let cut = made.contours.cuts[2];
        assert!(cut.outward.angle_to(direction) < 1e-9 && cut.reach_mm.is_finite());
    }
}

#[test]
fn an_asked_helix_is_found_again() {
    let (curvature_per_mm, torsion_per_mm) = (0.06, -0.04);
    let made = resynthesise(&model(), &graft(What::Helix { curvature_per_mm, torsion_per_mm })).unwrap();
    let helix = fit_helix(&graft_centres(&made)).unwrap();
    assert!((helix.curvature_per_mm / curvature_per_mm - 1.0).abs() < 5e-3, "{helix:?}");
    assert!((helix.torsion_per_mm / torsion_per_mm - 1.0).abs() < 2e-2, "{helix:?}");
}

#[test]
fn a_bent_branch_is_straightened_and_one_out_of_the_plane_is_pressed_into_it() {
    let mut bent = model();
    let (radius, start) = (25.0, bent.branches[2].sections[34].position);
    // from the 34th section on an arc that leaves the plane of the junction
    let d = V3::from([1.0, 0.0, 1.0]).normalised().unwrap();
    for (k, s) in bent.branches[2].sections.iter_mut().enumerate().skip(34) {
        let angle = 0.3 * (k - 34) as f64 / radius;
        let tangent = d * angle.cos() + V3::Y * angle.sin();
        let at = start + d * (radius * angle.sin()) + V3::Y * (radius * (1.0 - angle.cos()));
        *s = section(at, tangent, 2.5, true);
    }
    let straight = resynthesise(&bent, &graft(What::Bend { factor: 0.0 })).unwrap();
    assert!(graft_centres(&straight).iter().all(|&p| off_ray(p, d) < 1e-6));
    let planar = resynthesise(&bent, &graft(What::Planar)).unwrap();
    assert!(graft_centres(&planar).iter().all(|p| p.to_array()[1].abs() < 1e-9));
    let same = resynthesise(&bent, &graft(What::Bend { factor: 1.0 })).unwrap();
    let unchanged = resynthesise(&bent, &[]).unwrap();
    for (a, b) in graft_centres(&same).iter().zip(graft_centres(&unchanged)) {
        assert!(a.distance(b) < 1e-9);
    }
}

#[test]
fn what_no_vessel_can_be_is_refused_with_its_place() {
    use space::Faulty;
    let code = |model: &Model, what: What| resynthesise(model, &graft(what)).map_err(|e| e.code()).err();
    let to = Which::Role(Role::Proximal);
    let model = model();
    assert_eq!(code(&model, What::Helix { curvature_per_mm: 0.45, torsion_per_mm: 0.0 }), Some("variant.folds"));
    assert_eq!(code(&model, What::Helix { curvature_per_mm: 0.3, torsion_per_mm: 0.0 }), Some("variant.collision"));
    assert_eq!(code(&model, What::Angle { deg: 5.5, to }), Some("variant.collision"));
    assert_eq!(code(&model, What::Angle { deg: 181.0, to }), Some("variant.value"));
    assert_eq!(code(&model, What::Angle { deg: 60.0, to: Which::Id(9) }), Some("variant.branch"));
    assert_eq!(code(&model, What::Bend { factor: f64::NAN }), Some("variant.value"));
    let mut looped = model.clone();
    looped.branches[2].nodes[1] = looped.branches[0].nodes[1];
    assert_eq!(code(&looped, What::Planar), Some("variant.loop"));
    let mut unclear = model;
    unclear.branches[2].sections.iter_mut().for_each(|s| s.outline = None);
    assert_eq!(code(&unclear, What::Planar), Some("variant.sections"));
}

#[test]
fn what_lies_beyond_a_branch_moves_with_it() {
    let mut tree = model();
    // a side branch at the far end of the graft
    let d = V3::from([1.0, 0.0, 1.0]).normalised().unwrap();
    let end = P3::ORIGIN + d * (0.3 * 99.0);
    let mut side = branch(3, Role::Other, [1.0, 1.0, 0.0], 1.2, 6.0);
    for s in &mut side.sections {
        let shift = end - P3::ORIGIN;
        s.position += shift;
        s.outline.iter_mut().for_each(|o| o.centre += shift);
    }
    side.nodes = [3, 4];
    tree.branches.push(side);
    tree.junctions.push(ModelJunction { node: 3, point: end, plane_normal: None });
    let to = Which::Role(Role::Proximal);
    let made = resynthesise(&tree, &graft(What::Angle { deg: 75.0, to })).unwrap();
    let turned = P3::ORIGIN + V3::from_raw(DVec3::new(75f64.to_radians().sin(), 0.0, 75f64.to_radians().cos())) * 29.7;
    let side_cut = made.contours.cuts[2];
    let before = V3::from([1.0, 1.0, 0.0]).normalised().unwrap().angle_to(d);
    assert!((side_cut.outward.angle_to(turned - P3::ORIGIN) - before).abs() < 1e-9);
    assert!((side_cut.point.distance(turned) - 29.7).abs() < 1e-6);
}
