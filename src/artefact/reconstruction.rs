//! Everything that one reconstruction has to tell, gathered for the writers.
//!
//! The domain crates hand over their own types (contours, mesh, medial graph, morphometry); the facts of their reports
//! that go into result.json are plain structs here, filled in by `pipeline`. Lengths are mm in the patient frame (DICOM
//! LPS), angles degrees. Nothing here knows a time, a host or a path: those are in
//! [`Provenance`](crate::write::Provenance) alone, so that every artefact made from a `Reconstruction` is the same to
//! the byte from run to run.

use crate::plan::Variant;
use imaging::Contours;
use morphometry::{Junction, Morphometry, Role};
use skeleton::MedialGraph;
use space::{P3, V3, Warning};
use surface::TriMesh;

/// One finished reconstruction.
#[derive(Clone, Debug)]
pub struct Reconstruction<'a> {
    /// The scan as it was read.
    pub input: InputFacts,
    /// How the lumen was found.
    pub segmentation: SegmentationFacts,
    /// The planar curves.
    pub contours: &'a Contours,
    /// The variational fit.
    pub implicit: ImplicitFacts,
    /// The smoothed, capped surface.
    pub surface: SurfaceData<'a>,
    /// Medial lines.
    pub graph: &'a MedialGraph,
    /// Measures of branches and junctions.
    pub morphometry: &'a Morphometry,
    /// Warnings of all stages in order, those of `morphometry` not included (the writers append them).
    pub warnings: &'a [Warning],
    /// Up to three grey slices with the contours on them, for the report.
    pub pictures: Vec<SlicePicture>,
    /// What was changed, where this is a re-synthesis and no scan.
    pub variant: Option<Variant>,
    /// All grey planes for viewers, where there are any.
    pub atlas: Option<crate::write::Atlas>,
}

impl Reconstruction<'_> {
    /// All warnings: those of the stages, then those of the morphometry, each once.
    pub fn all_warnings(&self) -> Vec<&Warning> {
        let mut all: Vec<&Warning> = Vec::new();
        for w in self.warnings.iter().chain(&self.morphometry.warnings) {
            if !all.contains(&w) {
                all.push(w);
            }
        }
        all
    }
    /// The junction that the pictures face and the report puts first: a measured one before others, then the one whose
    /// thinnest branch is widest (an aortic bifurcation before the origin of a renal artery), then by node.
    pub fn main_junction(&self) -> Option<&Junction> {
        let width = |id: &usize| {
            let branch = self.morphometry.branches.iter().find(|b| b.id == *id);
            branch.and_then(|b| b.diameter_mm).unwrap_or(0.0)
        };
        let thinnest = |j: &Junction| j.branches.iter().map(width).fold(f64::INFINITY, f64::min);
        let measured = |j: &Junction| j.angles.iter().any(|a| a.value_deg.is_some());
        self.morphometry.junctions.iter().min_by(|a, b| {
            measured(b).cmp(&measured(a)).then(thinnest(b).total_cmp(&thinnest(a))).then(a.node.cmp(&b.node))
        })
    }
    /// The role of the branch that was measured on a graph edge, where there is one.
    pub fn role_of_edge(&self, edge: usize) -> Option<Role> {
        self.morphometry.branches.iter().find(|b| b.id == edge).map(|b| b.role)
    }
}

/// The scan as it was read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct InputFacts {
    /// Slices read.
    pub slices: usize,
    /// Slice numbers that the regular spacing leads one to expect and that are not there.
    pub missing_slices: Vec<usize>,
    /// [row step, column step, median slice step], mm.
    pub spacing_mm: [f64; 3],
    /// `sha256:` and the hexadecimal digest of the pixels and their geometry.
    pub digest: String,
}

/// How the lumen was found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SegmentationFacts {
    /// Grey level of the wall (the median, where it is local).
    pub threshold: Option<f64>,
    /// Point spread, Gaussian sigma in pixels.
    pub psf_sigma_px: Option<f64>,
    /// Number of contours.
    pub contours: usize,
    /// [plane number along the contour axis, lumens in it].
    pub lumens: Vec<[usize; 2]>,
    /// `slice`, `row` or `column`.
    pub axis: String,
    /// Bright components that were weighed against each other, best first.
    pub candidates: Vec<Candidate>,
}

/// A bright component that might have been the wanted vessel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Its score, larger is better.
    pub score: f64,
    /// Whether it was reconstructed.
    pub chosen: bool,
}

