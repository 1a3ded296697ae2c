//! Vessels as blends of tubes, with exact value, gradient and second derivatives.
//!
//! A tube's wall lies at one radius from its centre line, so its distance and the derivatives of that are closed
//! forms. Tubes join by the cubic smooth minimum: twice continuously differentiable, exact (the plain distance)
//! wherever the other tube is farther than the blend width, so that sections there are true circles. The exponential
//! smooth minimum was not taken: it changes the radius everywhere.

use crate::Axis;
use space::{DMat3, DVec3, P3, V3};

/// One tube of a vessel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tube {
    /// Centre line.
    pub axis: Axis,
    /// Radius, mm.
    pub radius_mm: f64,
    /// Width of the blend with the tubes before it, mm; 0 joins with a sharp edge.
    pub blend_mm: f64,
}

/// Tubes joined in order by smooth minima: an exact, distance-like function. Off the blends |f| is the distance to the
/// wall (up to the medial line and the bisectors between tubes).
#[derive(Clone, Debug, PartialEq)]
pub struct Vessel {
    tubes: Vec<Tube>,
}

/// Signed distance (negative inside) with its derivatives.
#[derive(Clone, Copy, Debug)]
struct Jet {
    d: f64,
    g: DVec3,
    h: DMat3,
}

/// smin(a, b, k) = min(a, b) - k h^3 / 6, h = max(k - |a - b|, 0) / k.
fn smooth_min(a: f64, b: f64, k: f64) -> f64 {
    let h = overlap(a, b, k);
    a.min(b) - k * h * h * h / 6.0
}

