//! The whole way from an analytic f to the medial graph.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod shapes;

use exec::Ctx;
use imaging::CutPlane;
use shapes::*;
use skeleton::{CapHint, Error, MedialGraph, NodeKind, Report, Settings, medial_graph};
use space::{FaultKind, Faulty, P3, V3};

fn ctx() -> Ctx {
    Ctx::new(2).unwrap()
}

fn at_spacing(h: f64) -> Settings {
    Settings { spacing_mm: Some(h), ..Settings::default() }
}

fn of(star: &Star, settings: &Settings) -> (MedialGraph, Report) {
    medial_graph(&star.vessel, &star.cuts, &star.caps, &star.seeds, settings, &ctx()).unwrap()
}

/// A tube through `centre`, cut at +-half its length by planes whose normals are turned by `oblique`.
fn tube(centre: P3, direction: V3, radius: f64, oblique: f64) -> (Vessel, Vec<CutPlane>, Vec<CapHint>) {
    let d = direction.normalised().unwrap();
    let side = d.any_orthonormal();
    let vessel = Vessel::new(&[(centre - d * 20.0, centre + d * 20.0, radius)]);
    let normal = d * oblique.cos() + side * oblique.sin();
    let (cuts, caps) =
        [opening(1, centre + d * 12.0, normal), opening(2, centre - d * 12.0, d * -1.0)].into_iter().unzip();
    (vessel, cuts, caps)
}

#[test]
fn a_straight_tube_in_any_direction_gives_its_axis_from_cap_to_cap() {
    let directions = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.3, -0.5, 0.8], [1.0, 1.0, 1.0]];
    for (i, d) in directions.into_iter().enumerate() {
        let centre = P3::new(3.1 + 0.17 * i as f64, -40.0, 7.3);
        let (vessel, cuts, caps) = tube(centre, V3::from(d), 3.0, 0.0);
        let (graph, report) = medial_graph(&vessel, &cuts, &caps, &[centre], &Settings::default(), &ctx()).unwrap();
        assert_eq!(counts(&graph), (2, 0, 0, 1), "{d:?}");
        assert!(report.warnings.is_empty(), "{:?}", report.warnings);
        let edge = &graph.edges[0];
        assert!((edge.length_mm() - 24.0).abs() < 0.01, "{}", edge.length_mm());
        for (p, r) in edge.points.iter().zip(&edge.radius_mm) {
            let off = off_axis(*p, centre, V3::from(d));
            assert!(off <= 0.05 * report.spacing_mm, "{d:?}: {off} mm at {p:?}");
            assert!((r - 3.0).abs() < 2e-3, "{d:?}: radius {r} at {p:?}");
        }
    }
}

#[test]
fn an_end_at_an_oblique_cap_reaches_its_centroid_on_the_axis() {
    for degrees in [20.0_f64, 40.0, 60.0] {
        let centre = P3::new(0.2, 0.4, 0.1);
        let d = V3::new(0.2, 0.3, 1.0);
        let (vessel, cuts, caps) = tube(centre, d, 2.0, degrees.to_radians());
        let (graph, report) = medial_graph(&vessel, &cuts, &caps, &[centre], &at_spacing(0.4), &ctx()).unwrap();
        assert_eq!(counts(&graph), (2, 0, 0, 1), "{degrees}");
        for p in &from_cap(&graph, 1).points {
            let off = off_axis(*p, centre, d);
            assert!(off <= 0.05 * report.spacing_mm, "{degrees}: {off} at {p:?}");
        }
    }
}

