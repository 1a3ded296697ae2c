//! Closed-form fields for tests.

use crate::Field;
use space::{Aabb, DMat3, DVec3, P3, Patient, V3};

/// The infinite cylinder around z.
pub(crate) struct Cylinder {
    pub(crate) radius: f64,
}

impl Cylinder {
    pub(crate) fn wall(&self, half_length: f64) -> Vec<P3> {
        wall(half_length, |_, _| self.radius)
    }
}

fn wall(half_length: f64, radius: impl Fn(f64, f64) -> f64) -> Vec<P3> {
    let mut out = Vec::new();
    for k in -40..=40 {
        for i in 0..64 {
            let (z, a) = (k as f64 * half_length / 40.0, i as f64 * std::f64::consts::TAU / 64.0);
            let r = radius(a, z);
            out.push(P3::new(r * a.cos(), r * a.sin(), z));
        }
    }
    out
}

impl Field for Cylinder {
    fn value(&self, x: P3) -> f64 {
        self.radius - x.x().hypot(x.y())
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let r = x.x().hypot(x.y());
        (self.radius - r, V3::new(-x.x() / r, -x.y() / r, 0.0))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        let r = self.radius - f;
        let t = DVec3::new(-g.y(), g.x(), 0.0);
        (f, g, DMat3::from_cols(t * t.x, t * t.y, t * t.z) * (-1.0 / r))
    }
    fn bounds(&self) -> Aabb<Patient> {
        Aabb { min: P3::new(-9.0, -9.0, -9.0), max: P3::new(9.0, 9.0, 9.0) }
    }
}

/// A cylinder with a Gaussian dent at (radius, 0, 0).
pub(crate) struct DentedCylinder {
    pub(crate) radius: f64,
    pub(crate) depth: f64,
    pub(crate) width: f64,
}

impl DentedCylinder {
    fn at(&self, angle: f64, z: f64) -> f64 {
        let arc = self.radius * (angle + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU)
            - self.radius * std::f64::consts::PI;
        self.radius - self.depth * (-0.5 * (arc * arc + z * z) / (self.width * self.width)).exp()
    }
    pub(crate) fn wall(&self, half_length: f64) -> Vec<P3> {
        wall(half_length, |a, z| self.at(a, z))
    }
}

impl Field for DentedCylinder {
    fn value(&self, x: P3) -> f64 {
        self.at(x.y().atan2(x.x()), x.z()) - x.x().hypot(x.y())
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let e = 1e-5;
        let d = |s: V3| (self.value(x + s * e) - self.value(x - s * e)) / (2.0 * e);
        (self.value(x), V3::new(d(V3::X), d(V3::Y), d(V3::Z)))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        (f, g, DMat3::ZERO)
    }
    fn bounds(&self) -> Aabb<Patient> {
        Cylinder { radius: self.radius }.bounds()
    }
}
