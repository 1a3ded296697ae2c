//! The blur of an acquisition and where the half-maximum level of a blurred wall lies.
//!
//! Within the slices the point spread and the pixel, across them the slice thickness: variances along the stack's axes,
//! Sigma = diag(sigma^2 + step^2/12, sigma^2 + step^2/12, thickness^2/12). With d the signed distance (positive inside)
//! and n its normal, the half-maximum level lies 1/2 tr(Hess(d) C) inside the wall, C = Sigma - Sigma n n' Sigma/(n' Sigma
//! n): the blur that is left once the step along n is given. Plain Sigma instead of C overshoots. In a plane of contours
//! this is kappa/2 det(Sigma)/(n' Sigma n), which is kappa/2 (sigma^2 + px^2/12) for square pixels: exact for a vessel at
//! a right angle to the plane. [`crate::contours()`] applies the planar form; the implicit fit puts the spatial one in its
//! place, because an oblique vessel in slices of 3 mm loses 1 to 2 % of its area that no planar form gives back.
//! Where the thickness is not known the distance of the slices is taken for it, with a warning: slices without gap or
//! overlap are the rule, and a scan must not change when it comes as NIfTI, which does not carry the thickness.

use crate::smooth::normal_cdf;
use crate::{CurvePoint, Plane, Stack};
use space::{DMat3, P3, V3};

/// Blur variances along the axes of a stack, mm^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blur {
    /// Row direction, column direction and normal of the stack.
    pub axes: [V3; 3],
    /// Variances along the row and the column direction, mm^2.
    pub in_slice_mm2: [f64; 2],
    /// Variance along the normal, mm^2; `None`: no blur along it.
    pub through_mm2: Option<f64>,
}

impl Blur {
    /// Of a stack with a Gaussian point spread of `sigma_mm`.
    pub(crate) fn of(stack: &Stack, sigma_mm: f64) -> Self {
        let [row_step, column_step] = stack.pixel_spacing_mm;
        Self {
            axes: [stack.row_direction, stack.column_direction, stack.normal()],
            in_slice_mm2: [column_step, row_step].map(|step| sigma_mm.powi(2) + step * step / 12.0),
            through_mm2: Some(stack.thickness_mm.unwrap_or(stack.slice_spacing_mm()).powi(2) / 12.0),
        }
    }

    /// Standard deviation of the blur along its widest axis, mm.
    pub fn reach_mm(&self) -> f64 {
        self.variances().into_iter().fold(0.0, f64::max).sqrt()
    }

    fn variances(&self) -> [f64; 3] {
        [self.in_slice_mm2[0], self.in_slice_mm2[1], self.through_mm2.unwrap_or(0.0)]
    }

    /// Sigma v.
    fn spread(&self, v: V3) -> V3 {
        let parts = self.axes.iter().zip(self.variances()).map(|(a, s)| *a * (s * v.dot(*a)));
        parts.fold(V3::new(0.0, 0.0, 0.0), |sum, p| sum + p)
    }

    /// Variances along a plane's u and v, mm^2.
    pub(crate) fn in_plane(&self, plane: &Plane) -> [f64; 2] {
        [plane.u, plane.v].map(|d| d.dot(self.spread(d)))
    }

    /// How far the planar form has moved a point of a corrected curve outward, mm.
    pub fn planar_shift_mm(&self, plane: &Plane, point: &CurvePoint) -> f64 {
        let normal = [-point.inward.dot(plane.u), -point.inward.dot(plane.v)];
        half_maximum_shift(point.curvature_per_mm, normal, self.in_plane(plane))
    }
}

/// Pieces of the slice's box profile, across each of which a function's values are taken for linear.
const PIECES: usize = 6;

