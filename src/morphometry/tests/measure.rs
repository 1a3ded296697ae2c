//! Measures of analytic vessels with known truth.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use exec::Ctx;
use imaging::CutPlane;
use implicit::Field;
use morphometry::{Error, Junction, Morphometry, Role, Roles, Settings, measure};
use skeleton::{Edge, MedialGraph, Node, NodeKind};
use space::{Aabb, DMat3, DVec3, Faulty, P3, Patient, V3};

/// Union of round tubes about polylines: f = max over tubes of (radius - distance to the axis).
struct Tubes(Vec<(Vec<DVec3>, f64)>);

impl Tubes {
    fn nearest(&self, x: DVec3) -> (f64, DVec3) {
        let mut best = (f64::NEG_INFINITY, DVec3::ZERO);
        for (axis, radius) in &self.0 {
            for w in axis.windows(2) {
                let d = w[1] - w[0];
                let foot = w[0] + d * ((x - w[0]).dot(d) / d.length_squared()).clamp(0.0, 1.0);
                let f = radius - x.distance(foot);
                if f > best.0 {
                    best = (f, (foot - x).normalize_or_zero());
                }
            }
        }
        best
    }
}

impl Field for Tubes {
    fn value(&self, x: P3) -> f64 {
        self.nearest(x.raw()).0
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let (f, g) = self.nearest(x.raw());
        (f, V3::from_raw(g))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        (f, g, DMat3::ZERO)
    }
    fn bounds(&self) -> Aabb<Patient> {
        Aabb::around(self.0.iter().flat_map(|t| t.0.iter().map(|&p| P3::from_raw(p)))).unwrap().grown(12.0)
    }
}

/// A vessel: field, graph and the planes where the data end.
struct Case {
    field: Tubes,
    graph: MedialGraph,
    cuts: Vec<CutPlane>,
}

/// Straight branches from one point: (direction, length, radius). `wobble` perturbs the graph's points, and more
/// strongly within 5 mm of the junction.
fn star(centre: DVec3, branches: &[(DVec3, f64, f64)], wobble: f64) -> Case {
    let mut case = Case { field: Tubes(Vec::new()), graph: MedialGraph::default(), cuts: Vec::new() };
    let largest = branches.iter().map(|b| b.2).fold(0.0, f64::max);
    case.graph.nodes.push(node(NodeKind::Junction, centre, largest));
    for (i, &(direction, length, radius)) in branches.iter().enumerate() {
        let d = direction.normalize();
        case.field.0.push((vec![centre, centre + d * (length + 6.0)], radius));
        let count = (length / 0.3) as usize;
        let points: Vec<DVec3> = (0..=count)
            .map(|k| {
                let s = length * k as f64 / count as f64;
                let kick = if s < 5.0 && k > 0 { 8.0 } else { 1.0 };
                let wave = DVec3::new((1.7 * k as f64).sin(), (2.3 * k as f64 + 1.0).sin(), (3.1 * k as f64).cos());
                let error = if k == 0 { DVec3::ZERO } else { wave * wobble * kick };
                centre + d * s + error
            })
            .collect();
        add(&mut case.graph, 0, &points, radius);
        case.graph.nodes[i + 1].cap = Some(i as u32 + 1);
        case.cuts.push(CutPlane::new(P3::from_raw(centre + d * length), V3::from_raw(d)));
    }
    case
}

fn node(kind: NodeKind, position: DVec3, radius_mm: f64) -> Node {
    Node { kind, position: P3::from_raw(position), radius_mm, cap: None }
}

/// A leaf branch from a node.
fn add(graph: &mut MedialGraph, from: usize, points: &[DVec3], radius: f64) {
    let to = graph.nodes.len();
    graph.nodes.push(node(NodeKind::End, points[points.len() - 1], radius));
    graph.edges.push(Edge {
        nodes: [from, to],
        points: points.iter().map(|&p| P3::from_raw(p)).collect(),
        radius_mm: vec![radius; points.len()],
    });
}

/// Host up and down (distal `tilt` degrees out of the plane), graft at `angle` degrees to proximal in the x-z plane.
fn anastomosis(angle: f64, tilt: f64, radii: [f64; 3], wobble: f64) -> Case {
    let ((s, c), (ts, tc)) = (angle.to_radians().sin_cos(), tilt.to_radians().sin_cos());
    let branches = [
        (DVec3::new(s, 0.0, c), 40.0, radii[0]),
        (DVec3::Z, 36.0, radii[1]),
        (DVec3::new(0.0, ts, -tc), 38.0, radii[2]),
    ];
    star(DVec3::new(-40.0, 25.0, 110.0), &branches, wobble)
}