#[test]
fn the_junction_of_a_trunk_that_divides_lies_where_the_largest_sphere_touches_the_divider() {
    let (half, thin) = (17.0_f64.to_radians(), 4.0);
    let centre = P3::new(0.3, 0.2, -0.4);
    let arm = |side: f64| V3::new(side * half.sin(), half.cos(), 0.0);
    let star = star(centre, &[(V3::Y * -1.0, 30.0, 6.0), (arm(1.0), 60.0, thin), (arm(-1.0), 60.0, thin)]);
    let (graph, _) = of(&star, &at_spacing(0.6));
    assert_eq!(counts(&graph), (3, 1, 0, 1));
    let node = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
    let divider = centre + V3::Y * (thin / half.sin());
    assert!(off_axis(node.position, centre, V3::Y) < 0.1, "{:?}", node.position);
    let gap = divider.distance(node.position);
    assert!((gap - node.radius_mm).abs() < 0.3 && gap < 4.0, "{gap} mm, radius {}", node.radius_mm);
}

fn y_shape(shift: f64) -> Star {
    let centre = P3::new(1.0 + shift, -2.0 + 0.7 * shift, 0.4 * shift);
    let branches = [
        (V3::new(0.1, 0.0, -1.0), 22.0, 3.0),
        (V3::new(0.7, 0.2, 1.0), 20.0, 2.2),
        (V3::new(-0.6, 0.3, 1.0), 20.0, 2.5),
    ];
    star(centre, &branches)
}

#[test]
fn a_bifurcation_has_three_ends_and_one_junction_at_any_resolution_and_shift() {
    for h in [0.88, 0.55, 0.3, 0.2] {
        for shift in [0.0, 0.31, 0.77] {
            let star = y_shape(shift * h);
            let (graph, _) = of(&star, &at_spacing(h));
            assert_eq!(counts(&graph), (3, 1, 0, 1), "h {h}, shift {shift}");
            let junction = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
            let off = junction.position.distance(star.centre);
            assert!(off < 0.15, "h {h}, shift {shift}: junction off by {off} mm");
            assert_axes(&star, &graph, 8.0, 0.05 * h);
        }
    }
}

/// Points farther than `from` mm from the star's centre lie on its branches' axes.
fn assert_axes(star: &Star, graph: &MedialGraph, from: f64, bound: f64) {
    for (i, d) in star.directions.iter().enumerate() {
        let edge = from_cap(graph, i as u32 + 1);
        for p in edge.points.iter().filter(|p| p.distance(star.centre) > from) {
            let off = off_axis(*p, star.centre, *d);
            assert!(off <= bound, "branch {i}: {off} mm off at {} mm", p.distance(star.centre));
        }
    }
}

#[test]
fn a_rough_wall_grows_spurs_that_are_pruned() {
    let mut spurs = 0;
    for h in [0.55, 0.3, 0.2] {
        for shift in [0.0, 0.4, 0.9] {
            let mut star = y_shape(shift * h);
            star.vessel.ripple = [0.35 * h, 3.0 * h];
            let (graph, report) = of(&star, &at_spacing(h));
            assert_eq!(counts(&graph), (3, 1, 0, 1), "h {h}, shift {shift}, {} spurs", report.spurs);
            assert_axes(&star, &graph, 9.0, 0.35 * h);
            spurs += report.spurs;
        }
    }
    assert!(spurs > 10, "the roughness made only {spurs} spurs");
}

#[test]
fn a_graft_at_45_degrees_meets_its_host_where_the_axes_cross() {
    let centre = P3::new(5.0, 1.0, -3.0);
    let branches = [(V3::Z, 26.0, 3.0), (V3::new(0.0, 0.17, -1.0), 26.0, 3.0), (V3::new(1.0, 0.0, 1.0), 26.0, 2.3)];
    let star = star(centre, &branches);
    let (graph, report) = of(&star, &Settings::default());
    assert_eq!(counts(&graph), (3, 1, 0, 1));
    assert!((0.4..0.9).contains(&report.spacing_mm), "{}", report.spacing_mm);
    let junction = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
    assert!(junction.position.distance(centre) < 0.2, "{:?}", junction.position);
    assert!((junction.radius_mm - 3.0).abs() < 0.25, "{}", junction.radius_mm);
    // From 1.3 times the crotch distance outwards (3 / tan 22.5 degrees = 7.2 mm) the axes are exact.
    assert_axes(&star, &graph, 1.3 * 7.25, 0.05 * report.spacing_mm);
}

