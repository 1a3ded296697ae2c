//! What the data leave open: functions that fit as well as the fitted one, for error bands.
//!
//! The fit is the posterior mean of a random field with generalised covariance s |x - x'|^3 under the constraints' noise
//! (see [`crate::fit`]). A draw from that posterior differs from the mean by g - fit(g(x_i) + e_i), where g is a draw of
//! the field itself and e_i one of the noise (Matheron's rule; Chiles and Delfiner 2012, 7.3): bands widen where slices
//! are far apart, because there g is not tied down. It takes one more solve with the same prepared system per draw, and nothing
//! is assumed of the solver but that it solves for any right-hand side. Perturbing the wall alone (e without g) was
//! rejected: it says that the shape between two slices is known exactly.
//!
//! g is a sum of plane waves. |h|^3 has the spectral density 96 pi / k^6 in three dimensions; wave numbers are drawn
//! log-uniformly from the size of the data to half the spacing of the wall points, each wave weighted by the density.
//! The errors of a contour are those of its smoothing spline: not independent from point to point but a trigonometric
//! polynomial along the contour, over which the spline's degrees of freedom are spread ([`modes`]). The error of the
//! level at which contours are drawn is a field of its own, which neighbouring contours share. What the half-maximum
//! correction leaves is a share of it, the same in the whole scan.

use crate::Error;
use crate::conjugate::Coefficients;
use crate::constraints::Constraints;
use crate::interpolate::Solver;
use crate::kernel::Centres;
use crate::system::Scale;
use crate::waves::{Wave, Waves};
use exec::Ctx;
use imaging::Contours;
use space::P3;

/// Highest harmonic of a contour's error: 33 terms in all.
const HARMONICS: usize = 16;
/// Plane waves of a draw: some 25 per factor of two in wave number.
const WAVES: usize = 256;
/// Plane waves of a draw of the levels' errors.
const LEVEL_WAVES: usize = 128;
/// Standard error of the half-maximum correction, as a share of it: what it leaves of the branches of the demo scan without noise is 1
/// to 17 % of it (docs/adr/0038).
const CORRECTION_ERROR: f64 = 0.15;
/// Smallest wave number, in scaled coordinates (the farthest constraint at distance 1): what is longer is as good as a
/// polynomial of second degree, which the constraints determine.
const WAVE_NUMBER_MIN: f64 = 0.5;
/// Largest residual wanted of a draw, as a share of the wall points' mean standard error: a band is about as wide as
/// these, and its own scatter among 24 draws is 14 %.
const DRAW_SHARE: f64 = 0.01;
/// The least that is wanted, and what is accepted, mm.
const DRAW_MM: [f64; 2] = [1e-4, 1e-3];
/// Wall points from which their spacing is estimated.
const SPACING_SAMPLES: usize = 64;

/// Differences of drawn functions from the fitted one.
pub trait Draws: Sync {
    /// How many there are.
    fn count(&self) -> usize;
    /// The difference of a draw from the fitted function at some points, mm; `out` has the length of `at`.
    fn differences(&self, draw: usize, at: &[P3], out: &mut [f64]);
}

/// Draws from the posterior of a fit.
#[derive(Clone, Debug, Default)]
pub struct Ensemble {
    draws: Vec<Draw>,
    scale: Option<Scale>,
}

#[derive(Clone, Debug)]
struct Draw {
    waves: Waves,
    centres: Centres,
    polynomial: [f64; 4],
}

