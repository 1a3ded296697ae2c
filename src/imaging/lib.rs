//! Pixels to planar curves: the stack, the automatic threshold and choice of the vessel, contours, smoothing splines.
//!
//! [`contours()`] is the whole; [`segment()`] its first half. Lumens are brighter than their surroundings.

mod agreement;
mod blur;
mod candidate;
mod contours;
mod curve;
mod draw;
mod error;
mod level;
mod march;
mod mask;
mod region;
mod segment;
mod settings;
mod shape;
mod smooth;
mod spline;
mod stack;
mod track;
#[cfg(test)]
mod trials;
mod volume;

pub use blur::Blur;
pub use contours::{Report, contours};
pub use curve::{Axis, Contours, Curve, CurvePoint, CutPlane, Plane, Tip};
pub use error::Error;
pub use mask::Mask;
pub use segment::{Segmentation, Site, Vessel, segment};
pub use settings::{Region, Settings};
pub use spline::PeriodicSpline;
pub use stack::{Layout, MAX_PIXELS, MAX_SIDE, MIN_SIDE, Slice, Stack};
