//! What can go wrong between f and the medial graph.

use space::{FaultKind, Faulty, P3, Place};

/// A fault of this crate. Codes are stable and listed in docs/codes.md.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// The caller asked to stop.
    #[error("the skeleton was cancelled")]
    Cancelled,
    /// A setting is out of its range.
    #[error("skeleton setting {name} is {value}, but must be {range}; change it in the plan")]
    Setting {
        /// The setting's name.
        name: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        range: &'static str,
    },
    /// The lattice would be larger than allowed.
    #[error("a lattice of {voxels} voxels at {spacing_mm} mm exceeds the limit of {limit}; choose a coarser spacing")]
    TooManyVoxels {
        /// Voxels asked for.
        voxels: u128,
        /// Spacing, mm.
        spacing_mm: f64,
        /// The limit.
        limit: usize,
    },
    /// The field has no finite box.
    #[error("the implicit function has no finite bounding box; the fit is at fault")]
    Unbounded,
    /// No seed lies in a lumen.
    #[error("none of {seeds} seed points leads to a region with f > 0 inside the cut planes; check the contours")]
    NoLumen {
        /// Number of seeds given.
        seeds: usize,
        /// One of the seeds, where there are any.
        at: Option<P3>,
    },
    /// Nothing remained after thinning and pruning.
    #[error("the lumen has no medial line: it is a compact blob, not a vessel; check threshold and region")]
    NoLine,
    /// A cap of the surface has no end of the graph.
    #[error("no branch of the medial graph reaches cap {face_id}; a finer spacing or a shorter trim may help")]
    CapWithoutEnd {
        /// The cap's face id.
        face_id: u32,
        /// The cap's centroid.
        at: P3,
    },
    /// Several ends claim one cap.
    #[error("{count} ends of the medial graph claim cap {face_id}")]
    CapShared {
        /// The cap's face id.
        face_id: u32,
        /// How many.
        count: usize,
        /// The cap's centroid.
        at: P3,
    },
    /// A node has a degree that its kind does not allow.
    #[error("node {node} has {degree} branches, which does not fit its kind")]
    Degree {
        /// The node.
        node: usize,
        /// Its degree.
        degree: usize,
        /// Where.
        at: P3,
    },
    /// A medial line does not run from its first to its last node in one piece.
    #[error("edge {edge} is broken: {reason}")]
    Line {
        /// The edge.
        edge: usize,
        /// What is wrong.
        reason: &'static str,
        /// Where.
        at: P3,
    },
    /// Arc length does not grow along a medial line.
    #[error("the arc length of edge {edge} does not grow at point {point}")]
    Abscissa {
        /// The edge.
        edge: usize,
        /// The point.
        point: usize,
        /// Where.
        at: P3,
    },
    /// A medial line leaves the lumen.
    #[error("edge {edge} leaves the lumen: f = {value:.3} mm; a finer spacing may help")]
    Outside {
        /// The edge.
        edge: usize,
        /// f there, mm.
        value: f64,
        /// Where.
        at: P3,
    },
    /// An inscribed radius is missing or not positive.
    #[error("edge {edge} has an inscribed radius of {radius_mm} mm")]
    Radius {
        /// The edge.
        edge: usize,
        /// The value.
        radius_mm: f64,
        /// Where.
        at: P3,
    },
}

impl From<exec::Cancelled> for Error {
    fn from(_: exec::Cancelled) -> Self {
        Self::Cancelled
    }
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::Cancelled => FaultKind::Cancelled,
            Self::Setting { .. } | Self::NoLumen { .. } | Self::NoLine => FaultKind::Input,
            Self::TooManyVoxels { .. } => FaultKind::Limit,
            Self::Unbounded
            | Self::CapWithoutEnd { .. }
            | Self::CapShared { .. }
            | Self::Degree { .. }
            | Self::Line { .. }
            | Self::Abscissa { .. }
            | Self::Outside { .. }
            | Self::Radius { .. } => FaultKind::Numeric,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::Cancelled => "cancelled",
            Self::Setting { .. } => "skeleton.setting",
            Self::TooManyVoxels { .. } => "skeleton.too_many_voxels",
            Self::Unbounded => "skeleton.unbounded",
            Self::NoLumen { .. } => "skeleton.no_lumen",
            Self::NoLine => "skeleton.no_line",
            Self::CapWithoutEnd { .. } => "skeleton.cap_without_end",
            Self::CapShared { .. } => "skeleton.cap_shared",
            Self::Degree { .. } => "skeleton.degree",
            Self::Line { .. } => "skeleton.line",
            Self::Abscissa { .. } => "skeleton.abscissa",
            Self::Outside { .. } => "skeleton.line_outside",
            Self::Radius { .. } => "skeleton.radius",
        }
    }
    fn place(&self) -> Place {
        match self {
            Self::NoLumen { at: Some(p), .. } | Self::CapWithoutEnd { at: p, .. } | Self::CapShared { at: p, .. } => {
                Place::at(*p)
            }
            Self::Degree { node: e, at, .. }
            | Self::Line { edge: e, at, .. }
            | Self::Abscissa { edge: e, at, .. }
            | Self::Outside { edge: e, at, .. }
            | Self::Radius { edge: e, at, .. } => Place { element: Some(*e), position: Some(*at), ..Place::default() },
            _ => Place::none(),
        }
    }
}
