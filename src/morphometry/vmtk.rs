//! A junction's angles as VMTK defines them (Antiga and Steinman, IEEE Trans Med Imaging 2004), for comparison with its
//! tables: bifurcation vectors of one inscribed sphere's length next to the bifurcation, in its reference system.
//!
//! They depend on which branch is called the inlet, and a vector of one sphere's length sees the first bend only: a straight
//! graft at 45 degrees is given as 45, 82 or 111 by inlet. So they are reported under their own name with their inlet, and
//! nothing else in the result leans on them. The steps are those of VMTK's vtkvmtkCenterlineBranchExtractor,
//! -BifurcationReferenceSystems and -BifurcationVectors, read in its source and written anew: on the same lines VMTK 1.5.2
//! has the same angles (tests below). Its normal of four points out of a plane weights their corners; the area's normal
//! (Newell) was up to .7 degrees from it on a scan. The lines are led through the junction as VMTK leads its own (path.rs);
//! what is left of a difference is where they part, to which the vectors are sensitive (docs/accuracy.md).

use crate::line::nearest;
use crate::types::VmtkAngles;
use space::DVec3;

/// VMTK seeks the border in steps of a hundredth of the radius and takes the far end of the last. On the border itself a
/// sphere of the inlet, which both lines share, touches the place, and by rounding counts as the one a sphere upstream: the
/// graft at 45 degrees to the inlet, where the vectors then turned by up to 21 degrees.
const OUTSIDE_RADII: f64 = 0.01;

/// Square of the distance below which VMTK calls two points one, mm2.
const SAME_POINT_MM2: f64 = 1e-12;

/// A centre of the medial line and the radius of its inscribed sphere, mm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ball {
    pub(crate) centre: DVec3,
    pub(crate) radius: f64,
}

impl Ball {
    fn between(self, other: Self, t: f64) -> Self {
        Self { centre: self.centre.lerp(other.centre, t), radius: self.radius + (other.radius - self.radius) * t }
    }

    /// Below zero inside the sphere.
    fn value(self, x: DVec3) -> f64 {
        x.distance_squared(self.centre) - self.radius * self.radius
    }
}

/// A place on a line: segment and share of it.
type At = (usize, f64);

/// A line from the inlet through the junction to an outlet.
struct Centreline(Vec<Ball>);

impl Centreline {
    fn ball(&self, (k, t): At) -> Ball {
        self.0[k].between(self.0[k + 1], t)
    }

    /// Value of the canal surface about the line, below zero inside.
    fn tube(&self, x: DVec3) -> f64 {
        let of = |pair: &[Ball]| {
            let (_, _, t) = nearest(&[pair[0].centre, pair[1].centre], x);
            pair[0].between(pair[1], t).value(x)
        };
        self.0.windows(2).map(of).fold(f64::INFINITY, f64::min)
    }

    /// Where a value along the line changes sign within a segment.
    fn root(&self, k: usize, value: impl Fn(Ball) -> f64) -> At {
        let sign = value(self.0[k]) > 0.0;
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if (value(self.ball((k, middle))) > 0.0) == sign { low = middle } else { high = middle }
        }
        (k, 0.5 * (low + high))
    }

    /// The place a length further on; the line's end at most.
    fn beyond(&self, (mut k, mut t): At, mut length: f64) -> At {
        loop {
            let segment = self.0[k].centre.distance(self.0[k + 1].centre);
            let rest = (1.0 - t) * segment;
            if length < rest || k + 2 == self.0.len() {
                return (k, (t + length / segment).min(1.0));
            }
            (k, t, length) = (k + 1, 0.0, length - rest);
        }
    }

    /// Just outside of where the line leaves another's canal surface.
    fn leaves(&self, other: &Self) -> Option<At> {
        let value = |ball: Ball| other.tube(ball.centre);
        let k = (0..self.0.len() - 1).find(|&k| value(self.0[k]) <= 0.0 && value(self.0[k + 1]) > 0.0)?;
        let border = self.root(k, value);
        Some(self.beyond(border, OUTSIDE_RADII * self.ball(border).radius))
    }

    /// The place whose sphere touches the centre of `at`, upstream or downstream.
    fn touching(&self, at: At, upstream: bool) -> Option<At> {
        let centre = self.ball(at).centre;
        let value = |ball: Ball| ball.value(centre);
        let crosses = |k: &usize| (value(self.0[*k]) > 0.0) != (value(self.0[*k + 1]) > 0.0);
        let k = if upstream { (0..=at.0).find(crosses)? } else { (at.0..self.0.len() - 1).rev().find(crosses)? };
        Some(self.root(k, value))
    }
}

