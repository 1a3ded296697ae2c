#![allow(clippy::unwrap_used)]
use super::*;
use crate::fields::{self, Analytic};
use crate::{PolygoniseSettings, RemeshSettings, Sizing, WALL, cut, polygonise, remesh};
use space::{Faulty, V3};

fn meshed(field: &Analytic, seed: P3, cuts: &[CutPlane], sizing: Sizing, ctx: &Ctx) -> TriMesh {
    let bounded = crate::Bounded::new(field, cuts, 8.0);
    let (raw, _) = polygonise(&bounded, &[seed], &PolygoniseSettings::default(), ctx).unwrap();
    let mesh = if cuts.is_empty() { raw } else { cut(&raw, field, cuts, ctx).unwrap().0 };
    let s = RemeshSettings { sizing, ..RemeshSettings::default() };
    remesh(&mesh, field, cuts, &s, ctx).unwrap().0
}

fn ends(height: f64) -> Vec<CutPlane> {
    vec![CutPlane::new(P3::new(0.0, 0.0, height), V3::Z), CutPlane::new(P3::new(0.0, 0.0, -height), -V3::Z)]
}

/// Patches meet edge to edge, cover the wall once, lie on f and are proven not to fold.
fn sound(q: &Quads, mesh: &TriMesh, field: &Analytic, holes: usize, euler: i64) {
    let p = q.order;
    let mut edges: BTreeMap<Vec<u32>, usize> = BTreeMap::new();
    let mut corners = BTreeSet::new();
    for c in &q.cells {
        let at = |b: usize, a: usize| c[b * (p + 1) + a];
        let lines: [Vec<u32>; 4] = [
            (0..=p).map(|k| at(0, k)).collect(),
            (0..=p).map(|k| at(p, k)).collect(),
            (0..=p).map(|k| at(k, 0)).collect(),
            (0..=p).map(|k| at(k, p)).collect(),
        ];
        for mut line in lines {
            corners.insert(line[0]);
            if line[0] > line[p] {
                line.reverse();
            }
            *edges.entry(line).or_default() += 1;
        }
    }
    let rim: Vec<&Vec<u32>> = edges.iter().filter(|e| *e.1 == 1).map(|e| e.0).collect();
    assert!(edges.values().all(|&n| n <= 2));
    assert_eq!(corners.len() as i64 - edges.len() as i64 + q.cells.len() as i64, euler);
    // Every open edge lies in a cap's plane.
    let planes = cap_planes(mesh, &ends_of(mesh)).unwrap();
    for &v in rim.iter().copied().flatten() {
        let off = planes.iter().map(|f| f.height(q.nodes[v as usize].raw()).abs()).fold(f64::INFINITY, f64::min);
        assert!(off < 1e-9, "{off}");
    }
    assert!((holes == 0) == rim.is_empty());
    for &x in &q.nodes {
        let (f, g) = field.gradient(x);
        assert!(f.abs() / g.length() <= 1e-9);
    }
    assert!(q.max_error_mm <= 0.01 && q.least_jacobian > 0.0, "{} {}", q.max_error_mm, q.least_jacobian);
    let basis = Basis::new(p);
    let area: f64 = q.cells.iter().map(|c| area(&basis, c.iter().map(|&i| q.nodes[i as usize].raw()).collect())).sum();
    let wall = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL);
    let flat: f64 = wall.map(|t| 0.5 * mesh.area_vector(t).length()).sum();
    assert!((area / flat - 1.0).abs() < 0.01, "{area} {flat}");
}

/// The planes in which the caps lie, from the caps.
fn ends_of(mesh: &TriMesh) -> Vec<CutPlane> {
    let caps = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] != WALL);
    let mut out: BTreeMap<u32, CutPlane> = BTreeMap::new();
    for t in caps {
        let n = mesh.area_vector(t).normalised().unwrap();
        out.entry(mesh.face_id[t]).or_insert(CutPlane::new(mesh.corners(t)[0], n));
    }
    out.into_values().collect()
}