fn points(case: &Case, which: [bool; 3]) -> Roles {
    let at = |e: usize| which[e].then(|| case.graph.edges[e].points[70]);
    Roles { graft: at(0), proximal: at(1), distal: at(2), flow_from: None }
}

fn run(case: &Case, roles: Roles) -> Result<Morphometry, Error> {
    run_with(case, Settings { roles, ..Settings::default() }, 2)
}

fn run_with(case: &Case, settings: Settings, threads: usize) -> Result<Morphometry, Error> {
    measure(&case.graph, &case.field, &case.cuts, &settings, &Ctx::new(threads).unwrap())
}

fn angle(j: &Junction, name: &str) -> Option<f64> {
    j.angles.iter().find(|a| a.name == name).unwrap_or_else(|| panic!("no {name} among {:?}", names(j))).value_deg
}

fn names(j: &Junction) -> Vec<&str> {
    j.angles.iter().map(|a| a.name.as_str()).collect()
}

fn codes(m: &Morphometry) -> Vec<&str> {
    m.warnings.iter().map(|w| w.code).collect()
}

/// The five angles of `anastomosis`, in contract order.
fn truth(angle: f64, tilt: f64) -> [(&'static str, f64); 5] {
    let graft_distal = (-angle.to_radians().cos() * tilt.to_radians().cos()).acos().to_degrees();
    [
        ("graft_proximal", angle),
        ("graft_distal_planar", 180.0 - angle),
        ("distal_normal", 90.0 - tilt),
        ("proximal_distal", 180.0 - tilt.abs()),
        ("graft_distal", graft_distal),
    ]
}

#[test]
fn the_five_angles_are_met_to_a_twentieth_of_a_degree() {
    for (theta, tilt, radii, wobble) in [
        (45.0, 15.0, [3.0, 3.0, 3.0], 0.0),
        (45.0, 15.0, [2.0, 3.0, 2.6], 0.0),
        (45.0, 15.0, [2.5, 3.0, 3.0], 0.05),
        (30.0, 5.0, [1.5, 2.0, 2.0], 0.05),
        (75.0, -20.0, [3.0, 2.5, 2.0], 0.05),
        (120.0, 30.0, [3.0, 3.0, 3.0], 0.05),
    ] {
        let case = anastomosis(theta, tilt, radii, wobble);
        let m = run(&case, points(&case, [true; 3])).unwrap();
        assert!(!codes(&m).contains(&"angles.unsettled"), "{:?}", m.warnings);
        let j = &m.junctions[0];
        for (name, expected) in truth(theta, tilt) {
            let value = angle(j, name).unwrap_or_else(|| panic!("{name} null at {theta}: {:?}", m.warnings));
            assert!((value - expected).abs() < 0.05, "{name} {value} for {expected} ({radii:?}, {wobble})");
        }
        assert!(j.axes_point.unwrap().distance(case.graph.nodes[0].position) < 0.02);
        assert_eq!(m.branches.iter().map(|b| b.role).collect::<Vec<_>>(), [Role::Graft, Role::Proximal, Role::Distal]);
    }
}

/// The junction swells the distal vessel's first 6 mm (graft at 48 degrees, host bent by 21): what is left tells the truth
/// or nothing.
#[test]
fn a_branch_cut_off_close_to_its_junction_is_right_or_null() {
    let cut_at = |length: f64| {
        let branches = [
            (DVec3::new(0.403, 0.621, 0.673), 60.0, 3.55),
            (DVec3::Z, 48.0, 3.66),
            (DVec3::new(0.006, 0.362, -0.932), length, 3.66),
        ];
        let case = star(DVec3::ZERO, &branches, 0.0);
        let at = |e: usize, k: usize| Some(case.graph.edges[e].points[k]);
        let roles = Roles { graft: at(0, 70), proximal: at(1, 70), distal: at(2, 12), flow_from: None };
        run(&case, roles).unwrap()
    };
    let whole = cut_at(45.0);
    for (length, angles, diameter) in [(13.0, true, true), (9.0, false, true), (7.0, false, false)] {
        let m = cut_at(length);
        for name in ["graft_proximal", "graft_distal_planar", "distal_normal"] {
            let want = angle(&whole.junctions[0], name).unwrap();
            let got = angle(&m.junctions[0], name);
            assert!(got.is_none_or(|got| (got - want).abs() < 0.1), "{length} mm: {name} {got:?} for {want}");
            assert_eq!(got.is_some(), angles || name == "graft_proximal", "{length} mm: {name} {:?}", m.warnings);
        }
        let got = m.branches[2].diameter_mm;
        assert!(got.is_none_or(|d| (d - 7.32).abs() < 0.02 * 7.32), "{length} mm: {got:?}");
        assert_eq!((got.is_some(), codes(&m).contains(&"sections.short")), (diameter, !diameter), "{length} mm");
    }
}

#[test]
fn areas_perimeters_and_radii_of_round_tubes() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 2.0], 0.05);
    let m = run(&case, Roles::default()).unwrap();
    for (b, r) in m.branches.iter().zip([2.5, 3.0, 2.0]) {
        assert!((b.diameter_mm.unwrap() / (2.0 * r) - 1.0).abs() < 1e-3);
        let clear: Vec<_> = b.sections.iter().filter(|s| !s.open && !s.in_junction).collect();
        assert!(clear.len() > 25, "{}", clear.len());
        for s in clear {
            let area = std::f64::consts::PI * r * r;
            assert!((s.area_mm2.unwrap() / area - 1.0).abs() < 2e-3, "{s:?}");
            assert!((s.perimeter_mm.unwrap() / (std::f64::consts::TAU * r) - 1.0).abs() < 2e-3, "{s:?}");
            assert!((s.radius_inscribed_mm / r - 1.0).abs() < 1e-3, "{s:?}");
            assert!(s.curvature_per_mm.is_none_or(|k| k < 2e-3), "{s:?}");
        }
        assert!((b.tortuosity - 1.0).abs() < 0.01, "{} {}", b.tortuosity, b.length_mm);
    }
}