/// In-plane and out-of-plane angles of each leg's bifurcation vector, degrees, in the legs' order. `lines` run from the
/// junction outward and share their first ball; `inlet` is a leg; `led` leads a line from the inlet to an outlet as VMTK would.
/// `None` where a leg is shorter than a sphere.
pub(crate) fn vmtk_angles(
    lines: &[Vec<Ball>],
    inlet: usize,
    inlet_branch: usize,
    led: impl Fn(Vec<Ball>) -> Vec<Ball>,
) -> Option<VmtkAngles> {
    if lines.iter().any(|l| l.len() < 2) {
        return None;
    }
    let outlets: Vec<usize> = (0..lines.len()).filter(|&l| l != inlet).collect();
    let upstream = || lines[inlet].iter().rev().copied();
    let centrelines: Vec<Centreline> = outlets
        .iter()
        .map(|&o| Centreline(led(upstream().chain(lines[o].iter().skip(1).copied()).collect())))
        .collect();
    let mut tracts = Vec::new();
    for (i, line) in centrelines.iter().enumerate() {
        let others = centrelines.iter().enumerate().filter(|&(j, _)| j != i);
        let exits: Vec<At> = others.map(|(_, other)| line.leaves(other)).collect::<Option<_>>()?;
        let exit = exits.into_iter().max_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)))?;
        tracts.push((line.touching(exit, true)?, exit));
    }
    let normal = normal(&centrelines, &tracts)?;
    let up = up_normal(&centrelines, &tracts, normal)?;

    let mut vectors = vec![DVec3::ZERO; lines.len()];
    vectors[inlet] = inlet_vector(&centrelines, &tracts)?;
    for ((&outlet, line), &(_, exit)) in outlets.iter().zip(&centrelines).zip(&tracts) {
        vectors[outlet] = line.ball(line.touching(exit, false)?).centre - line.ball(exit).centre;
    }
    let mut angles = VmtkAngles { inlet: inlet_branch, in_plane_deg: Vec::new(), out_of_plane_deg: Vec::new() };
    for vector in vectors {
        let unit = vector.try_normalize()?;
        let in_plane = unit.reject_from_normalized(normal).try_normalize()?;
        let sign = if in_plane.cross(up).dot(normal) < 0.0 { -1.0 } else { 1.0 };
        angles.in_plane_deg.push(sign * in_plane.angle_between(up).to_degrees());
        angles.out_of_plane_deg.push(90.0 - unit.angle_between(normal).to_degrees());
    }
    Some(angles)
}

/// Mean over the pairs of outlets of the normals of (touching, exit, exit, touching), made to agree.
fn normal(lines: &[Centreline], tracts: &[(At, At)]) -> Option<DVec3> {
    let balls: Vec<(Ball, Ball)> = lines.iter().zip(tracts).map(|(l, &(t, e))| (l.ball(t), l.ball(e))).collect();
    let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
    for ball in balls.iter().flat_map(|&(touching, exit)| [touching, exit]) {
        sum += ball.centre * ball.radius.powi(2);
        weights += ball.radius.powi(2);
    }
    let origin = sum / weights;
    let mut normals: Vec<DVec3> = Vec::new();
    for (i, (touching, exit)) in balls.iter().enumerate() {
        for (other_touching, other_exit) in &balls[i + 1..] {
            let corners = [touching.centre, exit.centre, other_exit.centre, other_touching.centre];
            normals.push(polygon_normal(&corners, origin)?);
        }
    }
    let first = *normals.first()?;
    normals.iter().fold(DVec3::ZERO, |sum, &n| sum + n * n.dot(first).signum()).try_normalize()
}

/// Normals of the corners, each weighted by the cotangents beside its edge to the origin over that edge's square.
fn polygon_normal(corners: &[DVec3; 4], origin: DVec3) -> Option<DVec3> {
    // Where both lines split at one point three corners are left.
    let count = if corners[0].distance_squared(corners[3]) < SAME_POINT_MM2 { 3 } else { 4 };
    let corner = |n: usize| corners[n % count];
    let weighted = |n: usize| {
        let (before, at, after) = (corner(n + count - 1), corner(n), corner(n + 1));
        let normal = (at - before).cross(after - at).try_normalize()?;
        let weight = cotangent(before, at, origin) + cotangent(origin, at, after);
        Some(normal * (weight / origin.distance_squared(at)))
    };
    (0..count).filter_map(weighted).sum::<DVec3>().try_normalize()
}

/// Cotangent of the angle at the second point; 0 where there is none.
fn cotangent(a: DVec3, at: DVec3, b: DVec3) -> f64 {
    let (u, v) = (a - at, b - at);
    let sine = u.cross(v).length();
    if sine > 0.0 { u.dot(v) / sine } else { 0.0 }
}

/// Mean of the tracts' directions in the plane, by the squared radius where they leave.
fn up_normal(lines: &[Centreline], tracts: &[(At, At)], normal: DVec3) -> Option<DVec3> {
    let mut sum = DVec3::ZERO;
    for (line, &(touching, exit)) in lines.iter().zip(tracts) {
        let (first, last) = (line.ball(touching), line.ball(exit));
        let in_plane = (last.centre - first.centre).reject_from_normalized(normal);
        sum += in_plane.try_normalize()? * last.radius.powi(2);
    }
    sum.try_normalize()
}

