//! What can go wrong while measuring.

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
            Self::RolesConflict { .. } | Self::RolesFar { .. } | Self::Window { .. } => FaultKind::Input,
        }
    }

    fn code(&self) -> &'static str {
        match self {
            Self::Cancelled(_) => "cancelled",
            Self::Graph { .. } => "graph.line",
            Self::RolesConflict { .. } => "roles.conflict",
            Self::RolesFar { .. } => "roles.far",
            Self::Window { .. } => "angles.window",
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
        }
    }
}
