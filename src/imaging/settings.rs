//! What the user may set of the segmentation and the contours.

use crate::{Axis, Mask};
use space::P3;

/// Settings of [`crate::contours`]; the defaults are fully automatic.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Global grey level of the wall instead of the automatic local half-maximum.
    pub threshold: Option<f64>,
    /// A circle on one slice that marks the vessel.
    pub region: Option<Region>,
    /// Points inside the wanted lumen.
    pub seeds: Vec<P3>,
    /// Slices to leave out, counted along the stack's normal. They become gaps.
    pub exclude_slices: Vec<usize>,
    /// Point spread (Gaussian sigma) in pixels instead of the estimate.
    pub psf_sigma_px: Option<f64>,
    /// A lumen that is already drawn, instead of the search for one: region and seeds then mean nothing.
    pub mask: Option<Mask>,
    /// Contour axis; `None` chooses the axis that the vessel follows.
    pub axis: Option<Axis>,
}

/// A circle on a slice: the wanted lumen lies inside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Slice number along the stack's normal.
    pub slice: usize,
    /// Centre as [column, row] in pixels, (0, 0) being the centre of the first pixel.
    pub centre_px: [f64; 2],
    /// Radius in pixels.
    pub radius_px: f64,
}
