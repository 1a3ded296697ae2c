//! What can go wrong when a phantom is asked for.

use space::{FaultKind, Faulty, Place};

/// A value of [`crate::Settings`] that cannot be used.
#[derive(Clone, Debug, PartialEq)]
pub struct SettingFault {
    /// The field's name, such as `pixel_mm`.
    pub field: &'static str,
    /// The value and what is allowed.
    pub reason: String,
}

/// Faults of this crate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// Some settings cannot be used; all of them are listed.
    #[error("the phantom's settings cannot be used: {}", list(.0))]
    Settings(Vec<SettingFault>),
    /// No phantom of that name.
    #[error("there is no phantom named \"{0}\"; use anastomosis, tube, helix, trifurcation, sphere or random-SEED")]
    UnknownKind(String),
    /// The stack asked for is too large.
    #[error("a stack of {voxels} voxels was asked for and at most {limit} are made; use fewer slices, rows or columns")]
    TooLarge {
        /// Voxels asked for.
        voxels: u128,
        /// Largest number made.
        limit: u128,
    },
    /// No place for an unrelated vessel at the asked distance.
    #[error(
        "no place was found for unrelated vessel {number} at {clearance_mm} mm from the others after {tries} tries; \
         ask for fewer distractors or a larger field of view"
    )]
    NoRoom {
        /// Which of the unrelated vessels, from 0.
        number: usize,
        /// The distance between walls that was asked for, mm.
        clearance_mm: f64,
        /// Places tried.
        tries: usize,
    },
    /// The vessel's reference point lies outside the stack.
    #[error("the vessel's reference point lies outside the stack; use a smaller shift_mm or a larger stack")]
    OutsideStack(space::P3),
    /// Cancelled by the caller.
    #[error("cancelled")]
    Cancelled,
}

fn list(faults: &[SettingFault]) -> String {
    faults.iter().map(|f| format!("{} {}", f.field, f.reason)).collect::<Vec<_>>().join("; ")
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::Settings(_) | Self::UnknownKind(_) | Self::NoRoom { .. } | Self::OutsideStack(_) => FaultKind::Input,
            Self::TooLarge { .. } => FaultKind::Limit,
            Self::Cancelled => FaultKind::Cancelled,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::Settings(_) => "phantom.settings",
            Self::UnknownKind(_) => "phantom.kind",
            Self::TooLarge { .. } => "phantom.too_large",
            Self::NoRoom { .. } => "phantom.no_room",
            Self::OutsideStack(_) => "phantom.outside",
            Self::Cancelled => "cancelled",
        }
    }
    fn place(&self) -> Place {
        match self {
            Self::Settings(faults) => faults.first().map(|f| Place::field(f.field)).unwrap_or_default(),
            Self::OutsideStack(p) => Place::at(*p),
            _ => Place::none(),
        }
    }
}

impl From<exec::Cancelled> for Error {
    fn from(_: exec::Cancelled) -> Self {
        Self::Cancelled
    }
}