/// Halfway along it the distal vessel is still as wide as the junction: taken for a trunk that divides, it drew the
/// junction of the second of these rough walls 8 mm into the crotch.
#[test]
fn a_vessel_cut_off_close_to_its_graft_is_no_trunk() {
    const VOXEL_MM: f64 = 0.8;
    for (x, length) in [(0.33, 9.0), (0.46, 9.5), (0.59, 10.0)] {
        let centre = P3::new(x, -0.1, 0.3);
        let branches = [
            (V3::Z, 48.0, 3.66),
            (V3::new(0.006, 0.362, -0.932), length, 3.66),
            (V3::new(0.403, 0.621, 0.673), 70.0, 3.55),
        ];
        let mut star = star(centre, &branches);
        star.vessel.ripple = [0.35 * VOXEL_MM, 3.0 * VOXEL_MM];
        let (graph, _) = of(&star, &at_spacing(VOXEL_MM));
        assert_eq!(counts(&graph), (3, 1, 0, 1));
        let junction = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
        let off = junction.position.distance(centre);
        assert!(off < 0.5, "{length} mm: the junction is {off} mm off");
    }
}

#[test]
fn four_branches_from_one_point_meet_in_one_junction() {
    let star = star(
        P3::ORIGIN,
        &[
            (V3::new(0.0, 0.0, -1.0), 22.0, 3.0),
            (V3::new(1.0, 0.0, 0.8), 20.0, 2.5),
            (V3::new(-0.5, 0.87, 0.8), 20.0, 2.5),
            (V3::new(-0.5, -0.87, 0.8), 20.0, 2.5),
        ],
    );
    for h in [0.5, 0.3] {
        let (graph, _) = of(&star, &at_spacing(h));
        assert_eq!(counts(&graph), (4, 1, 0, 1), "h {h}");
        for n in graph.nodes.iter().filter(|n| n.kind == NodeKind::Junction) {
            assert!(n.position.distance(star.centre) < 1.5, "{:?}", n.position);
        }
        assert_axes(&star, &graph, 8.0, 0.05 * h);
    }
}

#[test]
fn a_torus_is_one_cycle_on_its_circle() {
    let torus = Torus { centre: P3::new(0.3, 0.1, -0.2), big: 12.0, small: 2.5 };
    let seed = torus.centre + V3::X * 12.0;
    let (graph, report) = medial_graph(&torus, &[], &[], &[seed], &Settings::default(), &ctx()).unwrap();
    assert_eq!((graph.nodes.len(), graph.edges.len(), graph.cycles()), (1, 1, 1));
    let edge = &graph.edges[0];
    for (p, r) in edge.points.iter().zip(&edge.radius_mm) {
        let d = *p - torus.centre;
        // The area centroid of a plane section through the axis is the circle itself.
        let off = (d.x().hypot(d.y()) - 12.0).hypot(d.z());
        assert!(off < 0.05 * report.spacing_mm, "{off}");
        assert!((r - 2.5).abs() < 0.05 * report.spacing_mm, "{r}");
    }
    let length = std::f64::consts::TAU * 12.0;
    assert!((edge.length_mm() - length).abs() < 0.002 * length, "{}", edge.length_mm());
}

#[test]
fn a_closed_tip_is_kept_and_named_in_a_warning() {
    let star = y_shape(0.0);
    let (cuts, caps): (Vec<_>, Vec<_>) = star.cuts.iter().zip(&star.caps).take(2).map(|(c, h)| (*c, *h)).unzip();
    let (graph, report) = medial_graph(&star.vessel, &cuts, &caps, &star.seeds, &at_spacing(0.4), &ctx()).unwrap();
    assert_eq!(counts(&graph), (3, 1, 0, 1));
    let codes: Vec<_> = report.warnings.iter().map(|w| w.code).collect();
    assert_eq!(codes, ["skeleton.end_without_cap"]);
    let place = report.warnings[0].place.position.unwrap();
    assert!(off_axis(place, star.centre, star.directions[2]) < 0.3);
    assert!(place.distance(star.centre) > 20.0);
}

