//! Periodic cubic splines in the plane.

/// A closed planar curve, C2, parametrised by arc length (to the accuracy of its knots), mm.
#[derive(Clone, Debug)]
pub struct PeriodicSpline {
    length: f64,
    control: Vec<[f64; 2]>,
}

impl PeriodicSpline {
    /// Length of the curve, mm.
    pub fn length(&self) -> f64 {
        self.length
    }
    /// Position, first and second derivative by the parameter at `s` in [0, length), in mm, 1 and 1/mm.
    pub fn derivatives(&self, s: f64) -> [[f64; 2]; 3] {
        let _ = (s, &self.control);
        [[0.0; 2]; 3]
    }
}
