//! What can go wrong between the implicit function and a mesh that a solver accepts.

use crate::Defect;
use space::{FaultKind, Faulty, P3, Place};

/// Faults of polygonising, cutting, remeshing, measuring and patching.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// Stopped on request.
    #[error("the surface was cancelled")]
    Cancelled,
    /// A setting out of its range.
    #[error("surface setting {field} is {value}: {need}")]
    Settings {
        /// Name of the setting.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What it must be.
        need: &'static str,
    },
    /// No seed lies near the wall.
    #[error(
        "none of {seeds} seed points lies within two cells ({reach_mm} mm) of the wall f = 0: \
         check that the seeds are the contour points of this fit, or raise the fit's smoothness"
    )]
    NoSeed {
        /// Seeds given.
        seeds: usize,
        /// How far was looked, mm.
        reach_mm: f64,
    },
    /// More lattice cells than allowed.
    #[error("the wall crosses more than {limit} cells of {cell_mm} mm: take larger cells or a smaller region")]
    TooManyCells {
        /// The limit.
        limit: usize,
        /// Cell edge, mm.
        cell_mm: f64,
        /// A cell at the frontier.
        at: P3,
    },
    /// The zero set runs out of the box in which f has a meaning.
    #[error(
        "the wall runs {margin_mm} mm out of the data's box: the implicit function does not close there; \
         cut the vessel before its end or give more slices"
    )]
    LeavesData {
        /// Margin allowed, mm.
        margin_mm: f64,
        /// Where.
        at: P3,
    },
    /// f or its gradient is not a number.
    #[error("the implicit function is not finite: the fit behind it has failed")]
    NotFinite {
        /// Where.
        at: P3,
    },
    /// Newton's method did not land on f = 0.
    #[error("vertex {vertex} stays {distance_mm:e} mm off the wall: f is flat or rough there; smooth the fit more")]
    Projection {
        /// Vertex number.
        vertex: usize,
        /// |f| / |grad f| reached, mm.
        distance_mm: f64,
        /// Where.
        at: P3,
    },
    /// A triangle faces against the surface after remeshing.
    #[error(
        "triangle {face} is folded over: the wall is curved more sharply than the shortest edge; \
         lower the shortest surface.edge_mm or smooth the fit more"
    )]
    Folded {
        /// Triangle number.
        face: usize,
        /// Where.
        at: P3,
    },
    /// The mesh is not a closed oriented 2-manifold.
    #[error("the surface mesh is broken: {0}")]
    Defect(#[from] Defect),
    /// A cut plane touches the wall instead of crossing it.
    #[error(
        "cut plane {plane} meets the wall at a grazing angle (sine {sine:.4}): \
         move or turn the cut so that it crosses the vessel"
    )]
    GrazingCut {
        /// Plane number in the order given.
        plane: usize,
        /// Sine of the angle between plane and wall.
        sine: f64,
        /// Where.
        at: P3,
    },
    /// One rim lies inside another.
    #[error(
        "cut plane {plane} meets a lumen with a hole: a rim around {area_mm2:.3} mm2 lies inside another. Either the \
         segmentation left an island in the lumen (lower the threshold or give a seed) or the plane runs along a loop; \
         cut where the section is simple"
    )]
    NestedRims {
        /// Plane number in the order given.
        plane: usize,
        /// Area within the inner rim, mm2.
        area_mm2: f64,
        /// Where.
        at: P3,
    },
    /// A rim crosses itself or another rim.
    #[error(
        "the rim at cut plane {plane} crosses itself: the plane only just clips the wall there, or the wall is rougher \
         than the mesh resolves; move the cut by a millimetre or more, or smooth more"
    )]
    CrossedRim {
        /// Plane number in the order given.
        plane: usize,
        /// Where.
        at: P3,
    },
    /// A local cut takes a part of the wall that runs on out of its reach.
    #[error(
        "what lies past cut plane {plane} runs on out of the cut's reach of {reach_mm:.1} mm: another vessel passes there; \
         move the cut away from it"
    )]
    CutRunsOn {
        /// Plane number in the order given.
        plane: usize,
        /// Reach of the cut, mm.
        reach_mm: f64,
        /// Where the wall leaves the reach.
        at: P3,
    },
    /// Nothing is left inside the cut planes.
    #[error("cut plane {plane} removes the whole surface: its outward normal probably points the wrong way")]
    NothingLeft {
        /// Plane number in the order given.
        plane: usize,
        /// The plane's point.
        at: P3,
    },
    /// A cap lies in none of the given planes.
    #[error(
        "cap {cap} lies in none of the {planes} cut planes (nearest {distance_mm:e} mm): give the planes it was cut by"
    )]
    CapPlane {
        /// Face id of the cap.
        cap: u32,
        /// Planes given.
        planes: usize,
        /// Largest distance of its vertices from the nearest plane, mm.
        distance_mm: f64,
        /// Where.
        at: P3,
    },
    /// The wanted sizes need more triangles than allowed.
    #[error("more than {limit} triangles are needed: raise surface.max_error_mm or the shortest surface.edge_mm")]
    TooManyTriangles {
        /// The limit.
        limit: usize,
        /// A place of the densest mesh.
        at: P3,
    },
    /// The wall at an end runs too obliquely to its cut plane.
    #[error(
        "the vessel leaves through cap {face_id} at {angle_deg:.0} degrees to the cut's normal: no duct can carry its \
         section on; cut the end more squarely or set ends.extension_diameters to 0"
    )]
    ObliqueEnd {
        /// Face id of the cap.
        face_id: u32,
        /// Angle between the vessel and the cut's normal, degrees.
        angle_deg: f64,
        /// Centre of the cap.
        at: P3,
    },
    /// An extension shorter than the cut is oblique.
    #[error(
        "the extension at cap {face_id} must be at least {need_diameters:.2} diameters long to end in a plane across the \
         vessel: raise ends.extension_diameters or set it to 0"
    )]
    ShortEnd {
        /// Face id of the cap.
        face_id: u32,
        /// Least length, diameters.
        need_diameters: f64,
        /// Centre of the cap.
        at: P3,
    },
    /// An extension passes through the wall or another extension.
    #[error(
        "the extension at cap {face_id} runs into another vessel after {after_diameters:.1} diameters: \
         set ends.extension_diameters lower or cut that end elsewhere"
    )]
    ExtensionMeets {
        /// Face id of the cap.
        face_id: u32,
        /// Way along the extension to the first meeting, diameters.
        after_diameters: f64,
        /// Where.
        at: P3,
    },
    /// The harmonic functions of the patches have no solution.
    #[error("the patch equations of {unknowns} vertices cannot be solved ({reason}): remesh with another edge_mm")]
    PatchSolve {
        /// Vertices without a given value.
        unknowns: usize,
        /// What the factorisation said.
        reason: String,
    },
    /// The wall has no division into quadrilaterals.
    #[error("no quadrilateral patches: {reason}")]
    Patches {
        /// Why.
        reason: String,
        /// Where.
        at: P3,
    },
    /// The list of patch ids does not fit the caps.
    #[error("{ids} patch ids were given for {caps} caps: one id per cap, in the order of their face ids")]
    PatchIds {
        /// Ids given.
        ids: usize,
        /// Caps of the mesh.
        caps: usize,
    },
}