/// Coefficients and polynomials of `count` draws for a solved fit with scale `s` of the field. The same for any number of
/// threads.
pub(crate) fn solved(
    c: &Constraints,
    solver: &Solver<'_>,
    (scale, s): (Scale, f64),
    count: usize,
    ctx: &Ctx,
) -> Result<Vec<Coefficients>, Error> {
    let points: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
    let longest = longest(&points[..c.wall]);
    let values = ctx.map_range(count, |number| {
        let mut normal = Normal::new(number as u64);
        let waves = waves(s, longest, &mut normal);
        let mut values = errors(c, &mut normal);
        let level = level_waves(&scale, &mut normal);
        for (v, (level_mm, p)) in values.iter_mut().zip(c.level_mm.iter().zip(&points)) {
            *v += level_mm * level.at(*p);
        }
        let share = CORRECTION_ERROR * normal.next();
        values.iter_mut().zip(&c.correction_mm).for_each(|(v, mm)| *v += mm * share);
        // an interior point was set off from its wall point and shares its error
        for (k, (wall, _)) in c.interior.iter().enumerate() {
            values[c.wall + k] += values[*wall];
        }
        for (v, p) in values.iter_mut().zip(&points) {
            *v += waves.at(*p);
        }
        values
    })?;
    // the solver tells a progress of its own for every draw
    let error = c.sigma_mm[..c.wall].iter().fold(0.0, |s, x| s + x) / c.wall.max(1) as f64;
    let wanted = DRAW_MM[0].max(DRAW_SHARE * error);
    solver.solve_many(&values, [wanted, wanted.max(DRAW_MM[1])], &ctx.part(0.0, 0.0))
}

/// The largest wave number, scaled: half the spacing of the wall points.
fn longest(wall: &[[f64; 3]]) -> f64 {
    (2.0 * std::f64::consts::TAU / spacing(wall).max(1e-4)).max(2.0 * WAVE_NUMBER_MIN)
}

impl Ensemble {
    /// The draws that [`solved`] gave coefficients of; their waves come from their numbers again.
    pub(crate) fn of(c: &Constraints, (scale, s): (Scale, f64), solved: Vec<Coefficients>) -> Self {
        let points: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
        let longest = if solved.is_empty() { 1.0 } else { longest(&points[..c.wall]) };
        let draw = |(number, (coefficients, polynomial)): (usize, Coefficients)| Draw {
            waves: waves(s, longest, &mut Normal::new(number as u64)),
            centres: Centres::new(&points, &coefficients),
            polynomial,
        };
        Self { draws: solved.into_iter().enumerate().map(draw).collect(), scale: Some(scale) }
    }
}

impl Draws for Ensemble {
    fn count(&self) -> usize {
        self.draws.len()
    }

    fn differences(&self, draw: usize, at: &[P3], out: &mut [f64]) {
        let (Some(draw), Some(scale)) = (self.draws.get(draw), self.scale) else { return };
        let targets: Vec<[f64; 3]> = at.iter().map(|&x| scale.apply(x)).collect();
        draw.centres.values(&targets, out);
        let b = &draw.polynomial;
        for (o, t) in out.iter_mut().zip(&targets) {
            *o = draw.waves.at(*t) - *o - b[0] - b[1] * t[0] - b[2] * t[1] - b[3] * t[2];
        }
    }
}

/// Median distance of a wall point to the next, scaled.
fn spacing(wall: &[[f64; 3]]) -> f64 {
    let stride = wall.len().div_ceil(SPACING_SAMPLES).max(1);
    let distance = |i: usize, j: usize| (0..3).fold(0.0, |s, a| s + (wall[i][a] - wall[j][a]).powi(2)).sqrt();
    let nearest = |i: usize| (0..wall.len()).filter(|&j| j != i).map(|j| distance(i, j)).fold(f64::INFINITY, f64::min);
    let mut d: Vec<f64> = (0..wall.len()).step_by(stride).map(nearest).collect();
    d.sort_by(f64::total_cmp);
    d.get(d.len() / 2).copied().unwrap_or(1.0)
}

/// Waves of a field with covariance s |h|^3. With k drawn log-uniformly over a range of ln ratio L and directions evenly, the
/// density s 96 pi / k^6 per d^3k / (2 pi)^3 gives each of M waves the variance 48 s L / (pi M k^3).
fn waves(s: f64, longest: f64, normal: &mut Normal) -> Waves {
    let range = (longest / WAVE_NUMBER_MIN).ln();
    (0..WAVES)
        .map(|i| {
            // one wave in each of M equal parts of the range
            let k = WAVE_NUMBER_MIN * (range * (i as f64 + normal.uniform()) / WAVES as f64).exp();
            let d = [normal.next(), normal.next(), normal.next()];
            let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt().max(f64::MIN_POSITIVE);
            let variance = 48.0 * s * range / (std::f64::consts::PI * WAVES as f64 * k.powi(3));
            // a wave of random phase and normal amplitude with variance v has amplitude sqrt(2 v) times a normal number
            let amplitude = (2.0 * variance).sqrt() * normal.next();
            Wave { k: d.map(|x| x * k / length), phase: std::f64::consts::TAU * normal.uniform(), amplitude }
        })
        .collect()
}

