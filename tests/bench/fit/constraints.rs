//! Constraints as a scan gives them: contours in parallel planes through the benchmark anastomosis, three steps apart, and
//! a point 1 mm inside for each of theirs.

use phantom::{Bifurcation, Vessel};
use space::{P3, V3};
use std::collections::HashMap;

/// Half of the box that holds the vessel, mm.
const REACH_MM: f64 = 32.0;
/// Planes lie this many steps apart, as 1.5 mm slices of .5 mm pixels do.
const PLANES: f64 = 3.0;
/// Normal of the planes: not an axis, so that no branch lies along them.
const NORMAL: [f64; 3] = [0.12, 0.21, 0.97];
/// Depth of interior points, mm.
const OFFSET_MM: f64 = 1.0;

/// x, y, z (scaled) and value (mm) of n constraints, half on the wall, half inside.
pub(crate) fn of(n: usize) -> Vec<f64> {
    let vessel = Bifurcation::benchmark().capsules(P3::ORIGIN, 24.0);
    let wanted = n / 2;
    // the finest step that gives at least as many as wanted: their number falls as the square of the step
    let mut step = 0.5;
    let mut wall = contours(&vessel, step);
    while wall.len() < wanted || wall.len() > wanted + wanted / 50 {
        step *= (wall.len() as f64 / (1.01 * wanted as f64)).sqrt();
        wall = contours(&vessel, step);
    }
    let kept = (0..wanted).map(|k| wall[k * wall.len() / wanted]);
    let mut points: Vec<(P3, f64)> = kept.clone().map(|p| (p, 0.0)).collect();
    points.extend(kept.map(|p| {
        let inward = vessel.gradient(p).1.normalised().unwrap_or(V3::Z);
        let inside = p + inward * OFFSET_MM;
        (inside, vessel.distance(inside))
    }));
    let positions: Vec<P3> = points.iter().map(|p| p.0).collect();
    let centre = P3::centroid(&positions).unwrap_or(P3::ORIGIN);
    let far = positions.iter().fold(0.0_f64, |m, p| m.max(p.distance(centre)));
    points.iter().flat_map(|(p, v)| ((*p - centre) / far).to_array().into_iter().chain([*v])).collect()
}

/// Points about `step` mm apart along the wall's sections.
fn contours(vessel: &Vessel, step: f64) -> Vec<P3> {
    let normal = V3::from(NORMAL).normalised().unwrap_or(V3::Z);
    let u = normal.cross(V3::X).normalised().unwrap_or(V3::Y);
    let v = normal.cross(u);
    let planes = (2.0 * REACH_MM / (PLANES * step)) as i64;
    let cells = (2.0 * REACH_MM / step) as i64;
    let mut out = Vec::new();
    for plane in 0..planes {
        let origin = P3::ORIGIN + normal * (plane as f64 * PLANES * step - REACH_MM);
        let mut near: HashMap<(i64, i64), Vec<[f64; 2]>> = HashMap::new();
        for cell in 0..cells * cells {
            let start = [cell % cells, cell / cells].map(|i| i as f64 * step - REACH_MM);
            let Some(at) = foot_in_plane(vessel, |[a, b]| origin + u * a + v * b, (u, v), start, step) else {
                continue;
            };
            let key = at.map(|x| (x / step).floor() as i64);
            let around = (-1..=1).flat_map(|i| (-1..=1).map(move |j| (key[0] + i, key[1] + j)));
            let crowded = |p: &[f64; 2]| (p[0] - at[0]).hypot(p[1] - at[1]) < 0.8 * step;
            if around.filter_map(|k| near.get(&k)).flatten().any(crowded) {
                continue;
            }
            near.entry((key[0], key[1])).or_default().push(at);
            out.push(origin + u * at[0] + v * at[1]);
        }
    }
    out
}

/// The wall's point in the plane that Newton steps lead to from `start`, within a step and a half.
fn foot_in_plane(
    vessel: &Vessel,
    at: impl Fn([f64; 2]) -> P3,
    (u, v): (V3, V3),
    start: [f64; 2],
    step: f64,
) -> Option<[f64; 2]> {
    let mut x = start;
    if vessel.distance(at(x)).abs() > 1.5 * step {
        return None;
    }
    for _ in 0..20 {
        let (f, g) = vessel.gradient(at(x));
        let slope = [g.dot(u), g.dot(v)];
        let square = slope[0] * slope[0] + slope[1] * slope[1];
        if square < 0.05 || (x[0] - start[0]).hypot(x[1] - start[1]) > 1.5 * step {
            return None;
        }
        if f.abs() < 1e-12 {
            return Some(x);
        }
        x = [x[0] - f * slope[0] / square, x[1] - f * slope[1] / square];
    }
    None
}
