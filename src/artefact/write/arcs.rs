//! A junction's angles as arcs in the report's pictures: between which directions each stands, drawn where it is least
//! foreshortened.

use super::html::LETTER;
use super::render::Camera;
use super::style::{ANGLE_RGB, hex};
use crate::Reconstruction;
use morphometry::{Angle, Junction};
use space::{P3, V3};
use std::fmt::Write as _;

/// Names of the roles that angles speak of.
const ROLES: [&str; 5] = ["graft", "proximal", "distal", "host_a", "host_b"];
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

/// The first measured angles of a junction that can be drawn.
pub(super) fn arcs(r: &Reconstruction<'_>, j: &Junction) -> Vec<Arc> {
    let legs = legs(r, j);
    let known = parties_of(j, &legs);
    let graft = r.morphometry.branches.iter().find(|b| j.branches.contains(&b.id) && b.diameter_mm.is_some());
    let diameter = graft.and_then(|b| b.diameter_mm).unwrap_or(5.0);
    let measured = j.angles.iter().enumerate().filter_map(|(i, a)| Some((i, a, a.value_deg?)));
    let arc = |(index, a, value_deg): (usize, &Angle, f64)| {
        let (from, to) = between(&a.name, &known, j.plane_normal)?;
        let fits = (from.angle_to(to).to_degrees() - value_deg).abs() < MISS;
        let radius_mm = diameter * (RADIUS[0] + RADIUS[1] * index as f64);
        let vertex = j.axes_point.unwrap_or(j.medial_point);
        fits.then_some(Arc { index, value_deg, vertex, from, to, radius_mm })
    };
    measured.take(DRAWN).filter_map(arc).collect()
}

/// A branch that meets the junction: the names it may go by, and its unit direction away from the junction.
struct Leg {
    names: [String; 2],
    direction: V3,
}

fn legs(r: &Reconstruction<'_>, j: &Junction) -> Vec<Leg> {
    let meeting = r.morphometry.branches.iter().filter(|b| j.branches.contains(&b.id));
    meeting
        .filter_map(|b| {
            // a branch has the direction of its first junction
            let sign = if b.from_node == j.node { 1.0 } else { -1.0 };
            let names = [b.role.name().to_owned(), format!("branch_{}", b.id)];
            Some(Leg { names, direction: b.direction? * sign })
        })
        .collect()
}

/// The direction of each party that the angles speak of. A branch carries the role of its first junction: where that is
/// another one, the three legs are told apart by the angles between them.
fn parties_of<'n>(j: &'n Junction, legs: &[Leg]) -> Vec<(&'n str, V3)> {
    let mut names: Vec<&str> = j.angles.iter().flat_map(|a| split(&a.name).0).collect();
    names.sort_unstable();
    names.dedup();
    let named = |name: &&'n str| {
        let leg = legs.iter().find(|l| l.names.iter().any(|n| n == name))?;
        Some((*name, leg.direction))
    };
    let direct: Vec<_> = names.iter().filter_map(named).collect();
    let ([a, b, c], [x, y, z], true) = (&names[..], legs, direct.len() < names.len()) else { return direct };
    let orders = [[x, y, z], [x, z, y], [y, x, z], [y, z, x], [z, x, y], [z, y, x]];
    let assigned = orders.map(|o| vec![(*a, o[0].direction), (*b, o[1].direction), (*c, o[2].direction)]);
    let miss = |known: &Vec<(&str, V3)>| -> f64 {
        let plain = j.angles.iter().filter(|a| split(&a.name).1.is_empty());
        let apart = |a: &Angle| {
            let (from, to) = between(&a.name, known, None)?;
            Some((from.angle_to(to).to_degrees() - a.value_deg?).abs())
        };
        plain.filter_map(apart).sum()
    };
    assigned.into_iter().min_by(|a, b| miss(a).total_cmp(&miss(b))).unwrap_or(direct)
}

/// The parties that an angle's name speaks of, and what stands behind them: `planar`, `normal` or nothing.
fn split(name: &str) -> (Vec<&str>, &str) {
    let (mut parties, mut rest) = (Vec::new(), name);
    while let Some(length) = leading(rest) {
        parties.push(&rest[..length]);
        rest = rest[length..].trim_start_matches('_');
    }
    (parties, rest)
}

