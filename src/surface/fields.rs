// Analytic vessels for tests and benches: f > 0 inside, mm, by hand-written gradients; second derivatives by central
// differences of the gradient.

use implicit::Field;
use space::{Aabb, DMat3, P3, Patient, V3};

/// A field from its value and gradient.
pub(crate) struct Analytic {
    pub(crate) f: Box<dyn Fn(P3) -> (f64, V3) + Sync + Send>,
    pub(crate) bounds: Aabb<Patient>,
}

impl Field for Analytic {
    fn value(&self, x: P3) -> f64 {
        (self.f)(x).0
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        (self.f)(x)
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = (self.f)(x);
        let e = 1e-5;
        let column = |d: V3| (((self.f)(x + d * e).1 - (self.f)(x - d * e).1) / (2.0 * e)).raw();
        let m = DMat3::from_cols(column(V3::X), column(V3::Y), column(V3::Z));
        (f, g, (m + m.transpose()) * 0.5)
    }
    fn bounds(&self) -> Aabb<Patient> {
        self.bounds
    }
}

fn cube(half: f64) -> Aabb<Patient> {
    Aabb { min: P3::new(-half, -half, -half), max: P3::new(half, half, half) }
}

/// A ball.
pub(crate) fn sphere(centre: P3, radius: f64) -> Analytic {
    let f = move |x: P3| {
        let d = x - centre;
        (radius - d.length(), -d.normalised().unwrap_or(V3::X))
    };
    Analytic { f: Box::new(f), bounds: cube(radius + 2.0 + (centre - P3::ORIGIN).length()) }
}

/// A torus about the z axis.
pub(crate) fn torus(ring: f64, tube: f64) -> Analytic {
    let f = move |x: P3| {
        let rho = x.x().hypot(x.y()).max(1e-12);
        let (q, z) = (rho - ring, x.z());
        let l = q.hypot(z).max(1e-12);
        (tube - l, V3::new(-q * x.x() / rho / l, -q * x.y() / rho / l, -z / l))
    };
    Analytic { f: Box::new(f), bounds: cube(ring + tube + 2.0) }
}

/// Distance to a segment from the origin minus a radius (negative inside), with gradient.
pub(crate) fn capsule(x: P3, direction: V3, length: f64, radius: f64) -> (f64, V3) {
    let d = x - P3::ORIGIN;
    let t = d.dot(direction).clamp(0.0, length);
    let q = d - direction * t;
    (q.length() - radius, q.normalised().unwrap_or(V3::X))
}

/// The cubic smooth minimum, smin(a, b, k) = min(a, b) - k h^3 / 6, h = max(k - |a - b|, 0) / k.
pub(crate) fn smin(a: (f64, V3), b: (f64, V3), k: f64) -> (f64, V3) {
    let h = (k - (a.0 - b.0).abs()).max(0.0) / k;
    // d/da of -k h^3 / 6 is +- h^2 / 2, negative for the larger of the two.
    let w = 0.5 * h * h;
    let (lo, hi) = if a.0 < b.0 { (a, b) } else { (b, a) };
    (lo.0 - k * h * h * h / 6.0, lo.1 * (1.0 - w) + hi.1 * w)
}

/// Branches that leave the origin: direction, length, radius; blended in turn with the given smoothing lengths.
pub(crate) fn tree(branches: Vec<(V3, f64, f64)>, blend: Vec<f64>) -> Analytic {
    let f = move |x: P3| {
        let mut all = branches.iter().map(|&(d, l, r)| capsule(x, d, l, r));
        let first = all.next().unwrap_or((1.0, V3::X));
        let d = all.zip(&blend).fold(first, |s, (c, &k)| smin(s, c, k));
        (-d.0, -d.1)
    };
    Analytic { f: Box::new(f), bounds: cube(32.0) }
}

/// The benchmark anastomosis-45: host radius 3, graft 3.5 at 45 degrees to the proximal vessel, distal 10 degrees out
/// of their plane, capsules of 24 mm.
pub(crate) fn anastomosis() -> Analytic {
    let (s, c) = 45_f64.to_radians().sin_cos();
    let (s10, c10) = 10_f64.to_radians().sin_cos();
    let branches = vec![
        (V3::new(0.0, 0.0, 1.0), 24.0, 3.0),
        (V3::new(0.0, s10, -c10), 24.0, 3.0),
        (V3::new(s, 0.0, c), 24.0, 3.5),
    ];
    tree(branches, vec![1.5, 3.0])
}

/// Its wall points nearest to hand: the tips of the three capsules.
pub(crate) fn tips() -> Vec<P3> {
    vec![P3::new(0.0, 0.0, 27.0)]
}