/// Waves of a field of variance 1 and covariance exp(-h^2 / (2 l^2)), l the distance over which levels err together: wave
/// vectors are normal with deviation 1 / l.
fn level_waves(scale: &Scale, normal: &mut Normal) -> Waves {
    let per_scaled = scale.length / Contours::LEVEL_MM;
    let amplitude = (2.0 / LEVEL_WAVES as f64).sqrt();
    (0..LEVEL_WAVES)
        .map(|_| {
            let k = std::array::from_fn(|_| per_scaled * normal.next());
            Wave { k, phase: std::f64::consts::TAU * normal.uniform(), amplitude }
        })
        .collect()
}

/// Deviations of a contour's error by harmonic (each but the first has two terms), of variance 1 in all: the shares of its noise
/// that a smoothing spline lets through. Size and place are free, harmonic m passes by 1 / (1 + k m^2 (m^2 - 1)^2) (docs/adr/0033),
/// with the k at which they sum to the degrees of freedom.
fn modes(freedom: f64) -> [f64; HARMONICS + 1] {
    let passed = |k: f64| -> [f64; HARMONICS + 1] {
        std::array::from_fn(|m| {
            let m2 = (m * m) as f64;
            if m < 2 { 1.0 } else { 1.0 / (1.0 + k * m2 * (m2 - 1.0).powi(2)) }
        })
    };
    let sum = |passed: [f64; HARMONICS + 1]| passed.iter().skip(1).fold(passed[0], |s, w| s + 2.0 * w);
    let (mut low, mut high) = (-40.0_f64, 40.0_f64);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if sum(passed(middle.exp())) > freedom { low = middle } else { high = middle }
    }
    let passed = passed(high.exp());
    let norm = sum(passed.map(|w| w * w)).sqrt();
    passed.map(|w| if w > 1e-6 { w / norm } else { 0.0 })
}

/// One draw of the constraints' errors: a trigonometric polynomial along each contour, independent elsewhere.
fn errors(c: &Constraints, normal: &mut Normal) -> Vec<f64> {
    let mut out = Vec::with_capacity(c.points.len());
    let mut i = 0;
    while i < c.wall {
        let Some(curve) = c.curve[i] else {
            out.push(c.sigma_mm[i] * normal.next());
            i += 1;
            continue;
        };
        let count = c.curve[i..c.wall].iter().take_while(|&&other| other == Some(curve)).count();
        let sizes = modes(c.freedom[i]);
        let terms: [[f64; 2]; HARMONICS + 1] = std::array::from_fn(|_| [normal.next(), normal.next()]);
        for k in 0..count {
            let angle = std::f64::consts::TAU * k as f64 / count as f64;
            let mut error = sizes[0] * terms[0][0];
            for (m, (size, pair)) in
                sizes.iter().zip(&terms).enumerate().skip(1).take_while(|(_, (size, _))| **size > 0.0)
            {
                let (sin, cos) = (m as f64 * angle).sin_cos();
                error += size * std::f64::consts::SQRT_2 * (pair[0] * cos + pair[1] * sin);
            }
            out.push(c.sigma_mm[i + k] * error);
        }
        i += count;
    }
    out.extend(c.sigma_mm[c.wall..].iter().map(|sigma| sigma * normal.next()));
    out
}

/// Normal and uniform numbers from a seed (splitmix64, Box and Muller).
struct Normal {
    state: u64,
    second: Option<f64>,
}

impl Normal {
    fn new(seed: u64) -> Self {
        Self { state: seed.wrapping_mul(0xd134_2543_de82_ef95) ^ 0x5bd1_e995_7f4a_7c15, second: None }
    }