#[test]
fn neither_numbering_nor_direction_changes_a_number() {
    let case = anastomosis(50.0, 12.0, [2.3, 3.0, 2.7], 0.05);
    let roles = points(&case, [true; 3]);
    let base = run(&case, roles).unwrap();
    let mut other = Case { field: Tubes(case.field.0.clone()), graph: case.graph.clone(), cuts: case.cuts.clone() };
    other.field.0.reverse();
    other.cuts.rotate_left(1);
    let order = [2, 0, 3, 1]; // new number of each node
    other.graph.nodes = vec![
        case.graph.nodes[1].clone(),
        case.graph.nodes[3].clone(),
        case.graph.nodes[0].clone(),
        case.graph.nodes[2].clone(),
    ];
    other.graph.edges.rotate_left(2);
    for (i, e) in other.graph.edges.iter_mut().enumerate() {
        e.nodes = e.nodes.map(|n| order[n]);
        if i != 1 {
            e.nodes.reverse();
            e.points.reverse();
        }
    }
    let permuted = run(&other, roles).unwrap();
    for a in &base.junctions[0].angles {
        let b = angle(&permuted.junctions[0], &a.name).unwrap();
        assert!((a.value_deg.unwrap() - b).abs() < 1e-9, "{} {:?} {b}", a.name, a.value_deg);
    }
    for a in &base.branches {
        let b = permuted.branches.iter().find(|b| b.role == a.role).unwrap();
        assert_eq!(a.sections.len(), b.sections.len());
        for (s, t) in a.sections.iter().zip(&b.sections) {
            assert_eq!((s.open, s.in_junction), (t.open, t.in_junction));
            assert!(s.position.distance(t.position) < 1e-9);
            assert!((s.abscissa_mm - t.abscissa_mm).abs() < 1e-9);
            assert!((s.area_mm2.unwrap_or(0.0) - t.area_mm2.unwrap_or(0.0)).abs() < 1e-9);
        }
    }
}

#[test]
fn the_bits_do_not_depend_on_the_number_of_threads() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 2.0], 0.05);
    let settings = Settings { roles: points(&case, [true; 3]), ..Settings::default() };
    let one = run_with(&case, settings.clone(), 1).unwrap();
    for threads in [2, 3] {
        assert_eq!(format!("{one:?}"), format!("{:?}", run_with(&case, settings.clone(), threads).unwrap()));
    }
}