impl Blur {
    /// Which level set of a function f (0 on the wall, positive inside) has the half-maximum of its blurred image at `x`:
    /// the median of f under the blur, by exact integrals over pieces of the slice's box, and within the slice by the cumulants
    /// that f's second derivatives give it. `None` where f is flat.
    ///
    /// Its expansion to second order, -1/2 tr(Hess C) with C as above, fails where the slice is as thick as the vessel
    /// (docs/adr/0032). A rule of points in place of the integrals leaves steps in the share where the wall lies in the slice, and
    /// with medians in place of skewed distributions such a wall got a third of its correction.
    pub fn half_maximum_level(&self, x: P3, f: impl Fn(P3) -> (f64, V3, DMat3)) -> Option<f64> {
        let half = (3.0 * self.through_mm2.unwrap_or(0.0)).sqrt();
        let step = 2.0 * half / PIECES as f64;
        let at = |k: usize| self.in_slice(f(x + self.axes[2] * (step * k as f64 - half)));
        let ends: Vec<InSlice> = if half > 0.0 { (0..=PIECES).map(at).collect() } else { vec![at(0), at(0)] };
        let pieces: Vec<[InSlice; 2]> = ends.windows(2).map(|p| between(p[0], p[1], step)).collect();
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for end in pieces.as_flattened() {
            low = low.min(end.mean - 4.0 * end.deviation);
            high = high.max(end.mean + 4.0 * end.deviation);
        }
        if !(low.is_finite() && high.is_finite() && high > low) {
            return None;
        }
        let share = |c: f64| pieces.iter().map(|p| share_above(c, p)).sum::<f64>() / pieces.len() as f64;
        for _ in 0..45 {
            let middle = 0.5 * (low + high);
            if share(middle) > 0.5 { low = middle } else { high = middle }
        }
        Some(0.5 * (low + high))
    }

    /// Cumulants of a function under the blur within the slice, from its value and derivatives (those of a quadratic form).
    fn in_slice(&self, (value, gradient, hessian): (f64, V3, DMat3)) -> InSlice {
        let [u, v, n] = self.axes;
        let [a, b] = self.in_slice_mm2;
        let bend = |p: V3, q: V3| p.dot(V3::from((hessian * q.raw()).to_array()));
        let (uu, uv, vv) = (bend(u, u), bend(u, v), bend(v, v));
        // p'Sigma p, p'Sigma H Sigma p, traces of (Sigma H)^k for the two axes of the slice
        let (gu, gv) = (a * gradient.dot(u), b * gradient.dot(v));
        let slope = gu * gradient.dot(u) + gv * gradient.dot(v);
        let along = gu * gu * uu + 2.0 * gu * gv * uv + gv * gv * vv;
        let trace = a * uu + b * vv;
        let square = a * a * uu * uu + 2.0 * a * b * uv * uv + b * b * vv * vv;
        let determinant = a * b * (uu * vv - uv * uv);
        let cube = trace * (square - determinant);
        let variance = (slope + 0.5 * square).max(1e-12 * (a + b));
        InSlice {
            mean: value + 0.5 * trace,
            deviation: variance.sqrt(),
            skewness: (3.0 * along + cube) / variance.powf(1.5),
            bend: bend(n, n),
        }
    }
}

/// A function's distribution under the blur within the slice.
#[derive(Clone, Copy)]
struct InSlice {
    mean: f64,
    deviation: f64,
    skewness: f64,
    /// Second derivative across the slice, 1/mm.
    bend: f64,
}

/// The ends of a piece of the box `step` mm long: one deviation and skewness, and means whose straight line has the mean of the bent one.
fn between(p: InSlice, q: InSlice, step: f64) -> [InSlice; 2] {
    let middle = |of: fn(&InSlice) -> f64| 0.5 * (of(&p) + of(&q));
    let bulge = middle(|e| e.bend) * step * step / 12.0;
    let (deviation, skewness) = (middle(|e| e.deviation), middle(|e| e.skewness));
    [p, q].map(|e| InSlice { mean: e.mean - bulge, deviation, skewness, ..e })
}