/// From one sphere upstream of the bifurcation to its border, averaged over the lines by squared radius.
fn inlet_vector(lines: &[Centreline], tracts: &[(At, At)]) -> Option<DVec3> {
    let mut sums = [(DVec3::ZERO, 0.0); 2];
    for (line, &(touching, _)) in lines.iter().zip(tracts) {
        let balls = [line.ball(touching), line.ball(line.touching(touching, true)?)];
        for (sum, ball) in sums.iter_mut().zip(balls) {
            let weight = ball.radius.powi(2);
            *sum = (sum.0 + ball.centre * weight, sum.1 + weight);
        }
    }
    Some(sums[0].0 / sums[0].1 - sums[1].0 / sums[1].1)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn straight(direction: DVec3, radius: f64) -> Vec<Ball> {
        (0..=200).map(|k| Ball { centre: direction.normalize() * (0.2 * f64::from(k)), radius }).collect()
    }

    #[test]
    fn a_symmetric_fork_of_equal_tubes_has_its_own_angles() {
        let (s, c) = 30.0f64.to_radians().sin_cos();
        let lines =
            [straight(-DVec3::Z, 3.0), straight(DVec3::new(s, 0.0, c), 3.0), straight(DVec3::new(-s, 0.0, c), 3.0)];
        let angles = vmtk_angles(&lines, 0, 7, |l| l).unwrap();
        assert_eq!(angles.inlet, 7);
        assert!(angles.in_plane_deg[0].abs() < 1e-9, "{angles:?}");
        assert!((angles.in_plane_deg[1] + angles.in_plane_deg[2]).abs() < 1e-9, "{angles:?}");
        assert!((angles.in_plane_deg[1].abs() - 30.0).abs() < 1e-9, "{angles:?}");
        assert!(angles.out_of_plane_deg.iter().all(|a| a.abs() < 1e-9), "{angles:?}");
    }

    /// A leg along a parabola, with a radius that changes evenly.
    fn bent(direction: [f64; 3], bend: [f64; 3], radii: [f64; 2]) -> Vec<Ball> {
        let (direction, bend) = (DVec3::from_array(direction).normalize(), DVec3::from_array(bend));
        let ball = |t: f64| Ball {
            centre: direction * t + bend * (t * t),
            radius: radii[0] + (radii[1] - radii[0]) * t / 40.0,
        };
        (0..=8000).map(|k| ball(0.005 * f64::from(k))).collect()
    }

    #[test]
    fn bent_legs_out_of_one_plane_have_the_angles_that_vmtk_1_5_2_gives_the_same_lines() {
        let legs = [
            bent([0.0, 0.0, -1.0], [0.0, 0.01, 0.0], [3.0, 3.0]),
            bent([1.0, 0.0, 1.0], [0.0, 0.03, 0.0], [2.5, 2.0]),
            bent([-0.6, 0.5, 0.9], [0.01, -0.04, 0.0], [3.0, 3.5]),
        ];
        // The inlet first, then the outlets in the legs' order; VMTK's last step ends .02 mm before ours here.
        let in_plane = [[8.67, 44.38, -24.33], [37.10, 71.72, -80.83], [7.49, 41.85, -91.14]];
        let out_of_plane = [[16.30, -10.17, 17.66], [-26.99, 4.47, -14.42], [24.26, -2.78, -10.70]];
        for (inlet, (in_plane, out_of_plane)) in in_plane.iter().zip(&out_of_plane).enumerate() {
            let angles = vmtk_angles(&legs, inlet, inlet, |l| l).unwrap();
            let order: Vec<usize> = std::iter::once(inlet).chain((0..3).filter(|&l| l != inlet)).collect();
            for (k, &leg) in order.iter().enumerate() {
                let off = [angles.in_plane_deg[leg] - in_plane[k], angles.out_of_plane_deg[leg] - out_of_plane[k]];
                assert!(off.iter().all(|o| o.abs() < 1.0), "inlet {inlet} leg {leg}: {off:?}");
            }
        }
    }

    #[test]
    fn a_leg_shorter_than_a_sphere_has_no_angles() {
        let mut lines = [straight(-DVec3::Z, 3.0), straight(DVec3::X, 3.0), straight(DVec3::Z, 3.0)];
        lines[1].truncate(8);
        assert!(vmtk_angles(&lines, 0, 0, |l| l).is_none());
    }

    #[test]
    fn an_outlet_out_of_the_plane_of_the_others_is_told() {
        let tilt = 20.0f64.to_radians();
        let lines = [
            straight(-DVec3::Z, 3.0),
            straight(DVec3::new(1.0, 0.0, 1.0), 3.0),
            straight(DVec3::new(-tilt.cos(), tilt.sin(), 1.0), 3.0),
        ];
        let angles = vmtk_angles(&lines, 0, 0, |l| l).unwrap();
        let [a, b] = [angles.out_of_plane_deg[1], angles.out_of_plane_deg[2]];
        assert!(a.abs() < 12.0 && b.abs() < 12.0, "the plane is that of both outlets: {angles:?}");
        assert!(angles.out_of_plane_deg[0].abs() > 1.0, "{angles:?}");
    }
}
