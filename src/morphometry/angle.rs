//! The angles of a junction, from the fitted directions of its branches (all away from the junction).
//!
//! Definitions as in contract.md. g, p, d are the unit directions of graft, proximal and distal vessel, n the plane's
//! normal, p x g made unit:
//! graft_proximal = angle(g, p); graft_distal_planar = angle(g, d - (d.n) n), 0 to 180 degrees; distal_normal =
//! angle(d, n); proximal_distal = angle(p, d); graft_distal = angle(g, d).
//! None of them depends on which end is called the inlet.

use crate::types::Role;
use space::V3;

/// Graft and proximal vessel closer than this to one line, degrees, span no plane: an error of .3 degree in a direction
/// would turn the normal by 3.4 degrees.
const COLLINEAR_DEG: f64 = 5.0;

/// Unit normal of the plane of graft and proximal vessel, proximal x graft; `None` within 5 degrees of collinear.
pub fn plane_normal(graft: V3, proximal: V3) -> Option<V3> {
    let angle = graft.angle_to(proximal).to_degrees();
    if !(COLLINEAR_DEG..=180.0 - COLLINEAR_DEG).contains(&angle) {
        return None;
    }
    proximal.cross(graft).normalised()
}

/// Why an angle has no value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Undefined {
    /// A branch has no fitted line.
    NoLine,
    /// Graft and proximal vessel span no plane.
    NoPlane,
    /// The distal vessel stands upright on the plane: its projection has no direction.
    NoProjection,
}

/// What an angle is between; numbers are legs of the junction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Between {
    Pair(usize, usize),
    /// Graft, proximal, distal.
    Planar(usize, usize, usize),
    /// Graft, proximal, distal.
    Normal(usize, usize, usize),
}

impl Between {
    pub(crate) fn legs(self) -> Vec<usize> {
        match self {
            Self::Pair(a, b) => vec![a, b],
            Self::Planar(g, p, d) | Self::Normal(g, p, d) => vec![g, p, d],
        }
    }

    /// Degrees.
    pub(crate) fn value(self, directions: &[Option<V3>]) -> Result<f64, Undefined> {
        let of = |leg: usize| directions[leg].ok_or(Undefined::NoLine);
        let radians = match self {
            Self::Pair(a, b) => of(a)?.angle_to(of(b)?),
            Self::Planar(g, p, d) => planar(of(g)?, of(p)?, of(d)?)?,
            Self::Normal(g, p, d) => {
                let (g, p, d) = (of(g)?, of(p)?, of(d)?);
                d.angle_to(plane_normal(g, p).ok_or(Undefined::NoPlane)?)
            }
        };
        Ok(radians.to_degrees())
    }
}

fn planar(graft: V3, proximal: V3, distal: V3) -> Result<f64, Undefined> {
    let n = plane_normal(graft, proximal).ok_or(Undefined::NoPlane)?;
    let projection = distal - n * distal.dot(n);
    if projection.length() < COLLINEAR_DEG.to_radians().sin() {
        return Err(Undefined::NoProjection);
    }
    Ok(graft.angle_to(projection))
}

/// The legs with the roles of graft, proximal (or host_a) and distal (or host_b).
pub(crate) fn triple(roles: &[Role]) -> Option<[usize; 3]> {
    let find = |a: Role, b: Role| roles.iter().position(|&r| r == a || r == b);
    Some([find(Role::Graft, Role::Graft)?, find(Role::Proximal, Role::HostA)?, find(Role::Distal, Role::HostB)?])
}

/// The angles of a junction by name: the five of contract.md where the three roles are known, and every pair as
/// `branch_I_branch_J` where there are more than three legs.
pub(crate) fn named(roles: &[Role], branches: &[usize]) -> Vec<(String, Between)> {
    let mut angles = Vec::new();
    if let Some([g, p, d]) = triple(roles) {
        let (proximal, distal) = (roles[p].name(), roles[d].name());
        angles.push((format!("graft_{proximal}"), Between::Pair(g, p)));
        angles.push((format!("graft_{distal}_planar"), Between::Planar(g, p, d)));
        angles.push((format!("{distal}_normal"), Between::Normal(g, p, d)));
        angles.push((format!("{proximal}_{distal}"), Between::Pair(p, d)));
        angles.push((format!("graft_{distal}"), Between::Pair(g, d)));
    }
    if roles.len() > 3 || angles.is_empty() {
        for i in 0..roles.len() {
            for j in i + 1..roles.len() {
                angles.push((format!("branch_{}_branch_{}", branches[i], branches[j]), Between::Pair(i, j)));
            }
        }
    }
    angles
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn deg(x: f64) -> (f64, f64) {
        x.to_radians().sin_cos()
    }

    #[test]
    fn the_five_angles_of_a_known_anastomosis() {
        let (s, c) = deg(45.0);
        let (ts, tc) = deg(15.0);
        // proximal up, graft 45 degrees to it in the x-z plane, distal down and 15 degrees out of the plane
        let directions = [Some(V3::new(s, 0.0, c)), Some(V3::Z), Some(V3::new(0.0, ts, -tc))];
        let normal = plane_normal(directions[0].unwrap(), directions[1].unwrap()).unwrap();
        assert!((normal - V3::Y).length() < 1e-15);
        let roles = [Role::Graft, Role::Proximal, Role::Distal];
        let expected = [45.0, 135.0, 75.0, 165.0, (-c * tc).acos().to_degrees()];
        for ((name, between), truth) in named(&roles, &[0, 1, 2]).iter().zip(expected) {
            let value = between.value(&directions).unwrap();
            assert!((value - truth).abs() < 1e-12, "{name} {value} {truth}");
        }
    }

    #[test]
    fn a_collinear_graft_has_no_plane() {
        let directions = [Some(V3::new(0.05, 0.0, 1.0)), Some(V3::Z), Some(-V3::Z)];
        assert_eq!(Between::Normal(0, 1, 2).value(&directions), Err(Undefined::NoPlane));
        assert!(Between::Pair(0, 1).value(&directions).is_ok());
    }

    #[test]
    fn a_distal_vessel_upright_on_the_plane_has_no_planar_angle() {
        let directions = [Some(V3::X), Some(V3::Z), Some(V3::new(0.01, 1.0, 0.0))];
        assert_eq!(Between::Planar(0, 1, 2).value(&directions), Err(Undefined::NoProjection));
    }
}
