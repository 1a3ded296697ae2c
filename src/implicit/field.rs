//! What the rest of the program knows of an implicit function.

use exec::{Cancelled, Ctx};
use space::{Aabb, DMat3, P3, Patient, V3};

/// Points of a parallel task of [`Field::values_of_many`].
const POINTS_PER_TASK: usize = 256;

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
    /// Values at many points, in parallel, in order: for lattices and clouds of 10^3 points and more. Fields that know how
    /// share work between near points; the value of a point may then differ from [`Field::value`] by 1e-7 mm (docs/adr/0023).
    ///
    /// # Errors
    /// [`Cancelled`].
    fn values_of_many(&self, xs: &[P3], ctx: &Ctx) -> Result<Vec<f64>, Cancelled> {
        let mut out = vec![0.0; xs.len()];
        ctx.chunks_mut(&mut out, POINTS_PER_TASK, |first, chunk| self.values(&xs[first..first + chunk.len()], chunk))?;
        Ok(out)
    }
    /// Everything that its values depend on, for [`Ctx::recalled`]; `None` where values are too cheap to be kept.
    fn numbers(&self) -> Option<Vec<f64>> {
        None
    }
    /// A box outside which f is negative or has no meaning.
    fn bounds(&self) -> Aabb<Patient>;
}

/// The point of f = 0 reached from `x` by Newton steps along the gradient, at most `reach_mm` away; `None` where the
/// steps do not arrive (no wall within reach, or a vanishing gradient).
pub fn foot(field: &dyn Field, x: P3, reach_mm: f64) -> Option<P3> {
    const STEPS: usize = 30;
    const TOLERANCE_MM: f64 = 1e-10;
    let mut p = x;
    for _ in 0..STEPS {
        let (f, g) = field.gradient(p);
        let slope2 = g.length_squared();
        if !f.is_finite() || slope2 < 1e-12 {
            return None;
        }
        // half the reach at most per step: the gradient far from the wall says little
        let step = -f / slope2;
        let length = step.abs() * slope2.sqrt();
        let damp = if length > 0.5 * reach_mm { 0.5 * reach_mm / length } else { 1.0 };
        p += g * (step * damp);
        if p.distance(x) > reach_mm {
            return None;
        }
        if length < TOLERANCE_MM {
            return Some(p);
        }
    }
    None
}
