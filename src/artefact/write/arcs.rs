//! A junction's angles as arcs in the report's pictures: between which directions each stands, drawn where it is least
//! foreshortened.

use super::render::Camera;
use super::style::{ANGLE_RGB, hex};
use crate::Reconstruction;
use morphometry::{Branch, Junction};
use space::{P3, V3};
use std::fmt::Write as _;

/// Angles that are drawn: the three of the paper come first.
const DRAWN: usize = 3;
/// Radius of the first arc and what each further one adds, diameters of the graft.
const RADIUS: [f64; 2] = [1.9, 0.75];
/// Straight pieces of an arc.
const PIECES: usize = 32;
/// Largest disagreement of the drawn with the reported angle, degrees: an arc that shows another angle is not drawn.
const MISS: f64 = 5.0;

/// An angle between two unit vectors at a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arc {
    /// Number of the angle at its junction: its colour.
    index: usize,
    value_deg: f64,
    vertex: P3,
    from: V3,
    to: V3,
    radius_mm: f64,
}

/// The first measured angles of a junction.
pub(super) fn arcs(r: &Reconstruction<'_>, j: &Junction) -> Vec<Arc> {
    let branches: Vec<&Branch> = r.morphometry.branches.iter().filter(|b| j.branches.contains(&b.id)).collect();
    let graft = branches.iter().find(|b| b.role == morphometry::Role::Graft).or(branches.first());
    let diameter = graft.and_then(|b| b.diameter_mm).unwrap_or(5.0);
    let measured = j.angles.iter().enumerate().filter_map(|(i, a)| Some((i, a, a.value_deg?)));
    measured
        .take(DRAWN)
        .filter_map(|(index, a, value_deg)| {
            let (from, to) = directions(&a.name, &branches, j.plane_normal, value_deg)?;
            let radius_mm = diameter * (RADIUS[0] + RADIUS[1] * index as f64);
            Some(Arc { index, value_deg, vertex: j.axes_point.unwrap_or(j.medial_point), from, to, radius_mm })
        })
        .collect()
}

/// The two directions that an angle's name speaks of, with the signs under which they enclose its value: a branch between
/// two junctions has one direction, and a normal two sides.
fn directions(name: &str, branches: &[&Branch], normal: Option<V3>, value_deg: f64) -> Option<(V3, V3)> {
    let (first, rest) = leading(name, branches)?;
    let second = leading(rest, branches);
    let (from, to) = match second {
        Some((b, "")) => (first.direction?, b.direction?),
        Some((b, "planar")) => {
            let (d, n) = (b.direction?, normal?);
            (first.direction?, (d - n * d.dot(n)).normalised()?)
        }
        _ if rest == "normal" => (first.direction?, normal?),
        _ => return None,
    };
    let signs = [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)];
    let all = signs.map(|(a, b)| (from * a, to * b));
    all.into_iter().find(|(a, b)| (a.angle_to(*b).to_degrees() - value_deg).abs() < MISS)
}

/// The branch that a name begins with, and the rest of the name.
fn leading<'a, 'n>(name: &'n str, branches: &[&'a Branch]) -> Option<(&'a Branch, &'n str)> {
    branches.iter().find_map(|&b| {
        let numbered = format!("branch_{}", b.id);
        let rest = name.strip_prefix(b.role.name()).or_else(|| name.strip_prefix(&numbered))?;
        (rest.is_empty() || rest.starts_with('_')).then(|| (b, rest.trim_start_matches('_')))
    })
}

impl Arc {
    /// How much of the angle's plane a camera sees, 0 to 1.
    fn seen(&self, camera: &Camera) -> f64 {
        self.from.cross(self.to).normalised().map_or(0.0, |n| n.dot(camera.back()).abs())
    }

    /// Whether this camera of several sees the angle best.
    pub(super) fn is_for(&self, camera: &Camera, all: &[Camera]) -> bool {
        let seen = self.seen(camera);
        all.iter().all(|other| other == camera || self.seen(other) <= seen)
    }

    /// The point at an angle from the first direction, radians.
    fn at(&self, radius: f64, angle: f64) -> P3 {
        let side = (self.to - self.from * self.to.dot(self.from)).normalised().unwrap_or(self.from);
        self.vertex + (self.from * angle.cos() + side * angle.sin()) * radius
    }

    /// Both legs, the arc between them and the value outside it.
    pub(super) fn draw(&self, svg: &mut String, camera: &Camera) {
        let angle = self.from.angle_to(self.to);
        let pixel = |p: P3| camera.project(p);
        let colour = hex(ANGLE_RGB[self.index % ANGLE_RGB.len()]);
        let legs = [0.0, angle].map(|a| pixel(self.at(self.radius_mm * 1.15, a)));
        let [x, y, _] = pixel(self.vertex);
        let mut path =
            format!("M{:.1} {:.1}L{x:.1} {y:.1}L{:.1} {:.1}", legs[0][0], legs[0][1], legs[1][0], legs[1][1]);
        for i in 0..=PIECES {
            let [x, y, _] = pixel(self.at(self.radius_mm, angle * i as f64 / PIECES as f64));
            // Writing into a String cannot fail.
            let _ = write!(path, "{}{x:.1} {y:.1}", if i == 0 { "M" } else { "L" });
        }
        let _ = write!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"#fff\" stroke-width=\"7\" stroke-linejoin=\"round\"/><path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"3.5\" stroke-linejoin=\"round\"/>"
        );
        let [x, y, _] = pixel(self.at(self.radius_mm, 0.5 * angle));
        let [x0, y0, _] = pixel(self.vertex);
        let length = (x - x0).hypot(y - y0).max(1e-9);
        let (dx, dy) = ((x - x0) / length, (y - y0) / length);
        let anchor = if dx > 0.35 {
            "start"
        } else if dx < -0.35 {
            "end"
        } else {
            "middle"
        };
        let at = [x + 12.0 * dx, y + 26.0 * dy + 9.0];
        super::html::label(svg, at, anchor, &colour, &format!("{:.1}\u{b0}", self.value_deg));
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::fixture::Fixture;
    use super::super::render::cameras;
    use super::*;

    #[test]
    fn names_lead_to_the_branches_that_they_speak_of() {
        let f = Fixture::new();
        let r = f.reconstruction();
        let all: Vec<&Branch> = r.morphometry.branches.iter().collect();
        let (b, rest) = leading("graft_distal_planar", &all).unwrap();
        assert_eq!((b.role.name(), rest), ("graft", "distal_planar"));
        assert_eq!(leading("distal_normal", &all).unwrap().1, "normal");
        assert!(leading("grafting", &all).is_none() && leading("branch_77_x", &all).is_none());
    }

    #[test]
    fn an_arc_encloses_the_reported_value_or_is_not_drawn() {
        let f = Fixture::new();
        let r = f.reconstruction();
        let j = r.main_junction().unwrap();
        let drawn = arcs(&r, j);
        assert!(!drawn.is_empty());
        for arc in &drawn {
            assert!((arc.from.angle_to(arc.to).to_degrees() - arc.value_deg).abs() < MISS);
            let views = cameras(&r, [824, 470]);
            assert!(views.iter().any(|c| arc.is_for(c, &views)));
        }
        let wrong = directions("graft_proximal", &r.morphometry.branches.iter().collect::<Vec<_>>(), None, 10.0);
        assert!(wrong.is_none());
    }
}
