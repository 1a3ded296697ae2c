//! Faults of stages that call more than one crate.

use crate::ends::EndFault;
use space::FaultKind;

/// The wall's and the medial lines' stages call two crates each.
#[derive(Debug, thiserror::Error)]
pub(crate) enum MeshFault {
    #[error(transparent)]
    Surface(#[from] surface::Error),
    #[error(transparent)]
    Implicit(#[from] implicit::Error),
    #[error(transparent)]
    Skeleton(#[from] skeleton::Error),
    #[error(transparent)]
    End(#[from] EndFault),
}

impl space::Faulty for MeshFault {
    fn kind(&self) -> FaultKind {
        match self {
            Self::Surface(e) => e.kind(),
            Self::Implicit(e) => e.kind(),
            Self::Skeleton(e) => e.kind(),
            Self::End(e) => e.kind(),
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::Surface(e) => e.code(),
            Self::Implicit(e) => e.code(),
            Self::Skeleton(e) => e.code(),
            Self::End(e) => e.code(),
        }
    }
    fn place(&self) -> space::Place {
        match self {
            Self::Surface(e) => e.place(),
            Self::Implicit(e) => e.place(),
            Self::Skeleton(e) => e.place(),
            Self::End(e) => e.place(),
        }
    }
}
