//! What can go wrong while measuring.

use crate::resynthesis::Which;
use space::{FaultKind, Faulty, P3, Place};

/// Faults of this crate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// Asked to stop.
    #[error(transparent)]
    Cancelled(#[from] exec::Cancelled),
    /// An edge of the graph breaks the promises of `MedialGraph`.
    #[error("edge {edge} of the medial graph is not a line: {reason}; please report this scan")]
    Graph {
        /// Edge number.
        edge: usize,
        /// What is wrong.
        reason: &'static str,
    },
    /// Two roles claim one branch.
    #[error(
        "roles.{first}_mm and roles.{second}_mm lie in the same branch at every junction; place each point inside its own vessel, 2 or more diameters from the junction"
    )]
    RolesConflict {
        /// First role.
        first: &'static str,
        /// Second role.
        second: &'static str,
    },
    /// A role's point is not in a vessel.
    #[error(
        "roles.{role}_mm lies {distance_mm:.1} mm from the nearest medial line, where the lumen's radius is {radius_mm:.1} mm; place it inside its vessel (LPS, mm)"
    )]
    RolesFar {
        /// The role.
        role: &'static str,
        /// Distance to the nearest medial line, mm.
        distance_mm: f64,
        /// Radius there, mm.
        radius_mm: f64,
        /// The point.
        position: P3,
    },
    /// A change names no branch, or more than one.
    #[error("{found} of the branches is `{which}`: name one by its number in result.json")]
    VariantBranch {
        /// As it was named.
        which: Which,
        /// `none` or `several`.
        found: &'static str,
    },
    /// Two ways lead to what lies beyond a branch.
    #[error("branch {branch} is part of a loop: it cannot be changed without tearing it")]
    VariantLoop {
        /// Branch number.
        branch: usize,
    },
    /// A direction or plane that a change needs is not known.
    #[error(
        "branch {branch} cannot be changed so: it, or what it is turned against, has no fitted direction at a junction of its own, or they span no plane"
    )]
    VariantDirection {
        /// Branch number.
        branch: usize,
    },
    /// A value out of its range.
    #[error("{field} is {value}: give {low} to {high}")]
    VariantValue {
        /// The change's field.
        field: &'static str,
        /// Its value.
        value: f64,
        /// Smallest allowed.
        low: f64,
        /// Largest allowed.
        high: f64,
    },
    /// Nothing to carry along.
    #[error("branch {branch} has no clear section outside its junctions: it cannot be carried along a changed line")]
    VariantSections {
        /// Branch number.
        branch: usize,
    },
    /// r kappa >= 1.
    #[error(
        "sections of branch {branch} would cut each other at ring {ring}: the line bends more sharply than the vessel's radius of {radius_mm:.1} mm allows; ask for less curvature"
    )]
    VariantFolds {
        /// Branch number.
        branch: usize,
        /// Ring along the branch.
        ring: usize,
        /// Longest ray of the section, mm.
        radius_mm: f64,
        /// Where.
        at: P3,
    },
    /// Lumens that were apart meet.
    #[error("branches {branch} and {other} would run into each other; ask for a wider angle or less curvature")]
    VariantCollision {
        /// Branch number.
        branch: usize,
        /// The other's.
        other: usize,
        /// Where.
        at: P3,
    },
    /// A window that cannot be.
    #[error("morphometry.{field} is {value}: give a window with 0 <= fit_from < fit_to <= 100 graft diameters")]
    Window {
        /// The plan's field.
        field: &'static str,
        /// Its value.
        value: f64,
    },
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::Cancelled(_) => FaultKind::Cancelled,
            Self::Graph { .. } => FaultKind::Internal,
            Self::RolesConflict { .. }
            | Self::RolesFar { .. }
            | Self::Window { .. }
            | Self::VariantBranch { .. }
            | Self::VariantLoop { .. }
            | Self::VariantDirection { .. }
            | Self::VariantValue { .. }
            | Self::VariantSections { .. }
            | Self::VariantFolds { .. }
            | Self::VariantCollision { .. } => FaultKind::Input,
        }
    }

    fn code(&self) -> &'static str {
        match self {
            Self::Cancelled(_) => "cancelled",
            Self::Graph { .. } => "graph.line",
            Self::RolesConflict { .. } => "roles.conflict",
            Self::RolesFar { .. } => "roles.far",
            Self::Window { .. } => "angles.window",
            Self::VariantBranch { .. } => "variant.branch",
            Self::VariantLoop { .. } => "variant.loop",
            Self::VariantDirection { .. } => "variant.direction",
            Self::VariantValue { .. } => "variant.value",
            Self::VariantSections { .. } => "variant.sections",
            Self::VariantFolds { .. } => "variant.folds",
            Self::VariantCollision { .. } => "variant.collision",
        }
    }

    fn place(&self) -> Place {
        match self {
            Self::Cancelled(_) => Place::none(),
            Self::Graph { edge, .. } => Place::element(*edge),
            Self::RolesConflict { second, .. } => Place::field(format!("roles.{second}_mm")),
            Self::RolesFar { role, position, .. } => {
                Place { position: Some(*position), ..Place::field(format!("roles.{role}_mm")) }
            }
            Self::Window { field, .. } => Place::field(format!("morphometry.{field}")),
            Self::VariantBranch { .. } => Place::field("changes.branch"),
            Self::VariantValue { field, .. } => Place::field(format!("changes.{field}")),
            Self::VariantLoop { branch } | Self::VariantDirection { branch } | Self::VariantSections { branch } => {
                Place::element(*branch)
            }
            Self::VariantFolds { branch, at, .. } | Self::VariantCollision { branch, at, .. } => {
                Place { position: Some(*at), ..Place::element(*branch) }
            }
        }
    }
}