#[test]
fn the_rule_finds_graft_and_host_and_says_so() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 3.0], 0.0);
    let m = run(&case, Roles::default()).unwrap();
    let expected = ["graft_host_a", "graft_host_b_planar", "host_b_normal", "host_a_host_b", "graft_host_b"];
    assert_eq!(names(&m.junctions[0]), expected);
    assert!((angle(&m.junctions[0], "graft_host_a").unwrap() - 45.0).abs() < 0.05);
    assert!(codes(&m).contains(&"roles.by_rule") && codes(&m).contains(&"roles.flow_unknown"));
    let flow = Roles { flow_from: Some(case.graph.edges[2].points[80]), ..Roles::default() };
    let m = run(&case, flow).unwrap();
    assert_eq!(m.branches.iter().map(|b| b.role).collect::<Vec<_>>(), [Role::Graft, Role::Distal, Role::Proximal]);
    assert!((angle(&m.junctions[0], "graft_proximal").unwrap() - truth(45.0, 15.0)[4].1).abs() < 0.05);
}

#[test]
fn partial_roles_are_completed() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 3.0], 0.0);
    for which in [[true, true, false], [true, false, true], [false, true, true], [false, true, false]] {
        let m = run(&case, points(&case, which)).unwrap();
        let roles: Vec<Role> = m.branches.iter().map(|b| b.role).collect();
        assert_eq!(roles, [Role::Graft, Role::Proximal, Role::Distal], "{which:?}");
    }
    let m = run(&case, points(&case, [true, false, false])).unwrap();
    assert_eq!(m.branches[1].role, Role::HostA);
}

#[test]
fn roles_that_cannot_be_are_refused_with_their_field() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 3.0], 0.0);
    let mut roles = points(&case, [true; 3]);
    roles.distal = Some(case.graph.edges[0].points[80]);
    let e = run(&case, roles).unwrap_err();
    assert_eq!((e.code(), e.place().field.as_deref()), ("roles.conflict", Some("roles.distal_mm")));
    roles.distal = Some(P3::new(500.0, 0.0, 0.0));
    let e = run(&case, roles).unwrap_err();
    assert_eq!((e.code(), e.place().field.as_deref()), ("roles.far", Some("roles.distal_mm")));
    let bad = Settings { fit_from_diameters: Some(5.0), ..Settings::default() };
    assert_eq!(run_with(&case, bad, 1).unwrap_err().code(), "angles.window");
}

#[test]
fn a_short_branch_gives_null_and_says_why() {
    let branches =
        [(DVec3::new(1.0, 0.0, 1.0), 10.0, 2.5), (DVec3::Z, 36.0, 3.0), (DVec3::new(0.0, 0.2, -1.0), 36.0, 3.0)];
    let mut case = star(DVec3::ZERO, &branches, 0.0);
    // a plane across the graft that leaves the host whole
    case.cuts[0] = CutPlane::new(P3::new(8.0, 0.0, 0.0), V3::X);
    let roles = Roles { graft: Some(case.graph.edges[0].points[30]), ..Roles::default() };
    let m = run(&case, roles).unwrap();
    assert_eq!(angle(&m.junctions[0], "graft_host_a"), None);
    assert!((angle(&m.junctions[0], "host_a_host_b").unwrap() - 168.690_067_525_979_8).abs() < 0.05);
    assert!(codes(&m).contains(&"angles.window_too_short"), "{:?}", m.warnings);
}

#[test]
fn a_shortened_window_is_said() {
    let branches =
        [(DVec3::new(1.0, 0.0, 1.0), 16.0, 2.5), (DVec3::Z, 36.0, 3.0), (DVec3::new(0.0, 0.2, -1.0), 36.0, 3.0)];
    let case = star(DVec3::ZERO, &branches, 0.0);
    let m = run(&case, points(&star(DVec3::ZERO, &[branches[1]; 3], 0.0), [false; 3])).unwrap();
    assert!((angle(&m.junctions[0], "graft_host_a").unwrap() - 45.0).abs() < 0.05);
    assert!(codes(&m).contains(&"angles.window_shortened"), "{:?}", m.warnings);
}

