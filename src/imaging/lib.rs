//! Pixels to planar curves: the stack, the automatic threshold and choice of the vessel, contours, smoothing splines.

mod curve;
mod settings;
mod spline;
mod stack;

pub use curve::{Axis, Contours, Curve, CurvePoint, CutPlane, Plane, Tip};
pub use settings::{Region, Settings};
pub use spline::PeriodicSpline;
pub use stack::Stack;
