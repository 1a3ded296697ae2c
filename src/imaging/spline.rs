//! Periodic cubic splines in the plane.
//!
//! Uniform cubic B-splines over a closed parameter. [`PeriodicSpline::through`] interpolates points that are about
//! equally spaced along the curve and then brings the parameter to arc length: the curve is sampled densely, its length
//! table inverted, and the points at equal arc length interpolated anew, with more knots where the curve bends sharply,
//! so that |x'(s)| is within 1 % of 1. Fitting noisy points is [`crate::smooth`]'s part.

/// A closed planar curve, C2, parametrised by arc length (to the accuracy of its knots), mm.
#[derive(Clone, Debug)]
pub struct PeriodicSpline {
    length: f64,
    control: Vec<[f64; 2]>,
}

/// Samples per knot interval of the length table, each by Simpson's rule.
const LENGTH_SAMPLES: usize = 16;
/// Deviation of |x'| from 1 that asks for more knots; 1 % is promised.
const SPEED_ERROR: f64 = 0.005;
/// Fewest knots.
const MIN_KNOTS: usize = 8;

impl PeriodicSpline {
    /// The closed curve through points given in order, about equally spaced, at least 3; its parameter is arc length.
    /// It passes near the points (to the accuracy of the reparametrisation), not through each.
    pub fn through(points: &[[f64; 2]]) -> Self {
        let knots = points.len().max(MIN_KNOTS);
        Self::interpolating(points).by_arc_length(knots)
    }
    /// From control points over a parameter of total `length`; no reparametrisation.
    pub(crate) fn from_control(control: Vec<[f64; 2]>, length: f64) -> Self {
        Self { length, control }
    }
    /// Length of the curve, mm.
    pub fn length(&self) -> f64 {
        self.length
    }
    /// Number of knots.
    pub fn knots(&self) -> usize {
        self.control.len()
    }
    /// Position, first and second derivative by the parameter at `s` in [0, length), in mm, 1 and 1/mm.
    pub fn derivatives(&self, s: f64) -> [[f64; 2]; 3] {
        let n = self.control.len();
        let per_mm = n as f64 / self.length;
        let u = (s * per_mm).rem_euclid(n as f64);
        let i = (u as usize).min(n - 1);
        let b = basis(u - i as f64);
        let mut out = [[0.0; 2]; 3];
        for (m, (out, scale)) in out.iter_mut().zip([1.0, per_mm, per_mm * per_mm]).enumerate() {
            for (q, w) in b[m].iter().enumerate() {
                let c = self.control[(i + n + q - 1) % n];
                out[0] += scale * w * c[0];
                out[1] += scale * w * c[1];
            }
        }
        out
    }
    /// Enclosed area with sign: positive for a counterclockwise curve, mm2.
    pub fn area(&self) -> f64 {
        let n = self.control.len() * LENGTH_SAMPLES;
        let h = self.length / n as f64;
        (0..n).fold(0.0, |a, i| {
            let [p, d, _] = self.derivatives(i as f64 * h);
            a + 0.5 * h * (p[0] * d[1] - p[1] * d[0])
        })
    }
    /// Cyclic interpolation: (c[i-1] + 4 c[i] + c[i+1]) / 6 = p[i], by Gauss-Seidel sweeps (contraction < 1/3 each).
    fn interpolating(points: &[[f64; 2]]) -> Self {
        let n = points.len();
        let mut control = points.to_vec();
        for _ in 0..40 {
            for i in 0..n {
                for a in 0..2 {
                    let around = control[(i + n - 1) % n][a] + control[(i + 1) % n][a];
                    control[i][a] = (6.0 * points[i][a] - around) / 4.0;
                }
            }
        }
        Self { length: n as f64, control }
    }
    /// The same curve by arc length, from `knots` knots up to eight times as many where it bends sharply.
    pub(crate) fn by_arc_length(&self, knots: usize) -> Self {
        let mut spline = self.resampled(knots);
        for finer in [2, 4, 8] {
            if spline.is_by_arc_length() {
                break;
            }
            spline = self.resampled(finer * knots);
        }
        spline
    }
    fn is_by_arc_length(&self) -> bool {
        let n = 4 * self.control.len();
        (0..n).all(|i| {
            let d = self.derivatives(self.length * i as f64 / n as f64)[1];
            (d[0].hypot(d[1]) - 1.0).abs() < SPEED_ERROR
        })
    }
    fn resampled(&self, knots: usize) -> Self {
        let n = self.control.len() * LENGTH_SAMPLES;
        let h = self.length / n as f64;
        let mut table = vec![0.0; n + 1];
        for i in 0..n {
            // Simpson on |x'| per sample interval
            let speed = |s: f64| {
                let d = self.derivatives(s)[1];
                d[0].hypot(d[1])
            };
            let s = i as f64 * h;
            table[i + 1] = table[i] + h / 6.0 * (speed(s) + 4.0 * speed(s + 0.5 * h) + speed(s + h));
        }
        let total = table[n];
        if total.is_nan() || total <= 0.0 {
            return self.clone();
        }
        let mut i = 0;
        let points: Vec<[f64; 2]> = (0..knots)
            .map(|k| {
                let wanted = total * k as f64 / knots as f64;
                while i + 1 < n && table[i + 1] < wanted {
                    i += 1;
                }
                let step = (table[i + 1] - table[i]).max(f64::MIN_POSITIVE);
                self.derivatives((i as f64 + (wanted - table[i]) / step) * h)[0]
            })
            .collect();
        Self { length: total, ..Self::interpolating(&points) }
    }
}

