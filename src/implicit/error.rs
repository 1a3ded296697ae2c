//! What can go wrong between curves and function.

use space::{FaultKind, Faulty, Place};

/// Errors of the implicit fit.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Too few points on the wall to determine a function.
    #[error("only {points} wall points, at least {least} are needed: too few contours were found")]
    TooFewPoints {
        /// Wall points found.
        points: usize,
        /// Wall points needed.
        least: usize,
    },
    /// All contours lie in one plane: a function of three variables is not determined.
    #[error("all {points} constraints lie in one plane: contours from at least two planes are needed")]
    Coplanar {
        /// Constraints.
        points: usize,
    },
    /// More constraints than the dense solver may hold.
    #[error("{constraints} constraints exceed the limit of {limit}: use fewer contours or raise the limit")]
    TooMany {
        /// Constraints wanted.
        constraints: usize,
        /// Limit.
        limit: usize,
    },
    /// The factorisation broke down.
    #[error(
        "the system of {constraints} constraints could not be factorised (pivot {pivot}): contradictory or coincident points"
    )]
    Singular {
        /// Constraints.
        constraints: usize,
        /// Row of the pivot that was not positive.
        pivot: usize,
    },
    /// Conjugate gradients do not reach the accuracy wanted.
    #[error(
        "the system of {constraints} constraints is solved to {residual_mm:.1e} mm only, not to {wanted_mm:.1e} mm, after {iterations} iterations: look for contours drawn twice or at contradictory places"
    )]
    Stalled {
        /// Constraints.
        constraints: usize,
        /// Products with the matrix.
        iterations: usize,
        /// Largest true residual reached.
        residual_mm: f64,
        /// Largest true residual allowed.
        wanted_mm: f64,
    },
    /// The function misses its own data by more than the data's error allows.
    #[error(
        "the function misses its constraints by up to {residual_mm:.2} mm, more than {bound_mm:.2} mm: the contours contradict each other"
    )]
    Residual {
        /// Largest residual on the wall.
        residual_mm: f64,
        /// Bound.
        bound_mm: f64,
        /// Where the largest lies.
        place: Place,
    },
    /// A sampled field would need more lattice points than allowed.
    #[error("sampling needs {points} lattice points, more than {limit}: use a larger spacing")]
    TooManySamples {
        /// Points wanted.
        points: usize,
        /// Limit.
        limit: usize,
    },
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
}

impl From<exec::Cancelled> for Error {
    fn from(_: exec::Cancelled) -> Self {
        Self::Cancelled
    }
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::TooFewPoints { .. } | Self::Coplanar { .. } => FaultKind::Input,
            Self::TooMany { .. } | Self::TooManySamples { .. } => FaultKind::Limit,
            Self::Singular { .. } | Self::Stalled { .. } | Self::Residual { .. } => FaultKind::Numeric,
            Self::Cancelled => FaultKind::Cancelled,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::TooFewPoints { .. } => "implicit.too_few_points",
            Self::Coplanar { .. } => "implicit.coplanar",
            Self::TooMany { .. } => "implicit.too_many_constraints",
            Self::Singular { .. } => "implicit.singular",
            Self::Stalled { .. } => "fit.stalled",
            Self::Residual { .. } => "implicit.residual",
            Self::TooManySamples { .. } => "implicit.too_many_samples",
            Self::Cancelled => "cancelled",
        }
    }
    fn place(&self) -> Place {
        match self {
            Self::Residual { place, .. } => place.clone(),
            _ => Place::none(),
        }
    }
}
