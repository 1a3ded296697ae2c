//! Noisy closed polylines to smooth periodic curves, the point spread, and the half-maximum correction.
//!
//! Periodic cubic P-spline: uniform B-splines over arc length, a third-order penalty that is 0 for circles, smoothing by
//! generalised cross-validation with every degree of freedom counted 1.6 times, because neighbouring crossings share pixels and
//! plain GCV follows their common noise. The parameters of the data are their feet on the last curve, three rounds.
//! The half-maximum contour of a blurred convex lumen lies inside the wall: each point is moved outward by
//! kappa/2 det(Sigma)/(n' Sigma n), which is kappa/2 (sigma^2 + px^2/12) for square pixels.

use crate::blur::half_maximum_shift;
use crate::march::Line;
use crate::spline::{PeriodicSpline, basis};

/// A fitted curve.
#[derive(Clone, Debug)]
pub(crate) struct Smoothed {
    pub(crate) spline: PeriodicSpline,
    /// Standard error along the normal, mm.
    pub(crate) standard_error: f64,
    /// Effective degrees of freedom: 3 (size and place) where a circle is all that the data ask for.
    pub(crate) freedom: f64,
}

/// Inflation of the degrees of freedom in GCV, usually 1.4 (Gu). Discs of 10 px at SNR 10/20/30 reach .070/.042/.026 px
/// rms at 1.3, .050/.026/.016 at 1.45, .046/.022/.016 at 1.6 and .045/.022/.015 at 1.8; peanuts of 5 px at SNR 20 reach
/// .089, .082, .080 and .081: neighbouring crossings share pixels, and what they share is not shape.
const INFLATION: f64 = 1.6;
/// Data points per knot: marching squares give 1.27 points per pixel of arc, so that knots are 1 px apart. Peanut shapes
/// are up to 1 % worse at 1.5 points and up to 4 % at 2; discs do not care.
const POINTS_PER_KNOT: f64 = 1.3;
/// Knots, least and most (the dense solve costs their cube / 6).
const KNOTS: (usize, usize) = (12, 160);
/// Rounds of fit and new parameters.
const ROUNDS: usize = 3;
/// Neighbouring crossings share noise: the variance of the mean is this many times that of independent points. With it
/// the stated standard error is within 10 % of the true rms of discs of 5 to 10 px at SNR 10 to 30. It is a variance: what
/// smoothing takes off a waist is not in it, so that peanuts of 5, 7.5, 10 px at SNR 20 err by 1.35, 1.22, 1.16 times it.
const SHARED_NOISE: f64 = 2.2;

/// The smoothing spline of a closed line.
pub(crate) fn smoothed(line: &Line) -> Smoothed {
    let points = &line.points;
    let n = points.len();
    let knots = ((n as f64 / POINTS_PER_KNOT) as usize).clamp(KNOTS.0, KNOTS.1);
    let mut t = chord_parameters(points);
    let mut outcome = None;
    for _ in 0..ROUNDS {
        let fit = fitted(points, &t, knots);
        let spline = fit.0.by_arc_length(knots.max(16) * 2);
        t = feet(points, &spline, &t);
        outcome = Some((spline, fit.1));
    }
    let (spline, dof) = outcome.unwrap_or_else(|| (PeriodicSpline::through(points), n as f64));
    let rss: f64 = points.iter().zip(&t).map(|(p, t)| normal_offset(p, &spline, t * spline.length()).powi(2)).sum();
    let variance = rss / (n as f64 - dof).max(1.0);
    Smoothed { spline, standard_error: (SHARED_NOISE * variance * dof / n as f64).sqrt(), freedom: dof }
}

fn normal_offset(p: &[f64; 2], spline: &PeriodicSpline, s: f64) -> f64 {
    let [x, d, _] = spline.derivatives(s);
    let speed = d[0].hypot(d[1]).max(f64::MIN_POSITIVE);
    ((p[0] - x[0]) * d[1] - (p[1] - x[1]) * d[0]) / speed
}

/// Cumulative chord length of the line averaged over 5 points, as a share of the whole: noise lengthens raw chords.
fn chord_parameters(points: &[[f64; 2]]) -> Vec<f64> {
    let n = points.len();
    let mean = |i: usize| {
        let s = (0..5).fold([0.0; 2], |s, k| {
            let p = points[(i + n + k - 2) % n];
            [s[0] + p[0] / 5.0, s[1] + p[1] / 5.0]
        });
        if n < 12 { points[i] } else { s }
    };
    let mut t = vec![0.0];
    for i in 0..n {
        let (a, b) = (mean(i), mean((i + 1) % n));
        t.push(t[i] + (b[0] - a[0]).hypot(b[1] - a[1]));
    }
    let total = t.pop().unwrap_or(1.0).max(f64::MIN_POSITIVE);
    t.iter().map(|x| x / total).collect()
}