#[test]
fn a_bent_distal_vessel_is_told_by_the_curve_over_distance() {
    let mut case = anastomosis(45.0, 0.0, [2.5, 3.0, 3.0], 0.0);
    let centre = case.graph.nodes[0].position.raw();
    // straight for 15 mm, then an arc of radius 30 mm towards -x
    let bent = |s: f64| {
        let a = (s - 15.0).max(0.0) / 30.0;
        let along = s.min(15.0) + 30.0 * a.sin();
        centre + DVec3::new(-30.0 * (1.0 - a.cos()), 0.0, -along)
    };
    let axis: Vec<DVec3> = (0..=400).map(|k| bent(0.12 * f64::from(k))).collect();
    case.field.0[2].0 = axis;
    let line: Vec<P3> = (0..=120).map(|k| P3::from_raw(bent(0.3 * f64::from(k)))).collect();
    case.graph.nodes[3].position = line[120];
    case.graph.edges[2] = Edge { nodes: [0, 3], radius_mm: vec![3.0; line.len()], points: line };
    let d = bent(36.1) - bent(36.0);
    case.cuts[2] = CutPlane::new(P3::from_raw(bent(36.0)), V3::from_raw(d.normalize()));
    let m = run(&case, points(&case, [true; 3])).unwrap();
    let a = m.junctions[0].angles.iter().find(|a| a.name == "graft_distal").unwrap();
    let curve = a.by_distance.as_ref().unwrap();
    let (first, last) = (curve.value_deg[0].unwrap(), curve.value_deg.iter().rev().flatten().next().copied().unwrap());
    assert!((first - 135.0).abs() < 1.0, "{first}");
    // the arc turns away from the graft: 135 grows until the angle is measured the other way round at 180
    assert!(last > first + 5.0, "{first} {last}");
    let bend: Vec<f64> = m.branches[2]
        .sections
        .iter()
        .filter(|s| s.abscissa_mm > 24.5 && s.abscissa_mm < 30.0)
        .filter_map(|s| s.curvature_per_mm)
        .collect();
    assert!(!bend.is_empty() && bend.iter().all(|k| (k * 30.0 - 1.0).abs() < 0.01), "{bend:?}");
}

#[test]
fn a_junction_of_four_gives_all_pairs() {
    let branches = [
        (DVec3::new(1.0, 0.0, 1.0), 40.0, 2.0),
        (DVec3::Z, 40.0, 2.0),
        (-DVec3::Z, 40.0, 2.0),
        (DVec3::new(-0.2, 1.0, 0.0), 40.0, 2.0),
    ];
    let case = star(DVec3::new(5.0, 5.0, 5.0), &branches, 0.02);
    let m = run(&case, Roles::default()).unwrap();
    let j = &m.junctions[0];
    assert_eq!(j.angles.len(), 6);
    assert!(m.branches.iter().all(|b| b.role == Role::Other));
    for (i, a) in branches.iter().enumerate() {
        for (k, b) in branches.iter().enumerate().skip(i + 1) {
            let value = angle(j, &format!("branch_{i}_branch_{k}")).unwrap();
            assert!((value - a.0.angle_between(b.0).to_degrees()).abs() < 0.05, "{i} {k} {value}");
        }
    }
}

#[test]
fn a_tube_without_a_junction_has_sections_and_no_angle() {
    let mut case = Case { field: Tubes(Vec::new()), graph: MedialGraph::default(), cuts: Vec::new() };
    // a helix of curvature .049 and torsion .033 per mm, tube radius 3 mm
    let (k, t) = (0.049f64, 0.033f64);
    let w2 = k * k + t * t;
    let at = |s: f64| {
        let (sin, cos) = (w2.sqrt() * s).sin_cos();
        DVec3::new(k / w2 * cos, k / w2 * sin, t / w2.sqrt() * s)
    };
    let axis: Vec<DVec3> = (0..=325).map(|i| at(0.2 * f64::from(i))).collect();
    case.field.0.push((axis.clone(), 3.0));
    case.graph.nodes.push(node(NodeKind::End, axis[0], 3.0));
    let line: Vec<DVec3> = axis.iter().step_by(2).copied().collect();
    add(&mut case.graph, 0, &line, 3.0);
    let m = run(&case, Roles::default()).unwrap();
    assert!(m.junctions.is_empty());
    let b = &m.branches[0];
    assert_eq!(b.role, Role::Other);
    let helix = b.helix.unwrap();
    assert!((helix.curvature_per_mm / k - 1.0).abs() < 2e-3, "{helix:?}");
    assert!((helix.torsion_per_mm / t - 1.0).abs() < 2e-3, "{helix:?}");
    let area: Vec<f64> = b.sections[20..b.sections.len() - 20].iter().filter_map(|s| s.area_mm2).collect();
    assert!(area.len() > 100 && area.iter().all(|a| (a / (9.0 * std::f64::consts::PI) - 1.0).abs() < 2e-3));
    let bends: Vec<f64> = b.sections[30..b.sections.len() - 30].iter().filter_map(|s| s.curvature_per_mm).collect();
    assert!(bends.iter().all(|c| (c / k - 1.0).abs() < 5e-3));
}

