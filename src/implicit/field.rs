//! What the rest of the program knows of an implicit function.

use space::{Aabb, DMat3, P3, Patient, V3};

/// A smooth scalar function: 0 on the wall, positive inside the lumen, in mm near the wall. The outward normal is
/// -gradient / |gradient|.
pub trait Field: Sync {
    /// f(x), mm.
    fn value(&self, x: P3) -> f64;
    /// f(x) in mm and its gradient (per mm: unit length near the wall, up to the fit's error).
    fn gradient(&self, x: P3) -> (f64, V3);
    /// f, gradient and the symmetric matrix of second derivatives, 1/mm.
    fn hessian(&self, x: P3) -> (f64, V3, DMat3);
    /// Values at many points on the calling thread; `out` has the length of `xs`.
    fn values(&self, xs: &[P3], out: &mut [f64]) {
        for (o, &x) in out.iter_mut().zip(xs) {
            *o = self.value(x);
        }
    }
    /// A box outside which f is negative or has no meaning.
    fn bounds(&self) -> Aabb<Patient>;
}
