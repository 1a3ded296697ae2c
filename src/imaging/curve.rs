//! The outcome of imaging: planar smooth closed curves in patient space, with what is known about their ends.

use crate::Blur;
use crate::spline::PeriodicSpline;
use space::{P3, V3};

/// The axis of the volume across which contours are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Axis {
    /// One plane per slice.
    Slice,
    /// One plane per row index: planes at a right angle to `column_direction`.
    Row,
    /// One plane per column index: planes at a right angle to `row_direction`.
    Column,
}

/// A plane in which contours are drawn, with the lattice of sample positions in it (steps may vary across missing
/// slices and need not be square).
#[derive(Clone, Debug)]
pub struct Plane {
    /// Index along the contour axis: the slice, row or column number.
    pub index: usize,
    /// Sample (0, 0).
    pub origin: P3,
    /// In-plane unit vectors, at right angles; normal = u x v, planes ascend along it.
    pub u: V3,
    /// See `u`.
    pub v: V3,
    /// Offsets of the sample columns along `u`, mm, ascending from 0.
    pub u_mm: Vec<f64>,
    /// Offsets of the sample rows along `v`, mm, ascending from 0.
    pub v_mm: Vec<f64>,
}

impl Plane {
    /// Unit normal.
    pub fn normal(&self) -> V3 {
        self.u.cross(self.v)
    }
    /// In-plane (u, v) in mm to the patient.
    pub fn to_patient(&self, uv: [f64; 2]) -> P3 {
        self.origin + self.u * uv[0] + self.v * uv[1]
    }
    /// The foot of a patient point in this plane's (u, v), mm.
    pub fn in_plane(&self, p: P3) -> [f64; 2] {
        let d = p - self.origin;
        [d.dot(self.u), d.dot(self.v)]
    }
}

/// One closed smooth contour of the lumen in one plane.
#[derive(Clone, Debug)]
pub struct Curve {
    /// Index into [`Contours::planes`].
    pub plane: usize,
    /// Number of the contour within its plane.
    pub lumen: usize,
    /// The curve in the plane's (u, v) mm. Lumen on the left of the direction of travel (counterclockwise about the
    /// plane's normal for an outer boundary, clockwise for a hole).
    pub spline: PeriodicSpline,
    /// The marching-squares polyline behind the spline, (u, v) mm.
    pub raw: Vec<[f64; 2]>,
    /// Grey level at which it was drawn (mean, where the level varies).
    pub level: f64,
    /// Standard error of the curve's position along its normal, mm.
    pub standard_error_mm: f64,
    /// Standard error of the position by the level that it was drawn at, mm: noise in the local value of the surroundings,
    /// and tissue that is brighter or darker beside the wall than that. Neighbouring curves share it ([`Contours::LEVEL_MM`]).
    pub level_error_mm: f64,
    /// Effective degrees of freedom of the smoothing spline: over as many terms, from size and place on, the standard error is
    /// spread.
    pub freedom: f64,
    /// Parameter intervals (start, end in arc length, mm, possibly wrapping) that follow the image border and not the
    /// wall: no wall constraint may be taken there.
    pub border: Vec<[f64; 2]>,
    /// Whether it bounds a hole (tissue inside lumen).
    pub hole: bool,
}

/// A point of a curve with what the implicit fit needs to know of it.
#[derive(Clone, Copy, Debug)]
pub struct CurvePoint {
    /// On the curve.
    pub position: P3,
    /// Unit vector in the plane, into the lumen.
    pub inward: V3,
    /// In-plane curvature, 1/mm, positive where the lumen is convex.
    pub curvature_per_mm: f64,
    /// Whether the point follows the image border instead of the wall.
    pub on_border: bool,
    /// Standard error along the normal, mm.
    pub standard_error_mm: f64,
}

/// The data end here: what lies on the `outward` side of the plane within `reach_mm` of `point` is outside. The surface is
/// cut here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CutPlane {
    /// A point of the plane.
    pub point: P3,
    /// Unit normal away from the data.
    pub outward: V3,
    /// Infinite where a scan ends; finite for a cut across one vessel of a tree, which leaves the others whole. The lumen
    /// past such a plane must close within the ball.
    pub reach_mm: f64,
}

