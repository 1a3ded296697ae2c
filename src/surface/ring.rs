//! A closed curve through points: periodic cubic spline over chord length (C2, error of fourth order in the spacing).

use glam::DVec3;

/// The spline: a value per knot and its second derivative. Parameters run from 0 to [`Ring::length`] and repeat.
pub(crate) struct Ring {
    /// Parameter of each knot, ascending from 0.
    pub(crate) knots: Vec<f64>,
    /// Value at each knot.
    pub(crate) places: Vec<DVec3>,
    bend: Vec<DVec3>,
    length: f64,
}

/// Sweeps of the relaxation for the second derivatives; each divides the error by 4 or more, so 60 leave rounding.
const SWEEPS: usize = 60;

impl Ring {
    /// `values` over the chord lengths of the closed polygon `points` (three at least, no two neighbours equal).
    pub(crate) fn through(points: &[DVec3], values: &[DVec3]) -> Self {
        let n = points.len();
        let chord: Vec<f64> = (0..n).map(|i| points[i].distance(points[(i + 1) % n])).collect();
        let mut knots = Vec::with_capacity(n);
        let length = chord.iter().fold(0.0, |s, c| {
            knots.push(s);
            s + c
        });
        let step = |i: usize| (values[(i + 1) % n] - values[i]) / chord[i];
        let mut bend = vec![DVec3::ZERO; n];
        for _ in 0..SWEEPS {
            for i in 0..n {
                let (b, a) = ((i + n - 1) % n, (i + 1) % n);
                let right = 6.0 * (step(i) - step(b)) - chord[b] * bend[b] - chord[i] * bend[a];
                bend[i] = right / (2.0 * (chord[b] + chord[i]));
            }
        }
        Self { knots, places: values.to_vec(), bend, length }
    }

    /// Chord length once around.
    pub(crate) fn length(&self) -> f64 {
        self.length
    }

    /// The value at a parameter.
    pub(crate) fn at(&self, u: f64) -> DVec3 {
        let n = self.knots.len();
        let u = u.rem_euclid(self.length);
        let i = self.knots.partition_point(|&k| k <= u).max(1) - 1;
        let j = (i + 1) % n;
        let end = if j == 0 { self.length } else { self.knots[j] };
        let h = end - self.knots[i];
        let (a, b) = ((end - u) / h, (u - self.knots[i]) / h);
        a * self.places[i]
            + b * self.places[j]
            + (h * h / 6.0) * ((a * a * a - a) * self.bend[i] + (b * b * b - b) * self.bend[j])
    }

    /// The parameter a fraction of the way from knot i to the next.
    pub(crate) fn between(&self, i: usize, part: f64) -> f64 {
        let end = self.knots.get(i + 1).copied().unwrap_or(self.length);
        self.knots[i] + part * (end - self.knots[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_circle_is_met_to_the_fourth_order() {
        let error = |n: usize| {
            let points: Vec<DVec3> = (0..n)
                .map(|i| {
                    let (s, c) = (std::f64::consts::TAU * i as f64 / n as f64).sin_cos();
                    DVec3::new(c, s, 0.0)
                })
                .collect();
            let ring = Ring::through(&points, &points);
            (0..1000).fold(0.0_f64, |e, k| e.max((ring.at(k as f64 * 0.00731).length() - 1.0).abs()))
        };
        let (coarse, fine) = (error(12), error(24));
        assert!(coarse < 1e-3 && (coarse / fine).log2() > 3.5, "{coarse} {fine}");
    }
}