/// Parameters (shares of the length) of the feet of the points, by Newton steps from where they were.
fn feet(points: &[[f64; 2]], spline: &PeriodicSpline, before: &[f64]) -> Vec<f64> {
    let length = spline.length();
    let foot = |(p, t): (&[f64; 2], &f64)| {
        let mut s = t * length;
        for _ in 0..4 {
            let [x, d, dd] = spline.derivatives(s);
            let off = [x[0] - p[0], x[1] - p[1]];
            let slope = off[0] * d[0] + off[1] * d[1];
            let speed = d[0] * d[0] + d[1] * d[1];
            let bend = speed + off[0] * dd[0] + off[1] * dd[1];
            // near a centre of curvature the step is held to Gauss-Newton's
            s -= (slope / bend.max(0.5 * speed).max(f64::MIN_POSITIVE)).clamp(-0.02 * length, 0.02 * length);
        }
        (s / length).rem_euclid(1.0)
    };
    points.iter().zip(before).map(foot).collect()
}

/// The P-spline through points at parameters `t` in [0, 1), and its degrees of freedom.
fn fitted(points: &[[f64; 2]], t: &[f64], knots: usize) -> (PeriodicSpline, f64) {
    let k = knots;
    // normal equations: a = B'B, b = B'x
    let mut a = vec![0.0; k * k];
    let mut b = vec![[0.0; 2]; k];
    let rows: Vec<(usize, [f64; 4])> = t
        .iter()
        .map(|t| {
            let u = (t * k as f64).rem_euclid(k as f64);
            let i = (u as usize).min(k - 1);
            (i, basis(u - i as f64)[0])
        })
        .collect();
    for ((i, w), p) in rows.iter().zip(points) {
        for q in 0..4 {
            let r = (i + k + q - 1) % k;
            b[r][0] += w[q] * p[0];
            b[r][1] += w[q] * p[1];
            for (s, ws) in w.iter().enumerate() {
                a[r * k + (i + k + s - 1) % k] += w[q] * ws;
            }
        }
    }
    let n = points.len() as f64;
    let solve = |log: f64| {
        let lambda = 10.0_f64.powf(log);
        let control = penalised(&a, &b, k, lambda);
        let rss: f64 = rows.iter().zip(points).map(|((i, w), p)| residual(&control, *i, w, p)).sum();
        let dof = degrees_of_freedom(n, k, lambda);
        (rss * n / (n - INFLATION * dof).max(0.05 * n).powi(2), control, dof)
    };
    // GCV over decades, then thirds of a decade around the best
    let coarse: Vec<f64> = (-4..=8).map(f64::from).collect();
    let pick = |grid: &[f64]| {
        let score = |l: &f64| solve(*l).0;
        grid.iter().copied().map(|l| (score(&l), l)).min_by(|a, b| a.0.total_cmp(&b.0)).map_or(0.0, |x| x.1)
    };
    let best = pick(&coarse);
    let best = pick(&[best - 0.67, best - 0.33, best, best + 0.33, best + 0.67]);
    let (_, control, dof) = solve(best);
    (PeriodicSpline::from_control(control, 1.0), dof)
}

fn residual(control: &[[f64; 2]], i: usize, w: &[f64; 4], p: &[f64; 2]) -> f64 {
    let k = control.len();
    let mut off = *p;
    for (q, w) in w.iter().enumerate() {
        let c = control[(i + k + q - 1) % k];
        off[0] -= w * c[0];
        off[1] -= w * c[1];
    }
    off[0] * off[0] + off[1] * off[1]
}

/// Roughness whose null space holds circles: per frequency w of the control points z (z - z_1)^2 with z = 2 - 2 cos w and z_1 that of
/// one turn per circuit. It is the third difference's z^3 for all shapes finer than that, which takes a little off every circle's radius.
fn roughness(k: usize) -> [f64; 4] {
    let one = first_frequency(k);
    [20.0 - 12.0 * one + 2.0 * one * one, -15.0 + 8.0 * one - one * one, 6.0 - 2.0 * one, -1.0]
}

fn first_frequency(k: usize) -> f64 {
    2.0 - 2.0 * (std::f64::consts::TAU / k as f64).cos()
}

/// Solves (A + lambda R) c = b with R the cyclic [`roughness`], by Cholesky.
fn penalised(a: &[f64], b: &[[f64; 2]], k: usize, lambda: f64) -> Vec<[f64; 2]> {
    let rough = roughness(k);
    let mut m = a.to_vec();
    for i in 0..k {
        for (d, c) in rough.into_iter().enumerate() {
            m[i * k + (i + d) % k] += lambda * c;
            if d > 0 {
                m[i * k + (i + k - d) % k] += lambda * c;
            }
        }
    }
    // a trace of the diagonal keeps knots without data solvable
    let tiny = 1e-12 * (1.0 + 20.0 * lambda);
    for j in 0..k {
        m[j * k + j] += tiny;
        for i in 0..j {
            let dot: f64 = (0..i).map(|q| m[j * k + q] * m[i * k + q]).sum();
            m[j * k + i] = (m[j * k + i] - dot) / m[i * k + i];
        }
        let dot: f64 = m[j * k..j * k + j].iter().map(|x| x * x).sum();
        m[j * k + j] = (m[j * k + j] - dot).max(tiny).sqrt();
    }
    let mut c = b.to_vec();
    let part = |c: &[[f64; 2]], range: std::ops::Range<usize>, m: &dyn Fn(usize) -> f64| {
        range.fold([0.0; 2], |s, q| [s[0] + m(q) * c[q][0], s[1] + m(q) * c[q][1]])
    };
    for j in 0..k {
        let dot = part(&c, 0..j, &|q| m[j * k + q]);
        c[j] = [0, 1].map(|x| (c[j][x] - dot[x]) / m[j * k + j]);
    }
    for j in (0..k).rev() {
        let dot = part(&c, j + 1..k, &|q| m[q * k + j]);
        c[j] = [0, 1].map(|x| (c[j][x] - dot[x]) / m[j * k + j]);
    }
    c
}