#[test]
fn turning_the_vessel_by_90_degrees_turns_the_graph() {
    let branches = [
        (V3::new(0.1, 0.0, -1.0), 22.0, 3.0),
        (V3::new(0.7, 0.2, 1.0), 20.0, 2.2),
        (V3::new(-0.6, 0.3, 1.0), 20.0, 2.5),
    ];
    let h = 0.4;
    let (first, _) = of(&star(P3::ORIGIN, &branches), &at_spacing(h));
    let turns: [fn([f64; 3]) -> [f64; 3]; 3] =
        [|[x, y, z]| [-y, x, z], |[x, y, z]| [z, y, -x], |[x, y, z]| [-x, -y, z]];
    for turn in turns {
        let turned = branches.map(|(d, l, r)| (V3::from(turn(d.to_array())), l, r));
        let (graph, _) = of(&star(P3::ORIGIN, &turned), &at_spacing(h));
        assert_eq!(counts(&graph), counts(&first));
        for cap in 1..=3 {
            let (a, b) = (from_cap(&first, cap), from_cap(&graph, cap));
            assert!((a.length_mm() - b.length_mm()).abs() < 0.1 * h);
            for p in &a.points {
                let p = P3::from(turn(p.to_array()));
                let near = b.points.windows(2).map(|w| segment_distance(p, w[0], w[1])).fold(f64::INFINITY, f64::min);
                assert!(near < 0.1 * h, "{near} mm at {p:?}");
            }
        }
    }
}

fn segment_distance(p: P3, a: P3, b: P3) -> f64 {
    let t = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
    p.distance(a.lerp(b, t))
}

#[test]
fn two_vessels_are_two_pieces_and_what_no_seed_reaches_is_left_out() {
    let z = V3::Z * 10.0;
    let at = |x: f64| P3::new(x, 0.0, 0.0);
    let vessel = Vessel::new(&[
        (at(0.0) - z, at(0.0) + z, 2.0),
        (at(8.0) - z, at(8.0) + z, 2.0),
        (at(16.0) - z, at(16.0) + z, 2.0),
    ]);
    let run = |seeds: &[P3]| medial_graph(&vessel, &[], &[], seeds, &at_spacing(0.5), &ctx());
    let (graph, report) = run(&[at(2.0), at(8.0)]).unwrap();
    assert_eq!(counts(&graph), (4, 0, 0, 2));
    assert!(graph.nodes.iter().all(|n| n.position.x() < 9.0));
    assert_eq!(report.warnings.len(), 4);
    let error = run(&[at(4.0)]).unwrap_err();
    assert_eq!((error.kind(), error.code()), (FaultKind::Input, "skeleton.no_lumen"));
}

#[test]
fn a_ball_is_refused_because_it_has_no_line() {
    let ball = Vessel::new(&[(P3::ORIGIN, P3::new(0.0, 0.0, 0.01), 4.0)]);
    let error = medial_graph(&ball, &[], &[], &[P3::ORIGIN], &at_spacing(0.5), &ctx()).unwrap_err();
    assert_eq!(error, Error::NoLine);
}

#[test]
fn a_cap_that_no_branch_reaches_is_a_fault_at_its_place() {
    let star = y_shape(0.0);
    let mut caps = star.caps.clone();
    caps.push(CapHint { face_id: 9, centroid: P3::new(30.0, 30.0, 30.0), normal: V3::X });
    let error = medial_graph(&star.vessel, &star.cuts, &caps, &star.seeds, &at_spacing(0.5), &ctx()).unwrap_err();
    assert_eq!((error.kind(), error.code()), (FaultKind::Numeric, "skeleton.cap_without_end"));
    assert_eq!(error.place().position, Some(caps[3].centroid));
}

