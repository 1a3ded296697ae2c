//! plan.json: what the user may ask for (contract.md). Every field is optional; `null` is as if absent.
//!
//! [`Plan::parse`] reports every fault at once, each with its dotted path, so that a plan is mended in one go. Ranges are
//! checked here and not in the stages: a plan that parses is a plan that can be run.

mod check;
mod convert;
#[cfg(test)]
mod tests;
mod variant;

pub use check::{PlanFault, PlanFaults, ROLES};

use serde::{Deserialize, Serialize};

/// The whole plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Plan {
    /// Geometry for images that carry none.
    pub geometry: Geometry,
    /// Which of several DICOM series is meant: its SeriesNumber or SeriesInstanceUID.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub series: Option<String>,
    /// Segmentation overrides.
    pub segmentation: Segmentation,
    /// Contour settings.
    pub contours: Contours,
    /// Who is who at the junction.
    pub roles: Roles,
    /// Bounded smoothing.
    pub smoothing: Smoothing,
    /// Surface mesh.
    pub surface: Surface,
    /// Ends of the vessels.
    pub ends: Ends,
    /// Angles.
    pub morphometry: Morphometry,
    /// What to make: `surface`, `skeleton`, `volume`, and beyond them `graphml`, `swc`, `patches`. Empty or absent: surface
    /// and skeleton.
    pub outputs: Vec<String>,
    /// A re-synthesis: the input is then the sections.json of a finished reconstruction.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub variant: Option<Variant>,
}

/// A vessel tree with changed medial lines.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Variant {
    /// What is changed, one after the other; nothing: the tree as it was measured.
    pub changes: Vec<VariantChange>,
}

/// What is changed of one branch: exactly one of `angle_deg`, `curvature_factor`, `curvature_per_mm`, `straight`, `planar`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VariantChange {
    /// The branch.
    pub branch: Branch,
    /// Wanted angle against `to`, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub angle_deg: Option<f64>,
    /// The branch that the angle is measured against; for the graft the proximal one where it is not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub to: Option<Branch>,
    /// Factor on every bend.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub curvature_factor: Option<f64>,
    /// Constant curvature.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub curvature_per_mm: Option<f64>,
    /// Constant torsion with it, positive right-handed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub torsion_per_mm: Option<f64>,
    /// Straightened.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub straight: Option<bool>,
    /// Pressed into the junction's plane.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planar: Option<bool>,
}

/// A branch, by its number or its role.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Branch {
    /// Number in result.json.
    Id(usize),
    /// `graft`, `proximal`, `distal`, `host_a` or `host_b`.
    Role(String),
}

/// Geometry of images that carry none, LPS mm.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Geometry {
    /// [row step, column step], mm.
    pub pixel_spacing_mm: Option<[f64; 2]>,
    /// Distance between neighbouring slices, mm.
    pub slice_spacing_mm: Option<f64>,
    /// Position of each slice along the normal, mm, instead of a constant spacing.
    pub slice_positions_mm: Option<Vec<f64>>,
    /// Centre of the first pixel of the first slice.
    pub origin_mm: Option<[f64; 3]>,
    /// Direction in which the column index grows.
    pub row_direction: Option<[f64; 3]>,
    /// Direction in which the row index grows.
    pub column_direction: Option<[f64; 3]>,
}

/// Overrides of the automatic segmentation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Segmentation {
    /// Grey level of the wall.
    pub threshold: Option<f64>,
    /// A circle that marks the vessel on one slice.
    pub region: Option<Region>,
    /// Points inside the vessel.
    pub seeds_mm: Vec<[f64; 3]>,
    /// Slices to leave out.
    pub exclude_slices: Vec<usize>,
    /// Point spread, Gaussian sigma in pixels.
    pub psf_sigma_px: Option<f64>,
    /// Which label (DICOM: segment number) of a mask in the upload is the lumen; absent: its only one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<u16>,
}

/// A circle on a slice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// Slice number.
    pub slice: usize,
    /// [column, row].
    pub centre_px: [f64; 2],
    /// Radius in pixels.
    pub radius_px: f64,
}

/// Contour settings.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Contours {
    /// `auto`, `slice`, `row` or `column`.
    pub axis: Option<String>,
}

/// Points in or near the branches, LPS mm.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Roles {
    /// Graft.
    pub graft_mm: Option<[f64; 3]>,
    /// Proximal host.
    pub proximal_mm: Option<[f64; 3]>,
    /// Distal host.
    pub distal_mm: Option<[f64; 3]>,
    /// Where the host's flow comes from.
    pub flow_from_mm: Option<[f64; 3]>,
}

/// Bounded smoothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Smoothing {
    /// Largest displacement of the wall in pixels; 0 switches smoothing off.
    pub max_displacement_px: f64,
}
impl Default for Smoothing {
    fn default() -> Self {
        Self { max_displacement_px: 1.0 }
    }
}

/// Surface mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Surface {
    /// Wanted distance between triangles and wall, mm.
    pub max_error_mm: f64,
    /// Shortest and longest edge, mm.
    pub edge_mm: [f64; 2],
}
impl Default for Surface {
    fn default() -> Self {
        Self { max_error_mm: 0.02, edge_mm: [0.15, 1.0] }
    }
}

/// Ends of the vessels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Ends {
    /// Length of the flow extensions in diameters.
    pub extension_diameters: f64,
    /// Where to cut, LPS mm.
    pub cut_mm: Vec<[f64; 3]>,
}
impl Default for Ends {
    fn default() -> Self {
        Self { extension_diameters: 4.0, cut_mm: Vec::new() }
    }
}

/// Angles.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Morphometry {
    /// Start of the fit window in graft diameters; null: from the crotch.
    pub fit_from_diameters: Option<f64>,
    /// End of the fit window in graft diameters.
    pub fit_to_diameters: f64,
}
impl Default for Morphometry {
    fn default() -> Self {
        Self { fit_from_diameters: None, fit_to_diameters: 4.0 }
    }
}
