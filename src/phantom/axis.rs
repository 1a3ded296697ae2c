//! Centre lines with exact nearest points: straight pieces, circles and helices, in patient space.

use space::{DVec3, P3, V3};

/// A centre line, parametrised by arc length s in mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Axis {
    /// The straight piece `through + s direction` for s in `range` (either end may be infinite; equal ends: a point).
    Straight {
        /// The point of s = 0.
        through: P3,
        /// Unit direction.
        direction: V3,
        /// First and last s, mm.
        range: [f64; 2],
    },
    /// A whole circle; s = 0 at `centre + radius towards`.
    Circle {
        /// Centre.
        centre: P3,
        /// Unit vector from the centre to the point of s = 0.
        towards: V3,
        /// Unit vector in which s grows there, at a right angle to `towards`.
        tangent: V3,
        /// Radius, mm.
        radius_mm: f64,
    },
    /// An endless right-handed helix: `centre + a (cos t towards + sin t side) + b t axis`, side = axis x towards,
    /// t = s / sqrt(a^2 + b^2).
    Helix {
        /// Point on the helix's own axis at the height of s = 0.
        centre: P3,
        /// Unit vector along the helix's own axis.
        axis: V3,
        /// Unit vector from the axis to the point of s = 0.
        towards: V3,
        /// a: radius of the helix, mm.
        radius_mm: f64,
        /// b: advance per radian, mm.
        advance_mm: f64,
    },
}

/// The nearest point of a centre line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Foot {
    /// The point.
    pub(crate) point: DVec3,
    /// Unit tangent there; `None` at an end of the line, where the wall is a sphere.
    pub(crate) tangent: Option<DVec3>,
    /// Curvature times the principal normal, 1/mm.
    pub(crate) curvature: DVec3,
}

impl Axis {
    /// An endless straight line.
    pub fn line(through: P3, direction: V3) -> Self {
        Self::Straight { through, direction, range: [f64::NEG_INFINITY, f64::INFINITY] }
    }
    /// A half line.
    pub fn ray(from: P3, direction: V3) -> Self {
        Self::Straight { through: from, direction, range: [0.0, f64::INFINITY] }
    }
    /// First and last arc length, mm (infinite for endless lines; one turn for a circle).
    pub fn range(&self) -> [f64; 2] {
        match *self {
            Self::Straight { range, .. } => range,
            Self::Circle { radius_mm, .. } => [-std::f64::consts::PI * radius_mm, std::f64::consts::PI * radius_mm],
            Self::Helix { .. } => [f64::NEG_INFINITY, f64::INFINITY],
        }
    }
    /// The point at arc length s, mm.
    pub fn point(&self, s: f64) -> P3 {
        match *self {
            Self::Straight { through, direction, .. } => through + direction * s,
            Self::Circle { centre, towards, tangent, radius_mm } => {
                let (sin, cos) = (s / radius_mm).sin_cos();
                centre + (towards * cos + tangent * sin) * radius_mm
            }
            Self::Helix { centre, axis, towards, radius_mm, advance_mm } => {
                let t = s / radius_mm.hypot(advance_mm);
                let (sin, cos) = t.sin_cos();
                centre + (towards * cos + axis.cross(towards) * sin) * radius_mm + axis * (advance_mm * t)
            }
        }
    }
    /// The unit tangent at arc length s.
    pub fn tangent(&self, s: f64) -> V3 {
        match *self {
            Self::Straight { direction, .. } => direction,
            Self::Circle { towards, tangent, radius_mm, .. } => {
                let (sin, cos) = (s / radius_mm).sin_cos();
                tangent * cos - towards * sin
            }
            Self::Helix { axis, towards, radius_mm, advance_mm, .. } => {
                let c = radius_mm.hypot(advance_mm);
                let (sin, cos) = (s / c).sin_cos();
                (axis.cross(towards) * cos - towards * sin) * (radius_mm / c) + axis * (advance_mm / c)
            }
        }
    }
    /// The nearest point to `p`.
    pub(crate) fn foot(&self, p: DVec3) -> Foot {
        match *self {
            Self::Straight { through, direction, range } => {
                let s = (p - through.raw()).dot(direction.raw());
                let inside = s > range[0] && s < range[1];
                let point = through.raw() + direction.raw() * s.max(range[0]).min(range[1]);
                Foot { point, tangent: inside.then_some(direction.raw()), curvature: DVec3::ZERO }
            }
            Self::Circle { centre, towards, tangent, radius_mm } => {
                let d = p - centre.raw();
                let n = towards.cross(tangent).raw();
                let out = (d - n * d.dot(n)).try_normalize().unwrap_or(towards.raw());
                let point = centre.raw() + out * radius_mm;
                Foot { point, tangent: Some(n.cross(out)), curvature: out * (-1.0 / radius_mm) }
            }
            Self::Helix { centre, axis, towards, radius_mm, advance_mm } => {
                let d = p - centre.raw();
                let side = axis.cross(towards).raw();
                let local = DVec3::new(d.dot(towards.raw()), d.dot(side), d.dot(axis.raw()));
                let c = radius_mm.hypot(advance_mm);
                let s = c * helix_parameter(local, radius_mm, advance_mm);
                let (sin, cos) = (s / c).sin_cos();
                let out = towards.raw() * cos + side * sin;
                Foot {
                    point: self.point(s).raw(),
                    tangent: Some(self.tangent(s).raw()),
                    curvature: out * (-radius_mm / (c * c)),
                }
            }
        }
    }
}