    fn uniform(&mut self) -> f64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn next(&mut self) -> f64 {
        if let Some(x) = self.second.take() {
            return x;
        }
        let (u, v) = (1.0 - self.uniform(), std::f64::consts::TAU * self.uniform());
        let r = (-2.0 * u.ln()).sqrt();
        self.second = Some(r * v.sin());
        r * v.cos()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// For weights that annihilate polynomials of first degree, the variance of sum w_i g(x_i) is s sum w_i w_j |x_i - x_j|^3.
    #[test]
    fn waves_have_the_covariance_of_the_kernel() {
        let h = 0.1;
        let (points, weights) = ([0.0, h, 2.0 * h, 3.0 * h], [1.0, -3.0, 3.0, -1.0]);
        let mut expected = 0.0;
        for i in 0..4 {
            for j in 0..4 {
                expected += weights[i] * weights[j] * f64::powi(f64::abs(points[i] - points[j]), 3);
            }
        }
        let mut normal = Normal::new(3);
        let draws = 4000;
        let mut sum_of_squares = 0.0;
        for _ in 0..draws {
            let waves = waves(2.0, 2000.0, &mut normal);
            let x: f64 = (0..4).map(|i| weights[i] * waves.at([points[i], 0.3, -0.2])).sum();
            sum_of_squares += x * x;
        }
        let ratio = sum_of_squares / f64::from(draws) / (2.0 * expected);
        assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
    }

    /// A tube whose wall was corrected by .2 mm: the draws' walls lie 15 % of that out or in, all together.
    #[test]
    fn what_a_correction_leaves_moves_the_whole_wall() {
        use crate::interpolate::{Problem, solved};
        let ctx = Ctx::new(2).unwrap();
        let (rings, per_ring) = (12, 12);
        let n = rings * per_ring;
        let ring = |depth: f64| {
            (0..n).map(move |i| {
                let (angle, z) = (2.399_963 * i as f64, 1.5 * (i / per_ring) as f64);
                P3::new((3.0 - depth) * angle.cos(), (3.0 - depth) * angle.sin(), z)
            })
        };
        let moved = |correction_mm: f64| {
            let c = Constraints {
                points: ring(0.0).chain(ring(1.0)).collect(),
                values: [vec![0.0; n], vec![1.0; n]].concat(),
                sigma_mm: vec![1e-3; 2 * n],
                wall: n,
                interior: (0..n).map(|i| (i, 1.0)).collect(),
                planar_shift: vec![None; n],
                correction_mm: vec![correction_mm; n],
                level_mm: vec![0.0; n],
                freedom: vec![7.0; n],
                curve: (0..n).map(|i| Some(i / per_ring)).collect(),
            };
            let scale = Scale::of(&c.points);
            let scaled: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
            let noise = vec![1e-6; 2 * n];
            let problem = Problem { points: &scaled, noise: &noise, values: &c.values, tolerance: [1e-9, 1e-4] };
            let (_, solver) = solved(&problem, crate::Method::BySize, &ctx).unwrap();
            let drawn = super::solved(&c, &solver, (scale, 1.0), 200, &ctx).unwrap();
            let ensemble = Ensemble::of(&c, (scale, 1.0), drawn);
            let mut out = vec![0.0; n];
            let squares = (0..200).map(|draw| {
                ensemble.differences(draw, &c.points[..n], &mut out);
                (out.iter().sum::<f64>() / n as f64).powi(2)
            });
            (squares.sum::<f64>() / 200.0).sqrt()
        };
        let (without, with) = (moved(0.0), moved(0.2));
        assert!(without < 0.003, "{without}");
        assert!((with / 0.03 - 1.0).abs() < 0.2, "{with}");
    }

    /// Seconds of the parts of a fit of 12,000 constraints with noise, for docs/adr/0024:
    /// `cargo test --release -p implicit -- --ignored --nocapture time_of`.
    #[test]
    #[ignore = "half a minute of timing"]
    fn time_of_a_fit_and_its_draws() {
        use crate::interpolate::{Problem, solved};
        let (rings, per_ring) = (150, 40);
        let mut normal = Normal::new(5);
        let (mut points, mut values) = (Vec::new(), Vec::new());
        for depth in [0.0, 1.0] {
            for i in 0..rings * per_ring {
                let (ring, k) = (i / per_ring, i % per_ring);
                let angle = std::f64::consts::TAU * k as f64 / per_ring as f64;
                let (z, r) = (2.0 * ring as f64, 10.0 - depth + 0.1 * normal.next());
                points.push(P3::new(r * angle.cos() + 0.001 * z * z, r * angle.sin(), z));
                values.push(depth);
            }
        }
        let n = points.len();
        let c = Constraints {
            points,
            values,
            sigma_mm: vec![0.1; n],
            wall: n / 2,
            interior: Vec::new(),
            planar_shift: vec![None; n / 2],
            correction_mm: Vec::new(),
            level_mm: vec![0.0; n / 2],
            freedom: vec![7.0; n / 2],
            curve: (0..n / 2).map(|i| Some(i / per_ring)).collect(),
        };
        let ctx = Ctx::new(2).unwrap();
        let scale = Scale::of(&c.points);
        let scaled: Vec<[f64; 3]> = c.points.iter().map(|&p| scale.apply(p)).collect();
        let clock = std::time::Instant::now;
        let start = clock();
        let s = crate::roughness::roughness(&c, &scaled, &scale, &ctx).unwrap();
        println!("roughness {s:.3e}: {:.2} s", start.elapsed().as_secs_f64());
        let noise: Vec<f64> = c.sigma_mm.iter().map(|e| e * e / s).collect();
        let start = clock();
        crate::contrasts::Contrasts::new(&scaled, &noise, &ctx).unwrap();
        println!("contrasts: {:.2} s", start.elapsed().as_secs_f64());
        let start = clock();
        let problem = Problem { points: &scaled, noise: &noise, values: &c.values, tolerance: [1e-9, 1e-4] };
        let (solution, solver) = solved(&problem, crate::Method::BySize, &ctx).unwrap();
        println!("solve with contrasts: {} iterations, {:.2} s", solution.iterations, start.elapsed().as_secs_f64());
        let start = clock();
        Ensemble::of(&c, (scale, s), super::solved(&c, &solver, (scale, s), 24, &ctx).unwrap());
        println!("24 draws: {:.2} s", start.elapsed().as_secs_f64());
    }

    /// Mean square of a contour's drawn errors, and of their mean along it, over the stated ones.
    fn drawn(freedom: f64) -> [f64; 2] {
        let mut normal = Normal::new(11);
        let n = 40;
        let c = Constraints {
            points: vec![P3::ORIGIN; n],
            values: vec![0.0; n],
            sigma_mm: vec![0.1; n],
            wall: n,
            interior: Vec::new(),
            planar_shift: vec![None; n],
            correction_mm: Vec::new(),
            level_mm: vec![0.0; n],
            freedom: vec![freedom; n],
            curve: vec![Some(0); n],
        };
        let draws = 3000;
        let (mut square, mut mean) = (0.0, 0.0);
        for _ in 0..draws {
            let e = errors(&c, &mut normal);
            square += e.iter().map(|x| x * x).sum::<f64>() / n as f64;
            mean += (e.iter().sum::<f64>() / n as f64).powi(2);
        }
        [square / f64::from(draws) / 0.01, mean / f64::from(draws) / 0.01]
    }

    #[test]
    fn a_contour_s_errors_have_the_stated_size_and_are_spread_over_its_degrees_of_freedom() {
        // a circle fitted to data that ask for no more errs in size and place alone
        let [square, mean] = drawn(3.0);
        assert!((square - 1.0).abs() < 0.05 && (3.0 * mean - 1.0).abs() < 0.1, "{square} {mean}");
        let [square, mean] = drawn(1e3);
        assert!((square - 1.0).abs() < 0.05 && (33.0 * mean - 1.0).abs() < 0.1, "{square} {mean}");
        for freedom in [3.5, 7.0, 12.0, 20.0] {
            let sizes = modes(freedom);
            let passed = sizes.map(|size| size / sizes[0]);
            let sum = passed[1..].iter().fold(passed[0], |s, w| s + 2.0 * w);
            assert!((sum - freedom).abs() < 1e-3, "{sum} for {freedom}");
            assert!(sizes.windows(2).all(|w| w[1] <= w[0]));
        }
    }
}