fn overlap(a: f64, b: f64, k: f64) -> f64 {
    if k > 0.0 { (k - (a - b).abs()).max(0.0) / k } else { 0.0 }
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

impl Jet {
    /// The smooth minimum with its derivatives: weights 1 - h^2/2 and h^2/2, curvature -(h/k) (ga - gb)(ga - gb)'.
    fn blended(self, other: Self, k: f64) -> Self {
        let (a, b) = if self.d <= other.d { (self, other) } else { (other, self) };
        let h = overlap(a.d, b.d, k);
        if h <= 0.0 {
            return a;
        }
        let w = 0.5 * h * h;
        let step = a.g - b.g;
        Self {
            d: smooth_min(a.d, b.d, k),
            g: a.g * (1.0 - w) + b.g * w,
            h: a.h * (1.0 - w) + b.h * w - outer(step, step) * (h / k),
        }
    }
}

impl Tube {
    fn distance(&self, p: DVec3) -> f64 {
        p.distance(self.axis.foot(p).point) - self.radius_mm
    }

    /// With n from the axis to p at distance rho, t the tangent and c the curvature vector: gradient n, Hessian
    /// (I - n n' - t t') / rho - t t' (c.n) / (1 - rho c.n); at an end of the axis (I - n n') / rho.
    fn jet(&self, p: DVec3) -> Jet {
        let foot = self.axis.foot(p);
        let rho = p.distance(foot.point);
        let n = (p - foot.point).try_normalize().unwrap_or(DVec3::ZERO);
        let across = DMat3::IDENTITY - outer(n, n);
        let inverse = 1.0 / rho.max(1e-9);
        let h = match foot.tangent {
            None => across * inverse,
            Some(t) => {
                let bend = foot.curvature.dot(n);
                (across - outer(t, t)) * inverse - outer(t, t) * (bend / (1.0 - rho * bend))
            }
        };
        Jet { d: rho - self.radius_mm, g: n, h }
    }
}

impl Vessel {
    /// From its tubes; the first tube's blend is not used. An empty list is a vessel of no volume.
    pub fn new(tubes: Vec<Tube>) -> Self {
        Self { tubes }
    }
    /// The tubes, in blending order.
    pub fn tubes(&self) -> &[Tube] {
        &self.tubes
    }
    /// Distance to the wall in mm, positive inside the lumen. Cost: one nearest point per tube.
    pub fn distance(&self, x: P3) -> f64 {
        let p = x.raw();
        -self.tubes.iter().fold(f64::INFINITY, |d, tube| smooth_min(d, tube.distance(p), tube.blend_mm))
    }
    /// [`Vessel::distance`] and its gradient (pointing into the lumen; unit length off the blends).
    pub fn gradient(&self, x: P3) -> (f64, V3) {
        let (f, g, _) = self.hessian(x);
        (f, g)
    }
    /// [`Vessel::distance`], gradient and matrix of second derivatives, 1/mm. Not defined on the centre lines.
    pub fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let p = x.raw();
        let far = Jet { d: f64::INFINITY, g: DVec3::ZERO, h: DMat3::ZERO };
        let jet = self.tubes.iter().fold(far, |j, tube| j.blended(tube.jet(p), tube.blend_mm));
        (-jet.d, V3::from_raw(-jet.g), jet.h * -1.0)
    }

    /// The arc length from which on the sections of tube `tube` are exact circles: beyond it every point of its wall lies
    /// on the vessel's wall, out of reach of every blend. `None` when that does not happen before `to_mm`.
    pub(crate) fn circular_from(&self, tube: usize, to_mm: f64) -> Option<f64> {
        const STEP_MM: f64 = 0.05;
        let me = &self.tubes[tube];
        let pure = |s: f64| {
            let (centre, t) = (me.axis.point(s), me.axis.tangent(s));
            let u = t.any_orthonormal();
            let v = t.cross(u);
            (0..64).all(|k| {
                let (sin, cos) = (std::f64::consts::TAU * f64::from(k) / 64.0).sin_cos();
                let wall = (centre + (u * cos + v * sin) * me.radius_mm).raw();
                self.distance(P3::from_raw(wall)).abs() < 1e-9
            })
        };
        let steps = (to_mm / STEP_MM).floor() as usize;
        let last_mixed = (0..=steps).rev().find(|&k| !pure(k as f64 * STEP_MM));
        match last_mixed {
            None => Some(0.0),
            Some(k) if k < steps => Some((k + 1) as f64 * STEP_MM),
            Some(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tee() -> Vessel {
        let tilted = V3::new(1.0, 0.2, 0.9).normalised().unwrap_or(V3::X);
        let circle = Axis::Circle { centre: P3::new(-40.0, 0.0, 0.0), towards: V3::X, tangent: V3::Z, radius_mm: 40.0 };
        Vessel::new(vec![
            Tube { axis: Axis::ray(P3::ORIGIN, V3::Z), radius_mm: 3.0, blend_mm: 0.0 },
            Tube { axis: circle, radius_mm: 2.5, blend_mm: 1.5 },
            Tube { axis: Axis::ray(P3::ORIGIN, tilted), radius_mm: 2.5, blend_mm: 3.0 },
        ])
    }

    #[test]
    fn derivatives_agree_with_differences() {
        let vessel = tee();
        let e = 1e-5;
        let unit = [V3::X, V3::Y, V3::Z];
        let mut tried = 0;
        for i in 0..300 {
            let t = f64::from(i);
            let x = P3::new(4.0 * t.sin(), 4.0 * (2.3 * t).cos(), 6.0 * (0.7 * t).sin());
            // The second derivatives jump where a ray's end sphere meets its tube.
            if vessel.tubes().iter().any(|k| {
                matches!(k.axis, Axis::Straight { through, direction, .. }
                if (x - through).dot(direction).abs() < 1e-3)
            }) {
                continue;
            }
            let (f, g, h) = vessel.hessian(x);
            assert!((f - vessel.distance(x)).abs() < 1e-12);
            for (k, &u) in unit.iter().enumerate() {
                let slope = (vessel.distance(x + u * e) - vessel.distance(x - u * e)) / (2.0 * e);
                assert!((slope - g.dot(u)).abs() < 1e-6, "gradient at {x:?}");
                let bend = (vessel.gradient(x + u * e).1 - vessel.gradient(x - u * e).1) * (0.5 / e);
                let scale = 1.0 + h.to_cols_array().iter().fold(0.0, |m: f64, v| m.max(v.abs()));
                assert!((bend.raw() - h.col(k)).length() < 1e-4 * scale * scale, "second derivatives at {x:?}");
            }
            tried += 1;
        }
        assert!(tried > 250);
    }

    #[test]
    fn sections_past_the_blend_are_circles_of_the_tubes_radius() {
        let vessel = tee();
        let from = vessel.circular_from(2, 60.0).unwrap_or(f64::NAN);
        assert!(from > 5.0 && from < 25.0, "{from}");
        let tube = vessel.tubes()[2];
        let on_wall = |s: f64, k: i32| {
            let (c, t) = (tube.axis.point(s), tube.axis.tangent(s));
            let u = t.any_orthonormal();
            let a = std::f64::consts::TAU * f64::from(k) / 48.0;
            vessel.distance(c + (u * a.cos() + t.cross(u) * a.sin()) * tube.radius_mm).abs()
        };
        for k in 0..48 {
            assert!(on_wall(from + 0.1, k) < 1e-12 && on_wall(from + 9.0, k) < 1e-12);
        }
        assert!((0..48).any(|k| on_wall(from - 1.0, k) > 1e-6), "the blend ends where it is said to end");
    }
}
