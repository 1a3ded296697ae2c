//! What is exactly true of a phantom, in the stack's own frame (LPS, mm) and in the definitions of result.json.

use crate::{Axis, Tube};
use space::{P3, V3};

/// A branch's role.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The graft.
    Graft,
    /// The host upstream of the junction.
    Proximal,
    /// The host downstream of the junction.
    Distal,
    /// A further branch, or a vessel without a junction.
    Other,
}

impl Role {
    /// The name in result.json.
    pub fn name(self) -> &'static str {
        match self {
            Self::Graft => "graft",
            Self::Proximal => "proximal",
            Self::Distal => "distal",
            Self::Other => "other",
        }
    }
}

/// One branch.
#[derive(Clone, Debug, PartialEq)]
pub struct BranchTruth {
    /// Role.
    pub role: Role,
    /// Where it starts: the junction, or where a vessel without a junction enters the stack.
    pub from: P3,
    /// Where its axis leaves the stack (the box of its outer pixel centres).
    pub to: P3,
    /// Unit direction at `from`, away from the junction.
    pub direction: V3,
    /// Arc length from `from` to `to`, mm.
    pub length_mm: f64,
    /// Radius outside the blend, mm.
    pub radius_mm: f64,
    /// Area pi r^2 of the sections normal to the axis from `circular_from_mm` on, mm2.
    pub area_mm2: f64,
    /// Arc length from `from` beyond which every section is an exact circle; `None` when the stack ends before.
    pub circular_from_mm: Option<f64>,
    /// The centre line.
    pub axis: Axis,
}

impl BranchTruth {
    /// The section's exact area at an arc length from `from`; `None` within the junction's blend or past the stack.
    pub fn area_at(&self, abscissa_mm: f64) -> Option<f64> {
        let from = self.circular_from_mm?;
        (abscissa_mm >= from && abscissa_mm <= self.length_mm).then_some(self.area_mm2)
    }
}

/// The angles of contract.md, degrees, 0 to 180.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Angles {
    /// Between graft and proximal host.
    pub graft_proximal: f64,
    /// Within the plane of graft and proximal host: from the graft to the distal host's projection.
    pub graft_distal_planar: f64,
    /// Between the distal host and the plane's normal (proximal x graft).
    pub distal_normal: f64,
    /// Between proximal and distal host.
    pub proximal_distal: f64,
    /// Between graft and distal host.
    pub graft_distal: f64,
}

impl Angles {
    /// From directions that point away from the junction. `None` where graft and proximal host are parallel, or the
    /// distal host is normal to their plane.
    pub fn of(graft: V3, proximal: V3, distal: V3) -> Option<Self> {
        let normal = plane_normal(graft, proximal)?;
        let planar = (distal - normal * distal.dot(normal)).normalised()?;
        let deg = |a: V3, b: V3| a.angle_to(b).to_degrees();
        Some(Self {
            graft_proximal: deg(graft, proximal),
            graft_distal_planar: deg(graft, planar),
            distal_normal: deg(distal, normal),
            proximal_distal: deg(proximal, distal),
            graft_distal: deg(graft, distal),
        })
    }

    /// Name (as in result.json) and value, in the contract's order.
    pub fn named(&self) -> [(&'static str, f64); 5] {
        [
            ("graft_proximal", self.graft_proximal),
            ("graft_distal_planar", self.graft_distal_planar),
            ("distal_normal", self.distal_normal),
            ("proximal_distal", self.proximal_distal),
            ("graft_distal", self.graft_distal),
        ]
    }
}

/// proximal x graft, normalised; `None` when they are parallel to 1e-9.
pub(crate) fn plane_normal(graft: V3, proximal: V3) -> Option<V3> {
    let n = proximal.cross(graft);
    if n.length() > 1e-9 { n.normalised() } else { None }
}

/// The junction of an anastomosis.
#[derive(Clone, Debug, PartialEq)]
pub struct JunctionTruth {
    /// The point that all axes share.
    pub axes_point: P3,
    /// Unit normal of the plane of proximal host and graft: proximal x graft.
    pub plane_normal: V3,
    /// The angles.
    pub angles: Angles,
    /// The plan's `roles.graft_mm`: on the graft's axis, inside the volume.
    pub graft_point: P3,
    /// The plan's `roles.proximal_mm`.
    pub proximal_point: P3,
    /// The plan's `roles.distal_mm`.
    pub distal_point: P3,
}

/// The helix of a helix phantom, right-handed in the patient.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HelixTruth {
    /// Curvature, 1/mm.
    pub curvature_per_mm: f64,
    /// Torsion, 1/mm, positive right-handed.
    pub torsion_per_mm: f64,
    /// Radius of the helix, mm.
    pub radius_mm: f64,
    /// Advance per turn, mm.
    pub pitch_mm: f64,
}

/// An unrelated bright vessel.
#[derive(Clone, Debug, PartialEq)]
pub struct DistractorTruth {
    /// Its tube.
    pub tube: Tube,
    /// Where its axis enters and leaves the stack.
    pub ends: [P3; 2],
    /// Least distance, within the stack, of its wall from the walls of all other vessels, mm.
    pub clearance_mm: f64,
}

/// What is exactly true of a simulated scan.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// The phantom's name.
    pub kind: String,
    /// Branches of the vessel, each within the stack: proximal, distal, graft, further ones.
    pub branches: Vec<BranchTruth>,
    /// The junction, where there is one.
    pub junction: Option<JunctionTruth>,
    /// The helix, where it is one.
    pub helix: Option<HelixTruth>,
    /// Unrelated vessels.
    pub distractors: Vec<DistractorTruth>,
    /// Standard deviation of each noise channel, grey levels; 0 without noise.
    pub noise_sigma: f64,
    /// Half-way level of lumen and tissue before the bias field.
    pub half_level: f64,
    /// Slices left out, counted before leaving out.
    pub missing_slices: Vec<usize>,
}

impl Truth {
    /// The branch with a role.
    pub fn branch(&self, role: Role) -> Option<&BranchTruth> {
        self.branches.iter().find(|b| b.role == role)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_planar_straight_host_has_the_angles_written_in_the_contract() {
        let a = Angles::of(V3::new(1.0, 0.0, 1.0), V3::Z, -V3::Z).unwrap();
        let want = [45.0, 135.0, 90.0, 180.0, 135.0];
        for ((name, value), want) in a.named().into_iter().zip(want) {
            assert!((value - want).abs() < 1e-12, "{name} {value}");
        }
    }

    #[test]
    fn the_normal_is_proximal_cross_graft_so_its_side_shows_in_distal_normal() {
        let (graft, out) = (V3::new(1.0, 0.0, 1.0), 10.0_f64.to_radians());
        let y = V3::Y * out.sin() - V3::Z * out.cos();
        // z x (x + z) = y: a distal host leaning to +y is 80 degrees from the normal, one leaning to -y 100.
        assert!((Angles::of(graft, V3::Z, y).unwrap().distal_normal - 80.0).abs() < 1e-12);
        let y = -(V3::Y * out.sin()) - V3::Z * out.cos();
        assert!((Angles::of(graft, V3::Z, y).unwrap().distal_normal - 100.0).abs() < 1e-12);
        assert!(Angles::of(V3::Z, V3::Z, V3::X).is_none());
        assert!(Angles::of(V3::X, V3::Z, V3::Y).is_none());
    }
}
