//! What can go wrong, in words that a script (code), an operator (message) and a person at the scanner (place) can use.

use crate::{Patient, Point};
use std::fmt;

/// Whose fault it is. Decides the exit code and the HTTP status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FaultKind {
    /// The scan or the plan is at fault (exit 2).
    Input,
    /// A stated limit was met (exit 3).
    Limit,
    /// The numbers did not work out: no convergence, no valid mesh (exit 4).
    Numeric,
    /// Cancelled by the caller (exit 130).
    Cancelled,
    /// Our own fault (exit 1).
    Internal,
}

impl FaultKind {
    /// The process exit code of contract.md.
    pub fn exit_code(self) -> u8 {
        match self {
            Self::Input => 2,
            Self::Limit => 3,
            Self::Numeric => 4,
            Self::Cancelled => 130,
            Self::Internal => 1,
        }
    }
}

/// Where a fault or a warning lies. Every member is optional; counts start at 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Place {
    /// The uploaded file's name inside the upload (never a path of this machine).
    pub file: Option<String>,
    /// The plan's field, as a dotted path such as `segmentation.threshold`.
    pub field: Option<String>,
    /// Slice of the stack, counted along its normal.
    pub slice: Option<usize>,
    /// Contour within its slice or plane.
    pub contour: Option<usize>,
    /// Mesh element, graph node or edge.
    pub element: Option<usize>,
    /// Position in the patient, LPS mm.
    pub position: Option<Point<Patient>>,
}

impl Place {
    /// Nowhere in particular.
    pub fn none() -> Self {
        Self::default()
    }
    /// A slice.
    pub fn slice(slice: usize) -> Self {
        Self { slice: Some(slice), ..Self::default() }
    }
    /// A contour of a slice.
    pub fn contour(slice: usize, contour: usize) -> Self {
        Self { slice: Some(slice), contour: Some(contour), ..Self::default() }
    }
    /// A file of the upload.
    pub fn file(name: impl Into<String>) -> Self {
        Self { file: Some(name.into()), ..Self::default() }
    }
    /// A field of the plan.
    pub fn field(path: impl Into<String>) -> Self {
        Self { field: Some(path.into()), ..Self::default() }
    }
    /// A mesh element, graph node or edge.
    pub fn element(element: usize) -> Self {
        Self { element: Some(element), ..Self::default() }
    }
    /// A position in the patient.
    pub fn at(position: Point<Patient>) -> Self {
        Self { position: Some(position), ..Self::default() }
    }
    /// Whether nothing is known of the place.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut sep = "";
        let mut part = |f: &mut fmt::Formatter<'_>, text: String| -> fmt::Result {
            write!(f, "{sep}{text}")?;
            sep = ", ";
            Ok(())
        };
        if let Some(x) = &self.file {
            part(f, format!("file {x}"))?;
        }
        if let Some(x) = &self.field {
            part(f, format!("plan field {x}"))?;
        }
        if let Some(x) = self.slice {
            part(f, format!("slice {x}"))?;
        }
        if let Some(x) = self.contour {
            part(f, format!("contour {x}"))?;
        }
        if let Some(x) = self.element {
            part(f, format!("element {x}"))?;
        }
        if let Some(p) = self.position {
            part(f, format!("LPS ({:.2}, {:.2}, {:.2}) mm", p.x(), p.y(), p.z()))?;
        }
        Ok(())
    }
}

/// An error that can be told to a person and to a script. Every crate's error enum implements it.
pub trait Faulty: std::error::Error {
    /// Whose fault it is.
    fn kind(&self) -> FaultKind;
    /// A stable machine code such as `contour.open`, listed in docs/codes.md.
    fn code(&self) -> &'static str;
    /// Where it lies.
    fn place(&self) -> Place {
        Place::none()
    }
}

/// Something that the reader of the result must know although the job went on.
#[derive(Clone, Debug, PartialEq)]
pub struct Warning {
    /// A stable machine code such as `stack.gap`.
    pub code: &'static str,
    /// One sentence with numbers.
    pub message: String,
    /// Where.
    pub place: Place,
}

impl Warning {
    /// A warning with its place.
    pub fn new(code: &'static str, message: impl Into<String>, place: Place) -> Self {
        Self { code, message: message.into(), place }
    }
}