#[test]
fn a_loop_between_two_junctions_is_measured_at_both() {
    let mut case = Case { field: Tubes(Vec::new()), graph: MedialGraph::default(), cuts: Vec::new() };
    let ring = |a: f64| DVec3::new(20.0 * a.cos(), 20.0 * a.sin(), 0.0);
    let (left, right) = (ring(std::f64::consts::PI), ring(0.0));
    case.graph.nodes = vec![node(NodeKind::Junction, left, 2.0), node(NodeKind::Junction, right, 2.0)];
    for sign in [1.0, -1.0] {
        let line: Vec<DVec3> =
            (0..=200).map(|k| ring(sign * std::f64::consts::PI * (1.0 - f64::from(k) / 200.0))).collect();
        case.field.0.push((line.clone(), 2.0));
        case.graph.edges.push(Edge {
            nodes: [0, 1],
            radius_mm: vec![2.0; line.len()],
            points: line.into_iter().map(P3::from_raw).collect(),
        });
    }
    for (from, start) in [(0, left), (1, right)] {
        let out = start.normalize();
        let line: Vec<DVec3> = (0..=80).map(|k| start + out * (0.4 * f64::from(k))).collect();
        case.field.0.push((vec![start, start + out * 40.0], 2.0));
        add(&mut case.graph, from, &line, 2.0);
        case.cuts.push(CutPlane::new(P3::from_raw(start + out * 32.0), V3::from_raw(out)));
    }
    assert_eq!(case.graph.cycles(), 1);
    let m = run(&case, Roles::default()).unwrap();
    assert_eq!(m.junctions.len(), 2);
    assert_eq!(m.branches[0].role, Role::Other);
    let crotch = |j: usize| m.junctions[j].crotch_mm.unwrap();
    assert!((crotch(0) - crotch(1)).abs() < 1e-6);
    let both = |s: &morphometry::Section| s.in_junction;
    assert!(both(&m.branches[0].sections[0]) && both(m.branches[0].sections.last().unwrap()));
}

#[test]
fn sections_beyond_a_cut_are_open_and_cancelled_work_stops() {
    let mut case = anastomosis(45.0, 15.0, [2.5, 3.0, 3.0], 0.0);
    let d = V3::new(1.0, 0.0, 1.0).normalised().unwrap();
    case.cuts[0] = CutPlane::new(case.graph.nodes[0].position + d * 30.0, V3::X);
    let m = run(&case, points(&case, [true; 3])).unwrap();
    let last = m.branches[0].sections.last().unwrap();
    assert!(last.open && last.area_mm2.is_none());
    assert!((angle(&m.junctions[0], "graft_proximal").unwrap() - 45.0).abs() < 0.05);
    let ctx = Ctx::new(1).unwrap();
    ctx.cancel();
    let e = measure(&case.graph, &case.field, &case.cuts, &Settings::default(), &ctx).unwrap_err();
    assert_eq!(e.code(), "cancelled");
}

/// Draws that move the whole field, or one side of it, by a fixed length with alternating signs.
struct Shifts {
    radial_mm: f64,
    /// The field's centre moves along this, mm.
    move_mm: DVec3,
    field: Tubes,
}

impl implicit::Draws for Shifts {
    fn count(&self) -> usize {
        2
    }
    fn differences(&self, draw: usize, at: &[P3], out: &mut [f64]) {
        let sign = if draw == 0 { 1.0 } else { -1.0 };
        for (o, x) in out.iter_mut().zip(at) {
            *o = sign * (self.radial_mm - self.field.gradient(*x).1.raw().dot(self.move_mm));
        }
    }
}