/// Trace of the smoother for data spread evenly over the parameter, where all matrices are circulant: sum over
/// frequencies of a/(a + lambda p). Marching squares points
/// are even enough for the choice of lambda.
fn degrees_of_freedom(n: f64, k: usize, lambda: f64) -> f64 {
    let (per_knot, one) = (n / k as f64, first_frequency(k));
    (0..k)
        .map(|f| {
            let w = std::f64::consts::TAU * f as f64 / k as f64;
            // symbol of the Gram matrix of the uniform cubic B-spline
            let c = [2416.0, 1191.0, 120.0, 1.0];
            let g = (c[0] + 2.0 * (c[1] * w.cos() + c[2] * (2.0 * w).cos() + c[3] * (3.0 * w).cos())) / 5040.0;
            let a = per_knot * g.max(1e-12);
            let z = 2.0 - 2.0 * w.cos();
            a / (a + lambda * z * (z - one).powi(2))
        })
        .sum()
}

/// Moves the curve outward by the half-maximum shift for blur variances `variance` (mm2 along u and v).
pub(crate) fn corrected(spline: &PeriodicSpline, variance: [f64; 2]) -> PeriodicSpline {
    let knots = spline.knots();
    let points: Vec<[f64; 2]> = (0..knots)
        .map(|k| {
            let [p, d, dd] = spline.derivatives(spline.length() * k as f64 / knots as f64);
            let speed = d[0].hypot(d[1]).max(f64::MIN_POSITIVE);
            // outward: to the right of the direction of travel
            let n = [d[1] / speed, -d[0] / speed];
            let kappa = (d[0] * dd[1] - d[1] * dd[0]) / speed.powi(3);
            let shift = half_maximum_shift(kappa, n, variance);
            [p[0] + shift * n[0], p[1] + shift * n[1]]
        })
        .collect();
    PeriodicSpline::through(&points)
}

/// Grey values near a curve as (signed distance in mm, positive inside; height, 0 outside to 1 inside).
pub(crate) type Profile = Vec<(f64, f64)>;

/// Fewest values of a profile that say something of the blur.
const LEAST_PROFILE: usize = 40;

/// Blur (Gaussian sigma, mm) of a profile: least squares of height = Phi(distance / sigma), by golden section between
/// `low` and `high`. `None` when there are too few values.
pub(crate) fn blur(profile: &Profile, low: f64, high: f64) -> Option<f64> {
    if profile.len() < LEAST_PROFILE {
        return None;
    }
    let misfit = |s: f64| profile.iter().map(|(d, h)| (h - normal_cdf(d / s)).powi(2)).sum::<f64>();
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let (mut a, mut b) = (low, high);
    for _ in 0..30 {
        let (c, d) = (b - golden * (b - a), a + golden * (b - a));
        if misfit(c) < misfit(d) { b = d } else { a = c }
    }
    Some(0.5 * (a + b))
}

/// Standard normal distribution function (Abramowitz and Stegun 7.1.26, absolute error below 1e-7).
pub(crate) fn normal_cdf(x: f64) -> f64 {
    let z = x.abs() / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let poly = [0.254_829_592, -0.284_496_736, 1.421_413_741, -1.453_152_027, 1.061_405_429];
    let erf = 1.0 - poly.iter().rev().fold(0.0, |s, c| (s + c) * t) * (-z * z).exp();
    0.5 * (1.0 + if x < 0.0 { -erf } else { erf })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_smoothing_takes_anything_off_a_circle() {
        for k in [12, 31, 90] {
            let at = |i: usize| std::f64::consts::TAU * i as f64 / k as f64;
            let circle: Vec<[f64; 2]> = (0..k).map(|i| [3.0 * at(i).cos() + 7.0, 3.0 * at(i).sin() - 2.0]).collect();
            let mut identity = vec![0.0; k * k];
            (0..k).for_each(|i| identity[i * k + i] = 1.0);
            let control = penalised(&identity, &circle, k, 1e4);
            let off = control.iter().zip(&circle).map(|(c, p)| (c[0] - p[0]).hypot(c[1] - p[1])).fold(0.0, f64::max);
            assert!(off < 1e-5, "{k} knots: {off}");
        }
    }
}
