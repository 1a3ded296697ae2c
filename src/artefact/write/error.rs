//! What can go wrong when artefacts are written. All but [`Error::Loops`] is our own fault: the input was
//! accepted long before.

use space::{FaultKind, Faulty};

/// A fault of the writers.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// A number that is not finite reached a writer.
    #[error(
        "{artefact}: {path} is {value}, which is not a number that may be reported; nothing was written, please report the job with its input"
    )]
    NotFinite {
        /// Artefact name.
        artefact: &'static str,
        /// Path inside the artefact, such as `$.surface.area_mm2`.
        path: String,
        /// `NaN`, `inf` or `-inf`.
        value: String,
    },
    /// Two arrays that belong together differ in length, or an index points nowhere.
    #[error(
        "{artefact}: {what}: expected {expected}, found {found}; nothing was written, please report the job with its input"
    )]
    Mismatch {
        /// Artefact name.
        artefact: &'static str,
        /// Which array.
        what: &'static str,
        /// Wanted length or bound.
        expected: usize,
        /// Actual length or index.
        found: usize,
    },
    /// A format's encoder failed.
    #[error("{artefact} could not be encoded: {reason}")]
    Encode {
        /// Artefact name.
        artefact: &'static str,
        /// The encoder's words.
        reason: String,
    },
    /// SWC holds trees only.
    #[error(
        "{artefact} holds trees only and this vessel has {cycles} loop(s): leave `swc` out of the plan's outputs and ask for `graphml`"
    )]
    Loops {
        /// Artefact name.
        artefact: &'static str,
        /// Independent loops.
        cycles: usize,
    },
    /// The artefact is larger than its format can say.
    #[error(
        "{artefact} would take {bytes} bytes; its format ends at {limit}: ask for a coarser surface (plan field surface.edge_mm)"
    )]
    TooLarge {
        /// Artefact name.
        artefact: &'static str,
        /// Wanted size.
        bytes: u64,
        /// Largest size of the format.
        limit: u64,
    },
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::TooLarge { .. } => FaultKind::Limit,
            Self::Loops { .. } => FaultKind::Input,
            _ => FaultKind::Internal,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::NotFinite { .. } => "artefact.not_finite",
            Self::Mismatch { .. } => "artefact.mismatch",
            Self::Encode { .. } => "artefact.encode",
            Self::TooLarge { .. } => "artefact.too_large",
            Self::Loops { .. } => "artefact.loops",
        }
    }
}

/// Refuses arrays of the wrong length.
///
/// # Errors
/// [`Error::Mismatch`].
pub(crate) fn same_length(
    artefact: &'static str,
    what: &'static str,
    expected: usize,
    found: usize,
) -> Result<(), Error> {
    if expected == found { Ok(()) } else { Err(Error::Mismatch { artefact, what, expected, found }) }
}

/// Refuses numbers that are not finite; `path` names the array.
///
/// # Errors
/// [`Error::NotFinite`] with the first offending index.
pub(crate) fn all_finite(artefact: &'static str, path: &str, values: &[f64]) -> Result<(), Error> {
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(i) => Err(Error::NotFinite { artefact, path: format!("{path}[{i}]"), value: values[i].to_string() }),
    }
}