#[test]
fn bands_have_the_size_of_the_draws() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 2.0], 0.0);
    let run = |radial_mm: f64, move_mm: DVec3| {
        let draws = Shifts { radial_mm, move_mm, field: Tubes(case.field.0.clone()) };
        let settings = Settings { roles: points(&case, [true; 3]), ..Settings::default() };
        let ctx = Ctx::new(2).unwrap();
        morphometry::measure_with_bands(&case.graph, &case.field, &case.cuts, Some(&draws), &settings, &ctx).unwrap()
    };
    // two draws: Student's quantile to first order
    let student = 1.96 * (1.0 + (1.96_f64.powi(2) + 1.0) / (4.0 * 2.0));
    // every wall .1 mm out or in: diameters +- .2, areas +- 2 pi r .1, angles not at all
    let m = run(0.1, DVec3::ZERO);
    for (b, r) in m.branches.iter().zip([2.5, 3.0, 2.0]) {
        let [low, high] = b.diameter_band95_mm.unwrap();
        assert!((0.5 * (high - low) - student * 0.2).abs() < 0.01, "{low} {high}");
        let s = b.sections.iter().find(|s| !s.in_junction && !s.open && s.area_error_mm2.is_some()).unwrap();
        assert!((s.area_error_mm2.unwrap() / (std::f64::consts::TAU * r * 0.1) - 1.0).abs() < 0.03, "{s:?}");
        assert!(s.curvature_error_per_mm.is_none_or(|e| e < 1e-3), "{s:?}");
    }
    for a in &m.junctions[0].angles {
        let [low, high] = a.band95_deg.unwrap();
        assert!(high - low < 0.01, "{} {low} {high}", a.name);
    }
    // all moved as one: nothing changes but the place
    let m = run(0.0, DVec3::new(0.05, -0.03, 0.04));
    for a in &m.junctions[0].angles {
        let [low, high] = a.band95_deg.unwrap();
        assert!(high - low < 0.02, "{} {low} {high}", a.name);
    }
    assert!(m.branches.iter().all(|b| b.diameter_band95_mm.is_some_and(|[low, high]| high - low < 0.01)));
    let without = run_with(&case, Settings::default(), 1).unwrap();
    assert!(without.junctions[0].angles.iter().all(|a| a.band95_deg.is_none()));
}

#[test]
fn every_junction_of_a_tree_is_measured() {
    // a host along z with a side branch at z = 0 and another at z = 40
    let mut case = Case { field: Tubes(Vec::new()), graph: MedialGraph::default(), cuts: Vec::new() };
    let (low, high) = (DVec3::ZERO, DVec3::new(0.0, 0.0, 40.0));
    case.graph.nodes = vec![node(NodeKind::Junction, low, 2.0), node(NodeKind::Junction, high, 2.0)];
    let line = |from: DVec3, d: DVec3, length: f64| -> Vec<DVec3> {
        (0..=(length / 0.4) as usize).map(|k| from + d * (0.4 * k as f64)).collect()
    };
    let between = line(low, DVec3::Z, 40.0);
    case.field.0.push((vec![low, high], 2.0));
    case.graph.edges.push(Edge {
        nodes: [0, 1],
        radius_mm: vec![2.0; between.len()],
        points: between.into_iter().map(P3::from_raw).collect(),
    });
    let side = |angle: f64, y: f64| {
        let (s, c) = angle.to_radians().sin_cos();
        DVec3::new(s, y, c).normalize()
    };
    let (a, b) = (side(60.0, 0.0), side(50.0, 0.0));
    for (from, d) in [(0, -DVec3::Z), (0, a), (1, DVec3::Z), (1, b)] {
        let start = if from == 0 { low } else { high };
        case.field.0.push((vec![start, start + d * 36.0], 2.0));
        add(&mut case.graph, from, &line(start, d, 30.0), 2.0);
        case.cuts.push(CutPlane::new(P3::from_raw(start + d * 30.0), V3::from_raw(d)));
    }
    // planes of side branches would cut the others: keep only those across the host
    case.cuts = vec![case.cuts[0], case.cuts[2]];
    let m = run(&case, Roles::default()).unwrap();
    assert_eq!(m.junctions.len(), 2);
    for (j, expected) in m.junctions.iter().zip([60.0, 50.0]) {
        let value = angle(j, "graft_host_a").unwrap_or_else(|| panic!("{:?}", m.warnings));
        assert!((value - expected).abs() < 0.05, "{value} for {expected}");
    }
}

#[test]
fn shape_narrowing_and_kind_of_curve_are_told() {
    let case = anastomosis(45.0, 15.0, [2.5, 3.0, 2.0], 0.0);
    let m = run(&case, Roles::default()).unwrap();
    for b in &m.branches {
        assert!(b.stenosis.unwrap().area_ratio > 0.99, "{:?}", b.stenosis);
        let shapes: Vec<f64> = b.sections.iter().filter(|s| !s.in_junction).filter_map(|s| s.shape).collect();
        assert!(shapes.len() > 20 && shapes.iter().all(|s| *s > 0.995 && *s <= 1.0), "{shapes:?}");
    }
    for a in &m.junctions[0].angles {
        let curve = a.by_distance.as_ref().unwrap();
        assert_eq!(curve.residual_mm.len(), curve.diameters.len());
        assert!(curve.residual_mm.iter().flatten().all(|r| *r < 0.01), "{}: {:?}", a.name, curve.residual_mm);
    }
}