/// Area by the midpoint rule; the normal against f's gradient is part of the proof's sign and not asked here.
fn area(basis: &Basis, nodes: Vec<DVec3>) -> f64 {
    let patch = Patch { basis, nodes };
    let n = 16;
    let at = |k: usize| (k as f64 + 0.5) / n as f64;
    let cross = |k: usize| {
        let [_, a, b] = patch.at(at(k % n), at(k / n));
        a.cross(b).length()
    };
    (0..n * n).map(cross).sum::<f64>() / (n * n) as f64
}

#[test]
fn a_tube_a_bifurcation_and_a_trifurcation_are_covered() {
    let ctx = Ctx::new(2).unwrap();
    let tube = fields::tree(vec![(V3::Z, 24.0, 3.0), (-V3::Z, 24.0, 3.0)], vec![1e-6]);
    let mesh = meshed(&tube, P3::new(-3.0, 0.0, 12.0), &ends(15.03), Sizing::Uniform(0.6), &ctx);
    let q = quads(&mesh, &tube, &ends(15.03), &[], &QuadSettings::default(), &ctx).unwrap();
    sound(&q, &mesh, &tube, 2, 0);
    assert!(q.poles.is_empty());

    let field = fields::anastomosis();
    let mesh = meshed(&field, P3::new(-3.0, 0.0, 12.0), &ends(15.03), Sizing::Uniform(0.6), &ctx);
    let q = quads(&mesh, &field, &ends(15.03), &[], &QuadSettings::default(), &ctx).unwrap();
    sound(&q, &mesh, &field, 3, -1);
    assert_eq!(q.poles.len(), 2);
    // Outside is where the first parameter turned to the second points.
    let c = q.cells[0].iter().map(|&i| q.nodes[i as usize].raw()).collect();
    let n = Patch { basis: &Basis::new(4), nodes: c };
    assert!(field.gradient(P3::from_raw(n.at(0.5, 0.5)[0])).1.raw().dot(n.direction()) < 0.0);

    let branches = [(V3::Z, 3.0), (-V3::Z, 3.0), (V3::new(0.8, 0.0, 0.6), 2.5), (V3::new(-0.6, 0.0, 0.8), 2.5)];
    let field = fields::tree(branches.map(|(d, r)| (d, 24.0, r)).to_vec(), vec![1.5, 1.5, 1.5]);
    let mut cuts = vec![CutPlane::new(P3::new(15.0, 0.0, 0.0), V3::X)];
    cuts.extend(ends(15.03));
    let mesh = meshed(&field, P3::new(-3.0, 0.0, 12.0), &cuts, Sizing::Curvature, &ctx);
    let q = quads(&mesh, &field, &cuts, &[], &QuadSettings::default(), &ctx).unwrap();
    sound(&q, &mesh, &field, 4, -2);
    assert_eq!(q.poles.len(), 4);
}

#[test]
fn a_loop_is_covered_from_a_section_on_and_refused_without_one() {
    let ctx = Ctx::new(2).unwrap();
    let field = fields::torus(6.0, 2.0);
    let mesh = meshed(&field, P3::new(8.0, 0.0, 0.0), &[], Sizing::Uniform(0.5), &ctx);
    let none = quads(&mesh, &field, &[], &[], &QuadSettings::default(), &ctx).unwrap_err();
    assert_eq!(none.code(), "surface.patches");
    assert!(none.place().position.is_some());
    let section = [CutPlane::new(P3::new(6.0, 0.0, 0.0), V3::Y).within(4.0)];
    let q = quads(&mesh, &field, &[], &section, &QuadSettings::default(), &ctx).unwrap();
    sound(&q, &mesh, &field, 0, 0);

    // A ring between two vessels: one section on each side.
    let (a, b) = (fields::torus(6.0, 2.0), fields::tree(vec![], vec![]).bounds);
    let f = move |x: P3| {
        let arm = |d: V3| {
            let c = fields::capsule(x, d, 20.0, 1.8);
            let t = (x - P3::ORIGIN).dot(d);
            // Only outside the ring.
            if t < 6.0 {
                let p = x - (P3::ORIGIN + d * 6.0);
                (p.length() - 1.8, p.normalised().unwrap_or(V3::X))
            } else {
                c
            }
        };
        let ring = (a.f)(x);
        let two = fields::smin(arm(V3::X), arm(-V3::X), 1e-3);
        let all = fields::smin((-ring.0, -ring.1), two, 1.5);
        (-all.0, -all.1)
    };
    let field = Analytic { f: Box::new(f), bounds: b };
    let cuts = [CutPlane::new(P3::new(13.0, 0.0, 0.0), V3::X), CutPlane::new(P3::new(-13.0, 0.0, 0.0), -V3::X)];
    let mesh = meshed(&field, P3::new(0.0, 8.0, 0.0), &cuts, Sizing::Uniform(0.5), &ctx);
    let side = |y: f64| CutPlane::new(P3::new(0.0, y, 0.0), V3::X).within(4.0);
    let q = quads(&mesh, &field, &cuts, &[side(6.0), side(-6.0)], &QuadSettings::default(), &ctx).unwrap();
    sound(&q, &mesh, &field, 2, -2);
    assert_eq!(q.poles.len(), 4);
}