impl CutPlane {
    /// Everything on the `outward` side is outside.
    pub fn new(point: P3, outward: V3) -> Self {
        Self { point, outward, reach_mm: f64::INFINITY }
    }

    /// A cut across one vessel: only what lies within `reach_mm` of `point` is cut.
    pub fn within(self, reach_mm: f64) -> Self {
        Self { reach_mm, ..self }
    }

    /// Height over the plane, mm, positive outside; minus infinity out of its reach.
    pub fn height(&self, x: P3) -> f64 {
        let from = x - self.point;
        if self.reaches(x) { from.dot(self.outward) } else { f64::NEG_INFINITY }
    }

    /// Whether a point lies past the cut.
    pub fn excludes(&self, x: P3) -> bool {
        self.height(x) > 0.0
    }

    /// Where a ray of unit direction from a point that is not past the cut passes it, mm; 0 from a point that is past.
    pub fn passed_at(&self, from: P3, direction: V3) -> Option<f64> {
        if self.excludes(from) {
            return Some(0.0);
        }
        let speed = direction.dot(self.outward);
        let t = (self.point - from).dot(self.outward) / speed;
        (speed > 0.0 && t >= 0.0 && self.reaches(from + direction * t)).then_some(t)
    }

    fn reaches(&self, x: P3) -> bool {
        self.reach_mm == f64::INFINITY || x.distance(self.point) <= self.reach_mm
    }
}

/// A lumen that ends between two planes inside the volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tip {
    /// Last plane that shows the lumen.
    pub plane: usize,
    /// Its contour number there.
    pub lumen: usize,
    /// Where the wall closes: between the last plane and the next, interpolated on the grey values.
    pub position: P3,
    /// Unit vector out of the lumen there (along the plane normal, away from the last plane).
    pub outward: V3,
}

/// All contours of the chosen vessel tree.
#[derive(Clone, Debug)]
pub struct Contours {
    /// The axis across which they were drawn.
    pub axis: Axis,
    /// The planes, ascending, those without contours included.
    pub planes: Vec<Plane>,
    /// The curves, by plane and then by number.
    pub curves: Vec<Curve>,
    /// Planes at which the data end and that the lumen reaches: first or last contour plane, image borders. Together
    /// they bound a convex box.
    pub cuts: Vec<CutPlane>,
    /// Lumens that end inside the volume.
    pub tips: Vec<Tip>,
    /// Pixel size that displacements are quoted in, mm: the geometric mean of the in-plane steps of the acquisition.
    pub pixel_mm: f64,
    /// Slice thickness of the acquisition where known.
    pub thickness_mm: Option<f64>,
    /// The blur by which the curves were corrected in their planes; `None`: they are as drawn.
    pub blur: Option<Blur>,
}

impl Contours {
    /// Distance over which curves share the error of their level, mm: the width of the Gaussian in which the surroundings
    /// are taken, times the root of two as for the difference of two of them.
    pub const LEVEL_MM: f64 = 2.8;
}

impl Curve {
    /// Length of the curve, mm.
    pub fn length_mm(&self) -> f64 {
        self.spline.length()
    }
    /// The curve's point at arc length `s`, mm (taken modulo the length).
    pub fn at(&self, plane: &Plane, s: f64) -> CurvePoint {
        let length = self.spline.length();
        let s = s.rem_euclid(length);
        let [position, first, second] = self.spline.derivatives(s);
        let speed = first[0].hypot(first[1]).max(f64::MIN_POSITIVE);
        let on_border = self.border.iter().any(|&[a, b]| (s - a).rem_euclid(length) <= (b - a).rem_euclid(length));
        CurvePoint {
            position: plane.to_patient(position),
            inward: plane.u * (-first[1] / speed) + plane.v * (first[0] / speed),
            curvature_per_mm: (first[0] * second[1] - first[1] * second[0]) / speed.powi(3),
            on_border,
            standard_error_mm: self.standard_error_mm,
        }
    }
}