#[test]
fn a_thin_side_branch_near_a_junction_ends_no_window() {
    let whole = anastomosis(45.0, 12.0, [2.5, 3.0, 3.0], 0.0);
    let expected = run(&whole, points(&whole, [true; 3])).unwrap();
    let mut case = anastomosis(45.0, 12.0, [2.5, 3.0, 3.0], 0.0);
    let roles = points(&case, [true; 3]);
    // the proximal vessel gives off a branch of .8 mm 12 mm from the junction: alone it is too short for a window
    let (split, outward) = (40, DVec3::new(-0.3, 1.0, 0.3).normalize());
    let edge = &mut case.graph.edges[1];
    let far = edge.points.split_off(split);
    let at = edge.points[split - 1];
    let [near_end, far_end] = [edge.nodes[0], edge.nodes[1]];
    let middle = case.graph.nodes.len();
    case.graph.nodes.push(node(NodeKind::Junction, at.raw(), 3.0));
    case.graph.edges[1].nodes = [near_end, middle];
    case.graph.edges[1].radius_mm = vec![3.0; split];
    let rest: Vec<P3> = std::iter::once(at).chain(far).collect();
    case.graph.edges.push(Edge { nodes: [middle, far_end], radius_mm: vec![3.0; rest.len()], points: rest });
    case.field.0.push((vec![at.raw(), at.raw() + outward * 14.0], 0.8));
    let twig: Vec<DVec3> = (0..=40).map(|k| at.raw() + outward * (0.3 * k as f64)).collect();
    add(&mut case.graph, middle, &twig, 0.8);
    let m = run(&case, Roles { proximal: Some(at), ..roles }).unwrap();
    let (j, wanted) = (m.junctions.iter().find(|j| j.node == 0).unwrap(), &expected.junctions[0]);
    for a in &wanted.angles {
        let value = angle(j, &a.name).unwrap_or_else(|| panic!("{}: {:?}", a.name, m.warnings));
        assert!((value - a.value_deg.unwrap()).abs() < 0.1, "{}: {value} for {:?}", a.name, a.value_deg);
    }
}

#[test]
fn branches_that_bend_apart_part_where_their_lumens_do() {
    // arteries of 3 mm that leave a trunk at 60 degrees and bend until 16 are left: tubes along their later axes would
    // overlap up to 3 / tan 8 = 21 mm, from a point 10 mm up the trunk; the lumens part at about 3 / tan 30 = 5.2
    let arm = |side: f64| {
        let mut points = vec![DVec3::ZERO];
        for k in 0..140 {
            let s = 0.3 * f64::from(k);
            let from_trunk = (30.0 - 22.0 * ((s - 6.0) / 9.0).clamp(0.0, 1.0)).to_radians();
            points.push(points[points.len() - 1] + DVec3::new(side * from_trunk.sin(), 0.0, -from_trunk.cos()) * 0.3);
        }
        points
    };
    let trunk: Vec<DVec3> = (0..=120).map(|k| DVec3::Z * (0.3 * f64::from(k))).collect();
    let mut case = Case { field: Tubes(Vec::new()), graph: MedialGraph::default(), cuts: Vec::new() };
    case.graph.nodes.push(node(NodeKind::Junction, DVec3::ZERO, 4.0));
    for (points, radius) in [(trunk, 4.0), (arm(1.0), 3.0), (arm(-1.0), 3.0)] {
        let (last, before) = (points[points.len() - 1], points[points.len() - 2]);
        let outward = (last - before).normalize();
        case.cuts.push(CutPlane::new(P3::from_raw(last), V3::from_raw(outward)));
        add(&mut case.graph, 0, &points, radius);
        let longer = points.iter().copied().chain([last + outward * 6.0]).collect();
        case.field.0.push((longer, radius));
    }
    let m = run(&case, Roles::default()).unwrap();
    let j = &m.junctions[0];
    assert!(!codes(&m).contains(&"angles.unsettled"), "{:?}", m.warnings);
    assert!(!codes(&m).contains(&"angles.window_moved"), "{:?}", m.warnings);
    let crotch = j.crotch_mm.unwrap();
    assert!((crotch - 3.0 / 30.0f64.to_radians().tan()).abs() < 0.6, "{crotch}");
    let arms = j.angles.iter().filter_map(|a| a.value_deg).fold(f64::INFINITY, f64::min);
    assert!((16.0..32.0).contains(&arms), "{arms} of {:?}", j.angles.iter().map(|a| a.value_deg).collect::<Vec<_>>());
}