#[test]
fn unequal_lengths_move_no_pole_and_threads_change_nothing() {
    let ctx = Ctx::new(2).unwrap();
    let field = fields::anastomosis();
    let seed = P3::new(-3.0, 0.0, 3.0);
    let of = |cuts: &[CutPlane], edge: f64, ctx: &Ctx| {
        let mesh = meshed(&field, seed, cuts, Sizing::Uniform(edge), ctx);
        let q = quads(&mesh, &field, cuts, &[], &QuadSettings::default(), ctx).unwrap();
        sound(&q, &mesh, &field, 3, -1);
        q
    };
    let far = |a: &Quads, b: &Quads| {
        let nearest = |p: &P3| b.poles.iter().map(|q| q.distance(*p)).fold(f64::INFINITY, f64::min);
        a.poles.iter().map(nearest).fold(0.0, f64::max)
    };
    let cuts = ends(15.03);
    let q = of(&cuts, 0.6, &ctx);
    let finer = of(&cuts, 0.4, &ctx);
    // 5 % of a diameter.
    assert!(far(&q, &finer) <= 0.3, "{}", far(&q, &finer));
    let mut short = ends(15.03);
    short[1] = CutPlane::new(P3::new(0.0, 0.0, -6.0), -V3::Z);
    let other = of(&short, 0.6, &ctx);
    assert!(far(&q, &other) <= 1.0, "{}", far(&q, &other));
    assert_eq!(q, of(&cuts, 0.6, &Ctx::new(1).unwrap()));
    ctx.cancel();
    let stopped = meshed(&field, seed, &cuts, Sizing::Uniform(0.6), &Ctx::new(1).unwrap());
    assert!(matches!(quads(&stopped, &field, &cuts, &[], &QuadSettings::default(), &ctx), Err(Error::Cancelled)));
}

#[test]
fn drawn_vessels_are_covered_unless_one_ends_blind() {
    let ctx = Ctx::new(2).unwrap();
    let mut covered = 0;
    for i in [0, 2, 3, 6, 7, 10, 14, 18, 19, 23, 31, 43] {
        let mut dice = crate::phantoms::Dice(i as u64 * 977 + 1);
        let p = crate::phantoms::phantom(&mut dice, i);
        let mesh = meshed(&p.field, p.seed, &p.cuts, Sizing::Curvature, &ctx);
        let caps = mesh.face_id.iter().copied().max().unwrap() as usize;
        let branches = p.branches;
        match quads(&mesh, &p.field, &p.cuts, &p.sections, &QuadSettings::default(), &ctx) {
            Ok(q) => {
                sound(&q, &mesh, &p.field, caps, if branches == 0 { 0 } else { 2 - caps as i64 });
                assert_eq!(q.poles.len(), if branches == 0 { 0 } else { 2 * (branches - 2) });
                covered += 1;
            }
            Err(e) => {
                assert!(caps < branches, "{i}: {e}");
                assert!(e.code() == "surface.patches" && e.place().position.is_some());
            }
        }
    }
    assert!(covered >= 10, "{covered}");
}