impl From<exec::Cancelled> for Error {
    fn from(_: exec::Cancelled) -> Self {
        Self::Cancelled
    }
}

impl Error {
    /// Whether a mesh was too coarse for the wall, or the wall is all but singular there.
    pub fn is_unresolved(&self) -> bool {
        matches!(self, Self::Folded { .. } | Self::CrossedRim { .. })
    }

    /// The plane (as given) at which the wall has no rim that could be closed: another one a little away may.
    pub fn without_rim(&self) -> Option<usize> {
        match self {
            Self::GrazingCut { plane, .. } | Self::CrossedRim { plane, .. } | Self::NestedRims { plane, .. } => {
                Some(*plane)
            }
            _ => None,
        }
    }

    /// The plane (as given) that cannot be cut by, whatever the reason.
    pub fn of_plane(&self) -> Option<usize> {
        match self {
            Self::CutRunsOn { plane, .. } | Self::NothingLeft { plane, .. } => Some(*plane),
            _ => self.without_rim(),
        }
    }
}

impl Faulty for Error {
    fn kind(&self) -> FaultKind {
        match self {
            Self::Cancelled => FaultKind::Cancelled,
            Self::Settings { .. } | Self::ObliqueEnd { .. } | Self::ShortEnd { .. } | Self::ExtensionMeets { .. } => {
                FaultKind::Input
            }
            Self::TooManyCells { .. } | Self::TooManyTriangles { .. } => FaultKind::Limit,
            Self::CapPlane { .. } | Self::PatchIds { .. } => FaultKind::Internal,
            _ => FaultKind::Numeric,
        }
    }
    fn code(&self) -> &'static str {
        match self {
            Self::Cancelled => "cancelled",
            Self::Settings { .. } => "surface.settings",
            Self::NoSeed { .. } => "surface.no_seed",
            Self::TooManyCells { .. } => "surface.too_many_cells",
            Self::LeavesData { .. } => "surface.leaves_data",
            Self::NotFinite { .. } => "surface.not_finite",
            Self::Projection { .. } => "surface.projection",
            Self::Folded { .. } => "surface.folded",
            Self::Defect(_) => "surface.defect",
            Self::GrazingCut { .. } => "surface.grazing_cut",
            Self::NestedRims { .. } => "surface.nested_rims",
            Self::CrossedRim { .. } => "surface.crossed_rim",
            Self::CutRunsOn { .. } => "surface.cut_runs_on",
            Self::NothingLeft { .. } => "surface.nothing_left",
            Self::CapPlane { .. } => "surface.cap_plane",
            Self::TooManyTriangles { .. } => "surface.too_many_triangles",
            Self::ObliqueEnd { .. } => "surface.oblique_end",
            Self::ShortEnd { .. } => "surface.short_end",
            Self::ExtensionMeets { .. } => "surface.extension_meets",
            Self::PatchSolve { .. } => "surface.patch_solve",
            Self::PatchIds { .. } => "surface.patch_ids",
            Self::Patches { .. } => "surface.patches",
        }
    }
    fn place(&self) -> Place {
        match self {
            Self::TooManyCells { at, .. }
            | Self::LeavesData { at, .. }
            | Self::NotFinite { at }
            | Self::GrazingCut { at, .. }
            | Self::NestedRims { at, .. }
            | Self::CrossedRim { at, .. }
            | Self::CutRunsOn { at, .. }
            | Self::NothingLeft { at, .. }
            | Self::CapPlane { at, .. }
            | Self::ObliqueEnd { at, .. }
            | Self::ShortEnd { at, .. }
            | Self::ExtensionMeets { at, .. }
            | Self::Patches { at, .. }
            | Self::TooManyTriangles { at, .. } => Place::at(*at),
            Self::Projection { vertex, at, .. } => Place { element: Some(*vertex), ..Place::at(*at) },
            Self::Folded { face, at } => Place { element: Some(*face), ..Place::at(*at) },
            Self::Defect(d) => Place { element: Some(d.element), ..Place::at(d.at) },
            Self::Settings { field, .. } => Place::field(format!("surface.{field}")),
            _ => Place::none(),
        }
    }
}