/// The four cubic B-spline weights on one interval and their first and second derivatives.
pub(crate) fn basis(t: f64) -> [[f64; 4]; 3] {
    let (t2, t3, r) = (t * t, t * t * t, 1.0 - t);
    [
        [r * r * r / 6.0, (3.0 * t3 - 6.0 * t2 + 4.0) / 6.0, (-3.0 * t3 + 3.0 * t2 + 3.0 * t + 1.0) / 6.0, t3 / 6.0],
        [-r * r / 2.0, (3.0 * t2 - 4.0 * t) / 2.0, (-3.0 * t2 + 2.0 * t + 1.0) / 2.0, t2 / 2.0],
        [r, 3.0 * t - 2.0, -3.0 * t + 1.0, t],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ellipse(n: usize) -> Vec<[f64; 2]> {
        (0..n)
            .map(|i| {
                let a = std::f64::consts::TAU * i as f64 / n as f64;
                [3.0 + 4.0 * a.cos(), 2.0 * a.sin() - 1.0]
            })
            .collect()
    }

    #[test]
    fn the_parameter_is_arc_length() {
        let s = PeriodicSpline::through(&ellipse(48));
        for i in 0..500 {
            let d = s.derivatives(s.length() * i as f64 / 500.0)[1];
            assert!((d[0].hypot(d[1]) - 1.0).abs() < 0.01, "{i} {}", d[0].hypot(d[1]));
        }
        // Ramanujan's second formula
        let h: f64 = (2.0 / 6.0_f64).powi(2);
        let exact = std::f64::consts::PI * 6.0 * (1.0 + 3.0 * h / (10.0 + (4.0 - 3.0 * h).sqrt()));
        assert!((s.length() / exact - 1.0).abs() < 1e-3, "{} {exact}", s.length());
        assert!((s.area() / (8.0 * std::f64::consts::PI) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn derivatives_agree_with_differences() {
        let s = PeriodicSpline::through(&ellipse(40));
        let h = 1e-5;
        for i in 0..50 {
            let u = s.length() * (i as f64 + 0.37) / 50.0;
            let [_, d, dd] = s.derivatives(u);
            let (a, b) = (s.derivatives(u - h), s.derivatives(u + h));
            for k in 0..2 {
                assert!(((b[0][k] - a[0][k]) / (2.0 * h) - d[k]).abs() < 1e-7);
                assert!(((b[1][k] - a[1][k]) / (2.0 * h) - dd[k]).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn the_parameter_wraps() {
        let s = PeriodicSpline::through(&ellipse(30));
        assert!((s.derivatives(s.length() + 1.0)[0][0] - s.derivatives(1.0)[0][0]).abs() < 1e-9);
    }
}
