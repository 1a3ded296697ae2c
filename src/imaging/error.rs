//! What can be wrong with a stack or keep a vessel from being found.

use space::{FaultKind, Faulty, P3, Place};

/// Why no contours came out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// Fewer than three slices.
    #[error("the stack has {slices} slices and at least 3 are needed; add the missing slices of the series")]
    TooFewSlices {
        /// Slices present (after those left out by the plan).
        slices: usize,
    },
    /// Sizes or spacing outside the stated limits.
    #[error("{what} is {value}, the limit is {limit}; crop or resample the series")]
    TooLarge {
        /// What was measured.
        what: &'static str,
        /// Its value.
        value: usize,
        /// The limit.
        limit: usize,
    },
    /// Slices of different sizes.
    #[error(
        "slice {slice} has {columns} x {rows} pixels and the first one {first_columns} x {first_rows}; \
             give the slices of one series only"
    )]
    UnequalSizes {
        /// The slice, in the order given.
        slice: usize,
        /// Its pixels per row.
        columns: usize,
        /// Its rows.
        rows: usize,
        /// Pixels per row of the first slice.
        first_columns: usize,
        /// Rows of the first slice.
        first_rows: usize,
    },
    /// Number of pixels and sizes disagree.
    #[error("the stack has {pixels} pixel values where its sizes ask for {wanted}; the file is damaged or truncated")]
    PixelCount {
        /// Pixels present.
        pixels: usize,
        /// Pixels that the sizes ask for.
        wanted: usize,
    },
    /// Spacing or directions that describe no rectangular lattice.
    #[error("the geometry is not usable: {what}; correct the geometry in the plan or export the series again")]
    Geometry {
        /// What is wrong.
        what: String,
    },
    /// Two slices in one position.
    #[error("slices {slice} and {other} lie in one position ({distance_mm:.4} mm apart); leave one of the two out")]
    DuplicatePosition {
        /// The first of the two, counted along the normal.
        slice: usize,
        /// The second.
        other: usize,
        /// Their distance along the normal.
        distance_mm: f64,
    },
    /// Slices not on one line along the normal.
    #[error(
        "slice {slice} is displaced sideways by {offset_mm:.3} mm against the first one (gantry tilt or several \
             series mixed); give an untilted or resampled series"
    )]
    Sheared {
        /// The slice, counted along the normal.
        slice: usize,
        /// Sideways displacement.
        offset_mm: f64,
    },
    /// A pixel that is no number.
    #[error("slice {slice} holds a pixel that is not a finite number (row {row}, column {column}); export it again")]
    NotFinite {
        /// The slice.
        slice: usize,
        /// Its row.
        row: usize,
        /// Its column.
        column: usize,
    },
    /// All pixels have one value.
    #[error("all pixels have the value {value}: the images are empty; check the export")]
    Uniform {
        /// The value.
        value: f32,
    },
    /// Nothing that looks like a vessel.
    #[error("no vessel was found: {reason}; mark it by a threshold, a region or a seed if it is there")]
    NoVessel {
        /// What was missed, with numbers.
        reason: String,
    },
    /// A label mask that cannot be the lumen of this stack.
    #[error("the label mask cannot be used: {reason}; draw it on this series")]
    Mask {
        /// What is wrong with it.
        reason: String,
    },
    /// A seed in the background.
    #[error(
        "seed {seed} lies in no bright structure (grey value {value:.1}, at least {needed:.1} is needed); \
             move it into the lumen"
    )]
    SeedOutside {
        /// Number of the seed in the plan.
        seed: usize,
        /// Where it lies.
        position: P3,
        /// Grey value there.
        value: f64,
        /// Smallest level tried there.
        needed: f64,
    },
    /// A region or slice of the plan that is not in the stack.
    #[error("{field} names slice {slice} and the stack has slices 0 to {last}; correct the plan")]
    NoSuchSlice {
        /// The plan's field.
        field: &'static str,
        /// The slice named.
        slice: usize,
        /// Last slice there is.
        last: usize,
    },
    /// A setting that is no usable number.
    #[error("{field} is {value}, which is not usable: {reason}")]
    Setting {
        /// The plan's field.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// Contours could not be drawn although a vessel was found.
    #[error(
        "the vessel that was found gives contours in {planes} planes only, at least 3 are needed; \
             use a finer stack or another contour axis"
    )]
    TooFewContours {
        /// Planes with a contour.
        planes: usize,
    },
    /// Cancelled by the caller.
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
            Self::TooLarge { .. } => FaultKind::Limit,
            Self::Cancelled => FaultKind::Cancelled,
            _ => FaultKind::Input,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::TooFewSlices { .. } => "stack.too_few_slices",
            Self::TooLarge { .. } => "stack.too_large",
            Self::UnequalSizes { .. } => "stack.unequal_sizes",
            Self::PixelCount { .. } => "stack.pixel_count",
            Self::Geometry { .. } => "stack.geometry",
            Self::DuplicatePosition { .. } => "stack.duplicate_position",
            Self::Sheared { .. } => "stack.sheared",
            Self::NotFinite { .. } => "stack.not_finite",
            Self::Uniform { .. } => "stack.uniform",
            Self::NoVessel { .. } => "segmentation.no_vessel",
            Self::Mask { .. } => "segmentation.mask",
            Self::SeedOutside { .. } => "segmentation.seed_outside",
            Self::NoSuchSlice { .. } => "segmentation.no_such_slice",
            Self::Setting { .. } => "segmentation.setting",
            Self::TooFewContours { .. } => "contours.too_few",
            Self::Cancelled => "cancelled",
        }
    }
    fn place(&self) -> Place {
        match *self {
            Self::UnequalSizes { slice, .. } | Self::Sheared { slice, .. } | Self::NotFinite { slice, .. } => {
                Place::slice(slice)
            }
            Self::DuplicatePosition { other, .. } => Place::slice(other),
            Self::SeedOutside { seed, position, .. } => Place {
                field: Some(format!("segmentation.seeds_mm[{seed}]")),
                position: Some(position),
                ..Place::default()
            },
            Self::NoSuchSlice { field, slice, .. } => {
                Place { field: Some(field.into()), slice: Some(slice), ..Place::default() }
            }
            Self::Setting { field, .. } => Place::field(field),
            _ => Place::none(),
        }
    }
}