/// Length of the role or `branch_N` that a name begins with.
fn leading(name: &str) -> Option<usize> {
    let numbered = name.strip_prefix("branch_").map(|rest| {
        let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
        "branch_".len() + digits
    });
    let role = ROLES.iter().find(|r| name.starts_with(**r)).map(|r| r.len());
    let length = role.or(numbered)?;
    matches!(name.as_bytes().get(length), None | Some(b'_')).then_some(length)
}

/// The two directions of an angle.
fn between(name: &str, known: &[(&str, V3)], normal: Option<V3>) -> Option<(V3, V3)> {
    let (parties, rest) = split(name);
    let direction = |i: usize| known.iter().find(|(n, _)| Some(n) == parties.get(i)).map(|(_, d)| *d);
    let from = direction(0)?;
    let to = match rest {
        "normal" => normal?,
        "planar" => {
            let (d, n) = (direction(1)?, normal?);
            (d - n * d.dot(n)).normalised()?
        }
        "" => direction(1)?,
        _ => return None,
    };
    Some((from, to))
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
        let (at, anchor) = self.value_at(camera);
        super::html::label(svg, at, anchor, &colour, &self.words());
    }

    fn words(&self) -> String {
        format!("{:.1}\u{b0}", self.value_deg)
    }

    /// Where the value stands: outside the middle of the arc.
    fn value_at(&self, camera: &Camera) -> ([f64; 2], &'static str) {
        let [x, y, _] = camera.project(self.at(self.radius_mm, 0.5 * self.from.angle_to(self.to)));
        let [x0, y0, _] = camera.project(self.vertex);
        let length = (x - x0).hypot(y - y0).max(1e-9);
        let (dx, dy) = ((x - x0) / length, (y - y0) / length);
        let anchor = if dx > 0.35 {
            "start"
        } else if dx < -0.35 {
            "end"
        } else {
            "middle"
        };
        ([x + 12.0 * dx, y + 26.0 * dy + 9.0], anchor)
    }

    /// What the value and the arc take of the picture: left, right and base line of a text, and of each piece of the arc as
    /// if it were one.
    pub(super) fn room(&self, camera: &Camera) -> Vec<[f64; 3]> {
        let ([x, y], anchor) = self.value_at(camera);
        let wide = LETTER[0] * self.words().chars().count() as f64;
        let left = x - match anchor {
            "start" => 0.0,
            "end" => wide,
            _ => 0.5 * wide,
        };
        let angle = self.from.angle_to(self.to);
        let piece = |i: usize| {
            let [x, y, _] = camera.project(self.at(self.radius_mm, angle * i as f64 / PIECES as f64));
            // The middle of a letter is a third of its line above the base line.
            [x - 4.0, x + 4.0, y + LETTER[1] / 3.0]
        };
        (0..=PIECES).map(piece).chain([[left, left + wide, y]]).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::fixture::Fixture;
    use super::super::render::cameras;
    use super::*;

    #[test]
    fn names_are_split_into_the_parties_that_they_speak_of() {
        assert_eq!(split("graft_distal_planar"), (vec!["graft", "distal"], "planar"));
        assert_eq!(split("host_b_normal"), (vec!["host_b"], "normal"));
        assert_eq!(split("branch_3_branch_12"), (vec!["branch_3", "branch_12"], ""));
        assert_eq!(split("grafting"), (vec![], "grafting"));
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
        let mut wrong = j.clone();
        wrong.angles.iter_mut().for_each(|a| a.value_deg = a.value_deg.map(|v| v + 20.0));
        assert!(arcs(&r, &wrong).is_empty());
    }

    #[test]
    fn legs_without_the_roles_of_this_junction_are_told_apart_by_their_angles() {
        let f = Fixture::new();
        let r = f.reconstruction();
        let j = r.main_junction().unwrap();
        let mut nameless = legs(&r, j);
        let wanted = parties_of(j, &nameless);
        nameless.iter_mut().for_each(|l| l.names = ["other".to_owned(), "other".to_owned()]);
        nameless.reverse();
        assert_eq!(parties_of(j, &nameless), wanted);
    }
}