/// The variational fit.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImplicitFacts {
    /// Number of constraints (wall and interior).
    pub constraints: usize,
    /// Smoothing weight lambda.
    pub smoothing: f64,
    /// Largest |f| at the wall constraints, mm.
    pub residual_max_mm: f64,
    /// Root mean square of f at the wall constraints, mm.
    pub residual_rms_mm: f64,
    /// Estimated condition number of the system, where it was estimated.
    pub condition: Option<f64>,
    /// Smallest and largest distance of the interior constraints from the wall, mm.
    pub offset_mm: [f64; 2],
}

/// The smoothed, capped surface with what is known of it.
#[derive(Clone, Debug)]
pub struct SurfaceData<'a> {
    /// The mesh.
    pub mesh: &'a TriMesh,
    /// Quality.
    pub quality: SurfaceFacts,
    /// Signed displacement of each vertex by the smoothing, mm, outward positive; empty when nothing was smoothed.
    pub displacement_mm: &'a [f64],
    /// The same in pixels; empty when nothing was smoothed.
    pub displacement_px: &'a [f64],
    /// Division of the wall into patches, where it was made.
    pub patches: Option<Patches<'a>>,
    /// The wall as quadrilaterals.
    pub quads: Quadrilaterals<'a>,
}

/// The wall as quadrilaterals of high order.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Quadrilaterals<'a> {
    /// Not asked for.
    #[default]
    Unasked,
    /// Asked for, and there is no such division: a warning says why.
    Impossible,
    /// Made.
    Made(&'a surface::Quads),
}

/// Quality of the surface. Counts of vertices and triangles, area and volume of the mesh are taken from the mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfaceFacts {
    /// Smallest triangle angle, degrees.
    pub min_angle_deg: f64,
    /// Largest triangle angle, degrees.
    pub max_angle_deg: f64,
    /// Every edge has exactly two triangles, consistently oriented.
    pub watertight: bool,
    /// Vertices - edges + triangles.
    pub euler: i64,
    /// Connected pieces.
    pub components: usize,
    /// Largest measured distance between triangles and the zero set, mm.
    pub max_error_mm: f64,
    /// Area, mm2.
    pub area_mm2: f64,
    /// Enclosed volume, mm3.
    pub volume_mm3: f64,
    /// Displacement by smoothing over all wall vertices, pixels.
    pub displacement_px: Range,
    /// The same in mm.
    pub displacement_mm: Range,
    /// Shapes, distances, and what the smoothing did.
    pub report: QualityFacts,
    /// The plane ends.
    pub caps: Vec<CapFacts>,
}

/// What the quality report says beyond [`SurfaceFacts`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct QualityFacts {
    /// Shapes of triangles and distances from f = 0.
    pub mesh: surface::Quality,
    /// Hausdorff distance between the smoothed wall and the unsmoothed one, both ways, mm.
    pub hausdorff_mm: f64,
    /// Change of the enclosed volume by the smoothing, part of it (first order in the displacement).
    pub volume_change: f64,
}

/// Extent of a signed quantity.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Range {
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Root mean square.
    pub rms: f64,
}

/// A plane end of the surface.
#[derive(Clone, Debug, PartialEq)]
pub struct CapFacts {
    /// Face id in the mesh, 1 or more.
    pub face_id: u32,
    /// Name by the branch that ends there, such as `end_distal`.
    pub name: String,
    /// Name for flow solvers: `inlet`, or `inlet_1` and so on where there are several, and `outlet_1` and so on.
    pub boundary: String,
    /// Centre of area.
    pub centroid: P3,
    /// Unit normal out of the lumen.
    pub normal: V3,
    /// Area, mm2.
    pub area_mm2: f64,
    /// Angle between the normal and the medial line that ends there, degrees; none where no line ends.
    pub oblique_deg: Option<f64>,
    /// Length of medial line between the end of the data and the cap, mm: 0 where the cap lies in the data's own end.
    pub set_back_mm: Option<f64>,
}

/// Patches of the wall with their surface coordinates.
#[derive(Clone, Copy, Debug)]
pub struct Patches<'a> {
    /// Patch number of each triangle.
    pub patch_id: &'a [u32],
    /// Circumferential coordinate of each vertex.
    pub u: &'a [f64],
    /// Longitudinal coordinate of each vertex.
    pub v: &'a [f64],
}

/// A grey slice with the contours on it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SlicePicture {
    /// Such as `slice 14, z = 21.0 mm`.
    pub title: String,
    /// Pixels per row.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
    /// Height over width of one pixel (1 when square).
    pub pixel_aspect: f64,
    /// Grey values, row by row.
    pub pixels: Vec<u8>,
    /// Closed contours as [column, row], (0, 0) being the centre of the first pixel.
    pub polylines: Vec<Vec<[f64; 2]>>,
}
