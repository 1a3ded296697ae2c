//! Re-synthesis: a measured vessel tree with its medial lines changed and its cross-sections kept.
//!
//! The paper leaves it as further work: areas and shapes of the sections are carried along a changed medial line, so that
//! the flow in vessels which differ in one angle, one curvature or one torsion can be compared. Sections are carried in
//! rotation-minimising frames (no twist is added by the frame; Bishop 1975), which are injective while r kappa < 1. What
//! comes out are closed planar curves in space, as a scan gives them, and goes through the same stages from the implicit
//! fit on. Where the lumens of a junction overlap the tubes are carried on straight to it, and only what lies outside the
//! others is wall: the fit blends the crotch.
//!
//! Rejected: warping the fitted function itself. A warp that turns a branch by 15 degrees at a crotch of .3 mm radius of
//! curvature folds there, while nothing is known of the wall within the overlap of a vessel that does not exist.

mod change;
mod path;
mod rings;

use crate::types::{Role, Roles, SectionOutline};
use crate::{Error, Morphometry};
use imaging::{Contours, Tip};
use space::{P3, V3};

/// A measured vessel tree with the outlines of its sections.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Pixel size that displacements are quoted in, mm.
    pub pixel_mm: f64,
    /// The branches, each from its junction outward.
    pub branches: Vec<ModelBranch>,
    /// The junctions.
    pub junctions: Vec<ModelJunction>,
}

/// A branch of a [`Model`].
#[derive(Clone, Debug, PartialEq)]
pub struct ModelBranch {
    /// Its number.
    pub id: usize,
    /// Its role.
    pub role: Role,
    /// Graph nodes at its first and last section.
    pub nodes: [usize; 2],
    /// Ends that close inside the data without a cap, first and last.
    pub tip: [bool; 2],
    /// Unit direction of its fitted line away from its junction.
    pub direction: Option<V3>,
    /// Along the line, from the first node on; two or more.
    pub sections: Vec<ModelSection>,
}

/// A section of a [`ModelBranch`].
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSection {
    /// On the medial line.
    pub position: P3,
    /// Unit tangent.
    pub tangent: V3,
    /// The wall around it; `None` where it is open, leaks, or overlaps with another lumen.
    pub outline: Option<SectionOutline>,
}

/// A junction of a [`Model`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelJunction {
    /// Graph node.
    pub node: usize,
    /// Where the axes of its branches meet; the node where they do not.
    pub point: P3,
    /// Unit normal of the plane of proximal vessel and graft.
    pub plane_normal: Option<V3>,
}

/// A branch, by its role or by its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    /// The one branch with this role.
    Role(Role),
    /// By number.
    Id(usize),
}

/// What is changed of one branch. Everything beyond its far end goes with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// The branch.
    pub branch: Which,
    /// What is done to it.
    pub what: What,
}

/// A change of a medial line. The line is changed from its first clear section on; what lies before is its junction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum What {
    /// Turned about the junction, within the plane that it spans with branch `to`, until their fitted directions make
    /// this angle, degrees.
    Angle {
        /// Wanted angle, degrees, within 5 to 175.
        deg: f64,
        /// The other branch.
        to: Which,
    },
    /// Every bend times a factor, its plane kept; 0 is straight.
    Bend {
        /// 0 to 10.
        factor: f64,
    },
    /// Constant curvature and torsion, both 1/mm; the torsion is positive for a right-handed helix.
    Helix {
        /// 0 or more.
        curvature_per_mm: f64,
        /// Any sign.
        torsion_per_mm: f64,
    },
    /// Pressed into its junction's plane, its length kept.
    Planar,
}

/// A changed vessel tree.
#[derive(Clone, Debug)]
pub struct Resynthesis {
    /// Its wall as planar curves.
    pub contours: Contours,
    /// A point in each branch that has a role, so that it is found again.
    pub roles: Roles,
}

/// The tree with its lines changed, one change after the other, as curves for [`implicit::fit`].
///
/// No change gives curves on the measured wall: the areas of the fit differ from the measured ones by less than .5 %
/// outside junctions.
///
/// # Errors
/// [`Error::VariantBranch`] (no such branch, or several), [`Error::VariantLoop`], [`Error::VariantDirection`],
/// [`Error::VariantValue`], [`Error::VariantSections`] (a branch without clear sections), [`Error::VariantFolds`]
/// where r kappa >= 1, [`Error::VariantCollision`] where lumens meet that were apart, or an open end lies too
/// close to another vessel to be cut.
pub fn resynthesise(model: &Model, changes: &[Change]) -> Result<Resynthesis, Error> {
    let changed = change::applied(model, changes)?;
    let tubes = rings::tubes(model, &changed)?;
    let walls = rings::walls(model, &tubes)?;
    let contours = rings::contours(model, &tubes, &walls)?;
    Ok(Resynthesis { contours, roles: roles(model, &tubes) })
}

impl Model {
    /// The model of what was measured in memory; `tips` are graph nodes at which a vessel ends without a cap.
    pub fn of(morphometry: &Morphometry, tips: &[usize], pixel_mm: f64) -> Self {
        let section = |s: &crate::Section| ModelSection {
            position: s.position,
            tangent: s.tangent,
            outline: s.outline.clone().filter(|_| !s.in_junction && !s.open),
        };
        let branch = |b: &crate::Branch| ModelBranch {
            id: b.id,
            role: b.role,
            nodes: [b.from_node, b.to_node],
            tip: [b.from_node, b.to_node].map(|n| tips.contains(&n)),
            direction: b.direction,
            sections: b.sections.iter().map(section).collect(),
        };
        let junction = |j: &crate::Junction| ModelJunction {
            node: j.node,
            point: j.axes_point.unwrap_or(j.medial_point),
            plane_normal: j.plane_normal,
        };
        Self {
            pixel_mm,
            branches: morphometry.branches.iter().map(branch).collect(),
            junctions: morphometry.junctions.iter().map(junction).collect(),
        }
    }

    fn junction(&self, node: usize) -> Option<&ModelJunction> {
        self.junctions.iter().find(|j| j.node == node)
    }

    /// Index of a branch.
    fn find(&self, which: Which) -> Result<usize, Error> {
        let is = |b: &ModelBranch| match which {
            Which::Id(id) => b.id == id,
            Which::Role(role) => b.role == role,
        };
        let mut found = self.branches.iter().enumerate().filter(|(_, b)| is(b)).map(|(i, _)| i);
        match (found.next(), found.next()) {
            (Some(i), None) => Ok(i),
            (first, _) => Err(Error::VariantBranch { which, found: if first.is_some() { "several" } else { "none" } }),
        }
    }
}

impl std::fmt::Display for Which {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Role(role) => f.write_str(role.name()),
            Self::Id(id) => write!(f, "{id}"),
        }
    }
}

fn roles(model: &Model, tubes: &[rings::Tube]) -> Roles {
    let middle = |role: Role| {
        let mut at = (0..model.branches.len()).filter(|&b| model.branches[b].role == role);
        match (at.next(), at.next()) {
            (Some(b), None) => tubes[b].middle(),
            _ => None,
        }
    };
    let [graft, proximal, distal] = [Role::Graft, Role::Proximal, Role::Distal].map(middle);
    // two of three would be a different question
    match (graft, proximal, distal) {
        (Some(_), Some(_), Some(_)) => Roles { graft, proximal, distal, flow_from: None },
        _ => Roles::default(),
    }
}

/// A blind end: where the wall closes, past the last ring.
fn tip(plane: usize, position: P3, outward: V3) -> Tip {
    Tip { plane, lumen: 0, position, outward }
}

#[cfg(test)]
mod tests;