#[test]
fn a_side_branch_cut_close_to_its_parent_is_a_stub_with_a_warning() {
    for (beyond, expected) in [(0.3, 1), (1.5, 0)] {
        let star = star(P3::ORIGIN, &[(V3::Z, 20.0, 3.0), (-V3::Z, 20.0, 3.0), (V3::X, 3.0 + beyond, 1.2)]);
        let (graph, report) = of(&star, &at_spacing(0.4));
        assert_eq!(counts(&graph), (3, 1, 0, 1), "{beyond}");
        assert_axes(&star, &graph, 5.0, 0.02);
        let stubs = report.warnings.iter().filter(|w| w.code == "skeleton.stub").count();
        assert_eq!(stubs, expected, "{beyond}: {:?}", report.warnings);
        let junction = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
        assert!(junction.position.distance(P3::ORIGIN) < 1.0, "{beyond}: {:?}", junction.position);
    }
}

#[test]
fn too_fine_a_lattice_is_a_limit_and_a_bad_setting_an_input_fault() {
    let star = y_shape(0.0);
    let run = |s: &Settings| medial_graph(&star.vessel, &star.cuts, &star.caps, &star.seeds, s, &ctx()).unwrap_err();
    let error = run(&at_spacing(0.01));
    assert_eq!((error.kind(), error.code()), (FaultKind::Limit, "skeleton.too_many_voxels"));
    let error = run(&at_spacing(-1.0));
    assert_eq!((error.kind(), error.code()), (FaultKind::Input, "skeleton.setting"));
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_a_cancel_is_obeyed() {
    let star = y_shape(0.1);
    let run = |ctx: &Ctx| medial_graph(&star.vessel, &star.cuts, &star.caps, &star.seeds, &at_spacing(0.4), ctx);
    let results = [1, 2, 3].map(|threads| run(&Ctx::new(threads).unwrap()).unwrap());
    assert!(results[0] == results[1] && results[0] == results[2]);
    let cancelled = ctx();
    cancelled.cancel();
    assert_eq!(run(&cancelled).unwrap_err(), Error::Cancelled);
}

#[test]
fn the_junctions_of_two_opposite_side_branches_stay_between_their_mouths() {
    // their first stretches lean down along the trunk: carried on through it they pass the axis; the node lay 6 mm below the mouths
    let p = P3::new;
    let radius = 2.7;
    let vessel = Vessel::new(&[
        (p(0.0, 0.0, -60.0), p(0.0, 0.0, 60.0), 9.0),
        (p(6.0, 4.0, 8.0), p(14.0, 6.0, -14.0), radius),
        (p(14.0, 6.0, -14.0), p(60.0, 6.0, -20.0), radius),
        (p(-6.0, 1.0, 1.0), p(-15.0, -1.0, -9.0), radius),
        (p(-15.0, -1.0, -9.0), p(-60.0, -1.0, -14.0), radius),
    ]);
    let ends = [
        (p(0.0, 0.0, 45.0), V3::Z),
        (p(0.0, 0.0, -45.0), V3::Z * -1.0),
        (p(45.0, 6.0, -18.0), V3::X),
        (p(-45.0, -1.0, -12.3), V3::X * -1.0),
    ];
    let (cuts, caps): (Vec<_>, Vec<_>) =
        ends.iter().enumerate().map(|(i, &(at, out))| opening(i as u32 + 1, at, out)).unzip();
    let seeds = [p(0.0, 9.0, 20.0), p(0.0, 9.0, -30.0), p(30.0, 6.0, -13.5), p(-30.0, -1.0, -8.0)];
    let (graph, _) = medial_graph(&vessel, &cuts, &caps, &seeds, &at_spacing(0.6), &ctx()).unwrap();
    assert_eq!((graph.nodes.iter().filter(|n| n.kind == NodeKind::End).count(), graph.cycles()), (4, 0));
    for node in graph.nodes.iter().filter(|n| n.kind == NodeKind::Junction) {
        let off = off_axis(node.position, P3::ORIGIN, V3::Z);
        assert!(off < 1.5, "{off} mm off the trunk's axis: {:?}", node.position);
        assert!(node.position.z().abs() < 4.0, "slid along the trunk: {:?}", node.position);
    }
}
