//! What can be wrong with an upload, with the file or the plan's field it lies in and what to do next.

use crate::plan::PlanFaults;
use space::{FaultKind, Faulty, Place};

/// Why an upload was not read. Messages carry the client's own file names, which may name a patient: they go back to
/// the client and never into a log.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// `input.no_images`
    #[error(
        "no images among the {files} files given; give DICOM, NIfTI, MetaImage, NRRD, PNG, PGM, JPEG or TIFF files"
    )]
    NoImages {
        /// Files looked at.
        files: usize,
    },
    /// `input.unreadable`
    #[error("{file} cannot be opened: {reason}")]
    Unreadable {
        /// File name without its folder.
        file: String,
        /// The operating system's reason.
        reason: String,
    },
    /// `input.unequal_sizes`
    #[error(
        "{file} has {found} but the other slices have {expected} (rows x columns, step in mm); leave it out or send it as a stack of its own"
    )]
    UnequalSizes {
        /// The file that differs.
        file: String,
        /// Its size and spacing.
        found: String,
        /// That of the others.
        expected: String,
    },
    /// `input.truncated`
    #[error("{file} ends too early: {what} needs {needed} bytes and {found} are there; send the file again")]
    Truncated {
        /// The file.
        file: String,
        /// What was being read.
        what: &'static str,
        /// Bytes wanted.
        needed: u64,
        /// Bytes found.
        found: u64,
    },
    /// `input.geometry_missing`: the images and the plan do not say how large a pixel is or where a slice lies.
    #[error("{}the scale of the images is unknown: {reason}", in_file(.file))]
    GeometryMissing {
        /// The file, where the fault is one file's.
        file: Option<String>,
        /// The plan's field that would help.
        field: &'static str,
        /// What is missing and what to do.
        reason: String,
    },
    /// `input.geometry`: geometry that cannot be right.
    #[error("{file}: {reason}")]
    Geometry {
        /// The file.
        file: String,
        /// What is wrong, with numbers.
        reason: String,
    },
    /// `stack.duplicate_position`
    #[error(
        "{first} and {second} lie in one position ({offset_mm:.3} mm along the normal); send one echo, phase or time point only"
    )]
    DuplicatePosition {
        /// One file (or file and frame).
        first: String,
        /// The other.
        second: String,
        /// Slice number of the first.
        slice: usize,
        /// Position along the normal from the first slice.
        offset_mm: f64,
    },
    /// `stack.too_few_slices`
    #[error("the stack has {found} slice(s); a vessel needs at least {needed}: send the whole series")]
    TooFewSlices {
        /// Slices found.
        found: usize,
        /// Slices needed.
        needed: usize,
    },
    /// `input.too_large`: a limit, met before anything of that size was allocated.
    #[error("{}{what} is {value}, the limit is {limit}; crop or resample the scan", in_file(.file))]
    TooLarge {
        /// The file, where one is to blame.
        file: Option<String>,
        /// What is too large.
        what: &'static str,
        /// Its size.
        value: u64,
        /// The limit.
        limit: u64,
    },
    /// `input.unsupported`
    #[error("{file}: {reason}")]
    Unsupported {
        /// The file.
        file: String,
        /// What is not read, and what is.
        reason: String,
    },
    /// `input.malformed`
    #[error("{file} is damaged: {reason}; send the file again")]
    Malformed {
        /// The file.
        file: String,
        /// What does not fit.
        reason: String,
    },
    /// `input.colour`
    #[error("{file} is a colour image; send the grey values of the scanner (a screenshot has lost them)")]
    Colour {
        /// The file.
        file: String,
    },
    /// `input.not_finite`
    #[error("{file}: pixel {index} is not a finite number; replace it (NaN, infinity) before sending")]
    NotFinite {
        /// The file.
        file: String,
        /// Index of the pixel in the file.
        index: usize,
    },
    /// `input.mixed`
    #[error("one upload is one stack, but {first} is {first_kind} and {second} is {second_kind}; send one of them")]
    Mixed {
        /// One file.
        first: String,
        /// Its kind.
        first_kind: &'static str,
        /// Another.
        second: String,
        /// Its kind.
        second_kind: &'static str,
    },
    /// `dicom.gantry_tilt`
    #[error(
        "the slices are sheared by {degrees:.2} degrees against their normal (gantry tilt); resample the scan to upright slices first"
    )]
    GantryTilt {
        /// Angle between the line of slice positions and the slice normal.
        degrees: f64,
    },
    /// `stack.sheared`: a volume whose axes are not at right angles.
    #[error("{file}: the axes of the volume are {degrees:.2} degrees away from right angles; resample it first")]
    Sheared {
        /// The file.
        file: String,
        /// Deviation.
        degrees: f64,
    },
    /// `dicom.ambiguous_series`
    #[error(
        "two series of {slices} slices each ({first}, {second}); send only the one that is meant or name it in the plan (series)"
    )]
    AmbiguousSeries {
        /// A file of one series.
        first: String,
        /// A file of the other.
        second: String,
        /// Slices of each.
        slices: usize,
    },
    /// `dicom.no_such_series`
    #[error("the plan names series {name} and the upload holds {known}; name one of them by number or UID")]
    NoSuchSeries {
        /// The plan's name.
        name: String,
        /// Series numbers there are.
        known: String,
    },
    /// `mask.label`
    #[error(
        "{file} holds the labels {known}{}; name the lumen's in the plan (segmentation.label)",
        wanted.map(|w| format!(" and the plan wants {w}")).unwrap_or_default()
    )]
    Label {
        /// The mask.
        file: String,
        /// The plan's label.
        wanted: Option<u16>,
        /// Labels there are.
        known: String,
    },
    /// `mask.geometry`
    #[error("{file}: its voxels lie {off_voxels:.2} voxels beside those of the scan; draw the mask on this series")]
    MaskGeometry {
        /// The mask.
        file: String,
        /// Largest distance from a voxel of the scan, in voxels.
        off_voxels: f64,
    },
    /// `dicom.burned_in_annotation`
    #[error("{file} says that patient data is burned into its pixels; send the original series")]
    BurnedIn {
        /// The file.
        file: String,
    },
    /// `archive.refused`: encrypted, nested, with paths that leave it, or inflating without measure.
    #[error("{file}: {reason}")]
    Archive {
        /// The archive or its entry.
        file: String,
        /// Why it is not opened.
        reason: String,
    },
    /// The plan found beside the images is at fault.
    #[error(transparent)]
    Plan(#[from] PlanFaults),
    /// `cancelled`
    #[error("cancelled")]
    Cancelled,
    /// `artefact.internal`
    #[error("internal: {0}")]
    Internal(String),
}