/// Share of a piece in which the function lies above `c`: a normal distribution with Edgeworth's first term, integrated along the
/// piece. Across a wall that is steep within the slice the skewness takes away the function's bend along its own gradient, which moves no
/// level set; along a wall that lies in the slice the piece is longer than the distribution is wide, and only its mean counts.
fn share_above(c: f64, piece: &[InSlice; 2]) -> f64 {
    /// Below this length in deviations the middle stands for the piece.
    const SHORT: f64 = 0.05;
    let [z, w] = piece.map(|e| (e.mean - c) / e.deviation);
    let skew = piece[0].skewness / 6.0;
    let density = |z: f64| (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
    if (w - z).abs() < SHORT {
        let z = 0.5 * (z + w);
        return normal_cdf(z) + skew * (z * z - 1.0) * density(z);
    }
    let integral = |z: f64| z * normal_cdf(z) + density(z) * (1.0 - skew * z);
    (integral(w) - integral(z)) / (w - z)
}

/// The planar form: outward shift for curvature `kappa`, unit normal and blur variances in the plane.
pub(crate) fn half_maximum_shift(kappa: f64, normal: [f64; 2], variance: [f64; 2]) -> f64 {
    let along = variance[0] * normal[0] * normal[0] + variance[1] * normal[1] * normal[1];
    let across = variance[0] * variance[1] / along.max(f64::MIN_POSITIVE);
    // the expansion holds while the radius of curvature passes the blur
    let limit = 0.5 * across.sqrt();
    (0.5 * kappa * across).clamp(-limit, limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Hessian of the distance to a cylinder's wall (positive inside) at a point with outward normal `n`.
    fn cylinder(axis: V3, n: V3, radius: f64) -> DMat3 {
        let t = axis.cross(n).to_array();
        let entry = |i: usize, j: usize| -t[i] * t[j] / radius;
        DMat3::from_cols_array_2d(&[0, 1, 2].map(|j| [0, 1, 2].map(|i| entry(i, j))))
    }

    fn blur(through: Option<f64>) -> Blur {
        Blur {
            axes: [V3::new(1.0, 0.0, 0.0), V3::new(0.0, 1.0, 0.0), V3::new(0.0, 0.0, 1.0)],
            in_slice_mm2: [0.09, 0.09],
            through_mm2: through,
        }
    }

    /// f = R - distance to the axis, with its derivatives.
    fn tube(axis: V3, radius: f64) -> impl Fn(P3) -> (f64, V3, DMat3) {
        move |x: P3| {
            let from = x - P3::ORIGIN;
            let across = from - axis * from.dot(axis);
            let rho = across.length().max(1e-9);
            let n = across / rho;
            (radius - rho, -n, cylinder(axis, n, 1.0) * rho.recip())
        }
    }

    /// Share of the blur at `x` that falls inside the tube, by brute force. The lattice of samples is sheared by an irrational number, so
    /// that no wall lies along it.
    fn share(blur: &Blur, f: &dyn Fn(P3) -> (f64, V3, DMat3), x: P3, level: f64) -> f64 {
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let (n, half) = (60, (3.0 * blur.through_mm2.unwrap_or(0.0)).sqrt());
        let sigma = blur.in_slice_mm2[0].sqrt();
        let (mut inside, mut all) = (0.0, 0.0);
        for k in 0..n {
            for i in -30..=30 {
                for j in -30..=30 {
                    let shear = |a: i32, b: i32| (f64::from(3 * a + 7 * b) * GOLDEN).rem_euclid(1.0);
                    let (p, q) = ((f64::from(i) + shear(j, k)) / 7.5, (f64::from(j) + shear(k, 0)) / 7.5);
                    let w = half * (2.0 * (f64::from(k) + shear(i, j)) / f64::from(n) - 1.0);
                    let weight = (-0.5 * (p * p + q * q)).exp();
                    let y = x + blur.axes[0] * (p * sigma) + blur.axes[1] * (q * sigma) + blur.axes[2] * w;
                    all += weight;
                    inside += if f(y).0 > level { weight } else { 0.0 };
                }
            }
        }
        inside / all
    }

    #[test]
    fn the_half_maximum_is_where_brute_force_finds_it_however_the_wall_lies_to_the_slices() {
        // slices of .5 to 3 mm; the wall's normal in the slice (0) to across it (90 degrees and 1.57)
        for through in [0.02, 0.19, 0.75] {
            let blur = blur(Some(through));
            for degrees in [0.0_f64, 45.0, 60.0, 80.0, 90.0] {
                let (sin, cos) = degrees.to_radians().sin_cos();
                let (axis, side) = (V3::new(sin, 0.0, cos), V3::new(0.0, 1.0, 0.0));
                let f = tube(axis, 3.0);
                for angle in [0.0_f64, 0.7, 1.2, 1.4, 1.57] {
                    let normal = side * angle.cos() + axis.cross(side) * angle.sin();
                    let x = P3::ORIGIN + normal * 2.9;
                    let level = blur.half_maximum_level(x, &f).unwrap();
                    let [at, above] = [0.0, 0.02].map(|up| share(&blur, &f, x, level + up));
                    let off = (at - 0.5) * 0.02 / (at - above);
                    assert!(off.abs() < 0.004, "{through} {degrees} {angle}: {level} is {off} mm off");
                }
            }
        }
    }
}