/// The t of the point of (a cos t, a sin t, b t) nearest to p. Half the squared distance has the derivative
/// g(t) = a rho sin(t - phi) + b (b t - z), with p = (rho, phi, z) in cylinder coordinates. On the turns next to z, a
/// root of g lies between phi + 2 pi k and z / b, where g changes sign: safeguarded Newton on each, the nearer wins.
/// Within 1 / curvature of the helix that is the nearest point; farther off it is one of the stationary points.
fn helix_parameter(p: DVec3, a: f64, b: f64) -> f64 {
    let (rho, phi, level) = (p.x.hypot(p.y), p.y.atan2(p.x), p.z / b);
    let turn = std::f64::consts::TAU;
    let nearest = phi + turn * ((level - phi) / turn).round();
    let second = if level > nearest { nearest + turn } else { nearest - turn };
    let squared = |t: f64| rho * rho + a * a - 2.0 * a * rho * (t - phi).cos() + (b * t - p.z).powi(2);
    let root = |start: f64| {
        let (mut lo, mut hi) = (start.min(level), start.max(level));
        let mut t = (a * rho * start + b * b * level) / (a * rho + b * b);
        for _ in 0..60 {
            let (sin, cos) = (t - phi).sin_cos();
            let g = a * rho * sin + b * (b * t - p.z);
            if g > 0.0 {
                hi = t;
            } else {
                lo = t;
            }
            let newton = t - g / (a * rho * cos + b * b);
            let next = if newton > lo && newton < hi { newton } else { 0.5 * (lo + hi) };
            if (next - t).abs() < 1e-14 * (1.0 + t.abs()) {
                return next;
            }
            t = next;
        }
        t
    };
    let first = root(nearest);
    // On the second turn the bracket spans more than half a turn; it wins only far from the helix.
    if (level - nearest).abs() < 0.5 * std::f64::consts::PI {
        return first;
    }
    let other = root(second);
    if squared(other) < squared(first) { other } else { first }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn helix() -> Axis {
        Axis::Helix {
            centre: P3::new(3.0, -2.0, 5.0),
            axis: V3::Z,
            towards: V3::X,
            radius_mm: 14.04,
            advance_mm: 9.456,
        }
    }

    #[test]
    fn the_foot_of_a_point_off_the_helix_is_where_it_left_it() {
        let axis = helix();
        for i in 0..400 {
            let s = -60.0 + 0.3 * f64::from(i);
            let t = axis.tangent(s);
            let out = t.any_orthonormal();
            let n = out * f64::from(i).cos() + t.cross(out) * f64::from(i).sin();
            let p = axis.point(s) + n * 4.0;
            assert!(axis.foot(p.raw()).point.distance(axis.point(s).raw()) < 1e-9, "s = {s}");
        }
    }

    #[test]
    fn the_foot_is_no_farther_than_any_sample_of_the_line() {
        let circle = Axis::Circle { centre: P3::ORIGIN, towards: V3::X, tangent: V3::Y, radius_mm: 30.0 };
        for axis in [helix(), circle] {
            for i in 0..200 {
                let t = f64::from(i);
                let p = DVec3::new(25.0 * t.sin(), 25.0 * (1.7 * t).cos(), 0.2 * t - 20.0);
                let best = (-1500..1500).map(|k| axis.point(0.1 * f64::from(k)).raw().distance(p));
                let best = best.fold(f64::INFINITY, f64::min);
                let found = axis.foot(p).point.distance(p);
                assert!(found <= best + 1e-3 || found > 12.0, "{found} against {best}");
            }
        }
    }

    #[test]
    fn the_curvature_vector_is_the_derivative_of_the_tangent() {
        let axis = helix();
        for s in [-20.0, 0.0, 13.0] {
            let foot = axis.foot(axis.point(s).raw());
            let slope = (axis.tangent(s + 1e-4) - axis.tangent(s - 1e-4)) * 5e3;
            assert!((slope.raw() - foot.curvature).length() < 1e-6);
        }
    }
}