fn in_file(file: &Option<String>) -> String {
    file.as_ref().map(|f| format!("{f}: ")).unwrap_or_default()
}

impl From<exec::Cancelled> for Error {
    fn from(_: exec::Cancelled) -> Self {
        Self::Cancelled
    }
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::TooLarge { .. } => FaultKind::Limit,
            Self::Cancelled => FaultKind::Cancelled,
            Self::Internal(_) => FaultKind::Internal,
            _ => FaultKind::Input,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::NoImages { .. } => "input.no_images",
            Self::Unreadable { .. } => "input.unreadable",
            Self::UnequalSizes { .. } => "input.unequal_sizes",
            Self::Truncated { .. } => "input.truncated",
            Self::GeometryMissing { .. } => "input.geometry_missing",
            Self::Geometry { .. } => "input.geometry",
            Self::DuplicatePosition { .. } => "stack.duplicate_position",
            Self::TooFewSlices { .. } => "stack.too_few_slices",
            Self::TooLarge { .. } => "input.too_large",
            Self::Unsupported { .. } => "input.unsupported",
            Self::Malformed { .. } => "input.malformed",
            Self::Colour { .. } => "input.colour",
            Self::NotFinite { .. } => "input.not_finite",
            Self::Mixed { .. } => "input.mixed",
            Self::GantryTilt { .. } => "dicom.gantry_tilt",
            Self::Sheared { .. } => "stack.sheared",
            Self::AmbiguousSeries { .. } => "dicom.ambiguous_series",
            Self::NoSuchSeries { .. } => "dicom.no_such_series",
            Self::Label { .. } => "mask.label",
            Self::MaskGeometry { .. } => "mask.geometry",
            Self::BurnedIn { .. } => "dicom.burned_in_annotation",
            Self::Archive { .. } => "archive.refused",
            Self::Plan(faults) => faults.code(),
            Self::Cancelled => "cancelled",
            Self::Internal(_) => "artefact.internal",
        }
    }
    fn place(&self) -> Place {
        match self {
            Self::Unreadable { file, .. }
            | Self::UnequalSizes { file, .. }
            | Self::Truncated { file, .. }
            | Self::Geometry { file, .. }
            | Self::Unsupported { file, .. }
            | Self::Malformed { file, .. }
            | Self::Colour { file }
            | Self::NotFinite { file, .. }
            | Self::Sheared { file, .. }
            | Self::MaskGeometry { file, .. }
            | Self::BurnedIn { file }
            | Self::Archive { file, .. } => Place::file(file),
            Self::GeometryMissing { file, field, .. } => {
                Place { file: file.clone(), field: Some((*field).to_owned()), ..Place::default() }
            }
            Self::DuplicatePosition { first, slice, .. } => {
                Place { file: Some(first.clone()), slice: Some(*slice), ..Place::default() }
            }
            Self::TooLarge { file, .. } => Place { file: file.clone(), ..Place::default() },
            Self::Mixed { second, .. } | Self::AmbiguousSeries { second, .. } => Place::file(second),
            Self::Label { file, .. } => {
                Place { file: Some(file.clone()), field: Some("segmentation.label".to_owned()), ..Place::default() }
            }
            Self::NoSuchSeries { .. } => Place::field("series"),
            Self::Plan(faults) => faults.place(),
            _ => Place::none(),
        }
    }
}
