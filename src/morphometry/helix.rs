//! A helix through the medial line of one branch: curvature and signed torsion of the whole vessel as two numbers.
//!
//! The curve of constant curvature k and torsion t through p0 with tangent T and Darboux vector w = t T + k B is
//! p(s) = p0 + T s + (w x T)(1 - cos |w|s)/|w|^2 + w x (w x T)(|w|s - sin |w|s)/|w|^3,
//! which is smooth through k = 0 and t = 0, unlike axis, radius and pitch. Eight parameters: p0 (3), the frame (3), k and
//! t; sliding p0 along the curve changes nothing, so seven are fitted. Residuals are the distances at right angles to
//! the curve, weighted by Tukey's biweight, minimised by Levenberg and Marquardt (More 1978). Frenet's formulas on
//! differences of the line were rejected: their torsion has a standard deviation of 18 times the value.

use crate::linear::{median, positive, solve};
use space::{DMat3, DVec3, P3};

use crate::types::{CurveKind, Helix};

/// A branch that bends by less than this in all, radians, is as good as straight: its plane of bending, and with it
/// the torsion, is not told by points with an error of a hundredth of the radius.
const BEND_MIN: f64 = 0.35;
/// The points must lie this many times further (root mean square) from the best straight line than from the helix. A
/// tight helix follows some of a short line of pure noise, so that 1 is not enough; the value is not yet swept.
const STRAIGHT_RATIO: f64 = 3.0;
/// Fewest points.
const POINTS_MIN: usize = 12;
/// Largest standard error of the torsion, in units of sqrt(k^2 + t^2).
const TORSION_ERROR_MAX: f64 = 0.2;

const FREE: usize = 7;

/// Start point, orthonormal frame, curvature and torsion.
#[derive(Clone, Copy, Debug)]
struct Curve {
    start: DVec3,
    tangent: DVec3,
    normal: DVec3,
    curvature: f64,
    torsion: f64,
}

impl Curve {
    fn binormal(&self) -> DVec3 {
        self.tangent.cross(self.normal)
    }

    /// Position and unit tangent at arc length `s` from the start.
    fn at(&self, s: f64) -> (DVec3, DVec3) {
        let w = self.tangent * self.torsion + self.binormal() * self.curvature;
        let (rate, x) = (w.length(), w.length() * s);
        // (1 - cos x)/w^2 , (x - sin x)/w^3 and sin x / w by series where they would cancel
        let (c1, c2, c3) = if x.abs() < 1e-2 {
            let q = x * x;
            (
                s * (1.0 - q / 6.0 + q * q / 120.0),
                s * s * (0.5 - q / 24.0 + q * q / 720.0),
                s * s * s * (1.0 / 6.0 - q / 120.0 + q * q / 5040.0),
            )
        } else {
            (x.sin() / rate, (1.0 - x.cos()) / (rate * rate), (x - x.sin()) / (rate * rate * rate))
        };
        let (a, b) = (w.cross(self.tangent), w.cross(w.cross(self.tangent)));
        (self.start + self.tangent * s + a * c2 + b * c3, self.tangent + a * c1 + b * c2)
    }

    /// Moved by the seven parameters: start along normal and binormal, rotation about the three axes, curvature, torsion.
    fn moved(&self, step: &[f64; FREE]) -> Self {
        let (t, n, b) = (self.tangent, self.normal, self.binormal());
        let turn = t * step[2] + n * step[3] + b * step[4];
        let rotation = turn.try_normalize().map_or(DMat3::IDENTITY, |axis| DMat3::from_axis_angle(axis, turn.length()));
        let tangent = (rotation * t).normalize();
        let normal = (rotation * n).reject_from_normalized(tangent).normalize();
        Self {
            start: self.start + n * step[0] + b * step[1],
            tangent,
            normal,
            curvature: self.curvature + step[5],
            torsion: self.torsion + step[6],
        }
    }

    /// Arc length of the point of the curve nearest to `p`, from a guess.
    fn foot(&self, p: DVec3, guess: f64) -> f64 {
        const TURNS: usize = 12;
        let mut s = guess;
        for _ in 0..TURNS {
            let (q, t) = self.at(s);
            let ahead = (p - q).dot(t);
            s += ahead;
            if ahead.abs() < 1e-13 * (1.0 + s.abs()) {
                break;
            }
        }
        s
    }
}

/// A fit with the arc lengths of its foot points.
struct State {
    curve: Curve,
    foot: Vec<f64>,
    residual: Vec<DVec3>,
}

impl State {
    fn new(curve: Curve, points: &[DVec3], guess: &[f64]) -> Self {
        let foot: Vec<f64> = points.iter().zip(guess).map(|(&p, &s)| curve.foot(p, s)).collect();
        let residual = points.iter().zip(&foot).map(|(&p, &s)| p - curve.at(s).0).collect();
        Self { curve, foot, residual }
    }

    fn cost(&self, weight: &[f64]) -> f64 {
        self.residual.iter().zip(weight).map(|(r, w)| w * r.length_squared()).sum()
    }

    /// Weighted normal matrix and right side in parameters scaled by `unit`, without the components along the curve.
    fn normal(&self, weight: &[f64], unit: &[f64; FREE]) -> ([[f64; FREE]; FREE], [f64; FREE]) {
        const STEP: f64 = 1e-5; // central differences: error 1e-10 of the scaled derivative
        let mut shifted = [[self.curve; 2]; FREE];
        for (k, pair) in shifted.iter_mut().enumerate() {
            for (curve, sign) in pair.iter_mut().zip([-1.0, 1.0]) {
                let mut step = [0.0; FREE];
                step[k] = sign * STEP * unit[k];
                *curve = self.curve.moved(&step);
            }
        }
        let (mut a, mut b) = ([[0.0; FREE]; FREE], [0.0; FREE]);
        for ((&s, r), w) in self.foot.iter().zip(&self.residual).zip(weight) {
            let t = self.curve.at(s).1;
            let column = shifted
                .map(|[lo, hi]| ((hi.at(s).0 - lo.at(s).0) / (2.0 * STEP)).reject_from_normalized(t.normalize()));
            for i in 0..FREE {
                b[i] += w * column[i].dot(*r);
                for j in 0..FREE {
                    a[i][j] += w * column[i].dot(column[j]);
                }
            }
        }
        (a, b)
    }
}

/// The helix nearest to the points of one branch, in order along it; `None` when the branch has fewer than 12 points,
/// bends by less than .35 rad in all, is not 3 times nearer to the helix than to a straight line, or leaves the torsion uncertain by more
/// than a fifth of sqrt(k^2 + t^2). Cost: some tens of passes, each 15 curve points per sample.
pub fn fit_helix(points: &[P3]) -> Option<Helix> {
    fitted(points).map(|f| f.helix)
}

/// A helix with the curve behind it, from which a line that differs by a little is fitted in a few turns.
#[derive(Clone, Debug)]
pub(crate) struct FittedHelix {
    pub(crate) helix: Helix,
    curve: Curve,
    foot: Vec<f64>,
}

impl FittedHelix {
    /// Curvature and torsion of the helix nearest to other points of the same branch, as many as were fitted.
    pub(crate) fn refitted(&self, points: &[P3]) -> [f64; 2] {
        let points: Vec<DVec3> = points.iter().map(|p| p.raw()).collect();
        let length = self.foot[self.foot.len() - 1] - self.foot[0];
        let (state, _) = descend(State::new(self.curve, &points, &self.foot), &points, length.abs());
        [state.curve.curvature.abs(), state.curve.torsion]
    }
}

/// See [`fit_helix`].
pub(crate) fn fitted(points: &[P3]) -> Option<FittedHelix> {
    if points.len() < POINTS_MIN {
        return None;
    }
    let points: Vec<DVec3> = points.iter().map(|p| p.raw()).collect();
    let s = crate::line::arc_length(&points);
    let length = s[s.len() - 1];
    if !positive(length) {
        return None;
    }
    let (curve, middle) = start(&points, &s)?;
    let guess: Vec<f64> = s.iter().map(|x| x - middle).collect();
    let mut best: Option<(f64, State, Vec<f64>)> = None;
    for torsion in [curve.torsion, 0.0, -curve.torsion] {
        let state = descend(State::new(Curve { torsion, ..curve }, &points, &guess), &points, length);
        let (state, weight) = state;
        let cost = median(state.residual.iter().map(|r| r.length()).collect())?;
        if best.as_ref().is_none_or(|b| cost < b.0) {
            best = Some((cost, state, weight));
        }
    }
    let (_, state, weight) = best?;
    let helix = report(&state, &weight, &points, length)?;
    Some(FittedHelix { helix, curve: state.curve, foot: state.foot })
}

/// Natural units of the seven parameters for a line of some length, which make the normal matrix well scaled.
fn units(length: f64) -> [f64; FREE] {
    [length, length, 1.0, 1.0, 1.0, 1.0 / length, 1.0 / length]
}

fn descend(mut state: State, points: &[DVec3], length: f64) -> (State, Vec<f64>) {
    const TURNS: usize = 80;
    const TUKEY: f64 = 4.685;
    let unit = units(length);
    let mut weight = vec![1.0; points.len()];
    let mut damping = 1e-3;
    for turn in 0..TURNS {
        if turn >= 5 {
            // weights once the fit has come near; the floor keeps an exact curve from judging its rounding errors
            let distance: Vec<f64> = state.residual.iter().map(|r| r.length()).collect();
            let scale = (1.4826 * median(distance.clone()).unwrap_or(0.0)).max(1e-6 * length);
            for (w, d) in weight.iter_mut().zip(&distance) {
                let x = d / (TUKEY * scale);
                *w = if x < 1.0 { (1.0 - x * x).powi(2) } else { 0.0 };
            }
        }
        let (mut a, b) = state.normal(&weight, &unit);
        for (i, row) in a.iter_mut().enumerate() {
            row[i] += damping * row[i] + 1e-15 * length * length;
        }
        let Some(step) = solve(a, b) else { break };
        let scaled: [f64; FREE] = std::array::from_fn(|i| step[i] * unit[i]);
        let next = State::new(state.curve.moved(&scaled), points, &state.foot);
        if next.cost(&weight) <= state.cost(&weight) {
            state = next;
            damping = (damping * 0.1).max(1e-12);
            if turn > 8 && step.iter().all(|x| x.abs() < 1e-13) {
                break;
            }
        } else {
            damping *= 10.0;
            if damping > 1e12 {
                break;
            }
        }
    }
    (state, weight)
}

/// A first curve at the middle point: tangents by local regression, and the Darboux vector that turns them best,
/// T' = w x T, a linear least squares problem that also holds over many turns.
fn start(points: &[DVec3], s: &[f64]) -> Option<(Curve, f64)> {
    let n = points.len();
    let ones = vec![1.0; n];
    let line = crate::line::Samples { s, points, weight: &ones };
    let length = s[n - 1];
    let half = (length / 6.0).max(6.0 * length / (n - 1) as f64);
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    let mut at_middle = None;
    for (k, &at) in s.iter().enumerate() {
        let Some(fit) = line.local::<4>(at, half) else { continue };
        let Some(t) = fit.first.try_normalize() else { continue };
        let turning = (fit.second / fit.first.length_squared()).reject_from_normalized(t);
        a += DMat3::IDENTITY - crate::linear::outer(t, 1.0);
        b += t.cross(turning);
        if k == n / 2 {
            at_middle = Some((fit.position, t));
        }
    }
    let (position, tangent) = at_middle?;
    // a straight line leaves the component along it free: a small ridge keeps that at zero
    let ridge = 1e-6 * n as f64;
    let w = (a + DMat3::from_diagonal(DVec3::splat(ridge))).inverse() * b;
    let side = w.cross(tangent);
    let normal = side.try_normalize().unwrap_or_else(|| tangent.any_orthonormal_vector());
    let curve = Curve { start: position, tangent, normal, curvature: side.length(), torsion: w.dot(tangent) };
    w.is_finite().then_some((curve, s[n / 2]))
}

/// Root mean square distance of weighted points from their best straight line.
fn straight_rms(points: &[DVec3], weight: &[f64]) -> f64 {
    let total: f64 = weight.iter().sum();
    let weighted = points.iter().zip(weight);
    let mean = weighted.clone().fold(DVec3::ZERO, |m, (p, w)| m + *p * *w) / total;
    let spread = weighted.fold(DMat3::ZERO, |m, (p, w)| m + crate::linear::outer(*p - mean, w / total));
    let [(a, _), (b, _), _] = crate::linear::eigen3(spread);
    (a + b).max(0.0).sqrt()
}

fn report(state: &State, weight: &[f64], points: &[DVec3], length: f64) -> Option<Helix> {
    let (k, t) = (state.curve.curvature.abs(), state.curve.torsion);
    let total: f64 = weight.iter().sum();
    let rms = (state.cost(weight) / total).sqrt();
    if k * length < BEND_MIN || straight_rms(points, weight) < STRAIGHT_RATIO * rms {
        return None;
    }
    let unit = units(length);
    let (a, _) = state.normal(weight, &unit);
    let mut last = [0.0; FREE];
    last[FREE - 1] = 1.0;
    let variance = solve(a, last)?[FREE - 1] * (unit[FREE - 1] * rms).powi(2);
    let total_turn = k * k + t * t;
    if !positive(TORSION_ERROR_MAX * total_turn.sqrt() - variance.max(0.0).sqrt()) {
        return None;
    }
    Some(Helix {
        radius_mm: k / total_turn,
        pitch_mm: std::f64::consts::TAU * t.abs() / total_turn,
        curvature_per_mm: k,
        torsion_per_mm: t,
        rms_mm: rms,
        enough: simplest(state, weight, points, length),
        curvature_band95: None,
        torsion_band95: None,
    })
}

/// Samples along a medial line that count as one observation: neighbouring sections share their contours, a diameter of
/// 16 sections a few of them.
const SHARED_SAMPLES: f64 = 8.0;

/// The curve of least n log(rms^2) + k log n (Schwarz 1978), with n the independent samples, of a line (4 parameters), an
/// arc (6) and a helix (7).
fn simplest(state: &State, weight: &[f64], points: &[DVec3], length: f64) -> CurveKind {
    let total: f64 = weight.iter().sum();
    let n = (points.len() as f64 / SHARED_SAMPLES).max(2.0);
    let flat = State::new(Curve { torsion: 0.0, ..state.curve }, points, &state.foot);
    let arc = descend_arc(flat, points, weight, length);
    let square = [
        (CurveKind::Line, straight_rms(points, weight).powi(2), 4.0),
        (CurveKind::Arc, arc.cost(weight) / total, 6.0),
        (CurveKind::Helix, state.cost(weight) / total, 7.0),
    ];
    // exact curves differ by rounding alone
    let floor = (1e-7 * length).powi(2);
    let score = |(_, square, parameters): &(CurveKind, f64, f64)| n * square.max(floor).ln() + parameters * n.ln();
    square.iter().min_by(|a, b| score(a).total_cmp(&score(b))).map_or(CurveKind::Helix, |s| s.0)
}

/// The nearest arc: the torsion stays 0, the weights as they are.
fn descend_arc(mut state: State, points: &[DVec3], weight: &[f64], length: f64) -> State {
    const TURNS: usize = 40;
    let unit = units(length);
    let mut damping = 1e-3;
    for _ in 0..TURNS {
        let (mut a, mut b) = state.normal(weight, &unit);
        for (i, row) in a.iter_mut().enumerate() {
            row[i] += damping * row[i] + 1e-15 * length * length;
            row[FREE - 1] = 0.0;
        }
        a[FREE - 1] = [0.0; FREE];
        (a[FREE - 1][FREE - 1], b[FREE - 1]) = (1.0, 0.0);
        let Some(step) = solve(a, b) else { break };
        let next = State::new(state.curve.moved(&std::array::from_fn(|i| step[i] * unit[i])), points, &state.foot);
        if next.cost(weight) > state.cost(weight) {
            damping *= 10.0;
            if damping > 1e9 {
                break;
            }
            continue;
        }
        state = next;
        damping = (damping * 0.1).max(1e-12);
        if step.iter().all(|x| x.abs() < 1e-12) {
            break;
        }
    }
    state
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A helix of given curvature and torsion, turned and shifted, with deterministic noise.
    fn helix(k: f64, t: f64, length: f64, noise: f64) -> Vec<P3> {
        let w2 = k * k + t * t;
        let (r, c, w) = (k / w2, t / w2, w2.sqrt());
        let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 0.5).normalize(), 0.7);
        let mut seed = 12345u64;
        let mut random = move || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((seed >> 11) as f64 / (1u64 << 53) as f64 - 0.5) * 12f64.sqrt()
        };
        let count = (length / 0.375) as usize;
        (0..=count)
            .map(|i| {
                let s = length * i as f64 / count as f64;
                let p = DVec3::new(r * (w * s).cos(), r * (w * s).sin(), c * w * s);
                let e = DVec3::new(random(), random(), random()) * noise;
                P3::from_raw(turn * p + DVec3::new(-200.0, 50.0, 30.0) + e)
            })
            .collect()
    }

    #[test]
    fn an_exact_helix_is_met_to_rounding() {
        for (k, t, length) in [(0.049, 0.033, 60.0), (0.1, -0.08, 150.0), (0.03, 0.0, 50.0)] {
            let h = fit_helix(&helix(k, t, length, 0.0)).unwrap();
            assert!((h.curvature_per_mm - k).abs() < 1e-8, "{h:?}");
            assert!((h.torsion_per_mm - t).abs() < 1e-8, "{h:?}");
            assert!(h.rms_mm < 1e-8);
        }
    }

    #[test]
    fn noise_of_a_hundredth_of_a_millimetre_moves_the_torsion_by_less_than_a_fifth_of_a_per_cent() {
        let h = fit_helix(&helix(0.049, 0.033, 80.0, 0.01)).unwrap();
        assert!((h.torsion_per_mm / 0.033 - 1.0).abs() < 2e-3, "{h:?}");
        assert!((h.curvature_per_mm / 0.049 - 1.0).abs() < 2e-3, "{h:?}");
        assert!(
            (h.pitch_mm / (std::f64::consts::TAU * 0.033 / (0.049f64.powi(2) + 0.033f64.powi(2))) - 1.0).abs() < 4e-3
        );
    }

    #[test]
    fn the_information_criterion_tells_a_helix_from_an_arc() {
        use crate::types::CurveKind;
        let kind = |k: f64, t: f64, noise: f64| fit_helix(&helix(k, t, 60.0, noise)).unwrap().enough;
        assert_eq!(kind(0.049, 0.033, 0.02), CurveKind::Helix);
        assert_eq!(kind(0.03, 0.0, 0.02), CurveKind::Arc);
        assert_eq!(kind(0.03, 0.0, 0.0), CurveKind::Arc);
    }

    #[test]
    fn a_few_points_that_were_pulled_off_do_not_count() {
        let mut points = helix(0.049, 0.033, 80.0, 0.01);
        for i in [20, 21, 22, 90] {
            points[i] += space::V3::new(0.8, -0.5, 0.3);
        }
        let h = fit_helix(&points).unwrap();
        assert!((h.torsion_per_mm / 0.033 - 1.0).abs() < 3e-3, "{h:?}");
    }

    #[test]
    fn a_straight_or_short_branch_has_no_helix() {
        assert!(fit_helix(&helix(1e-4, 1e-4, 40.0, 0.01)).is_none());
        assert!(fit_helix(&helix(0.05, 0.03, 3.0, 0.01)).is_none());
        assert!(fit_helix(&helix(0.049, 0.033, 10.0, 0.3)).is_none());
    }

    #[test]
    fn the_helix_does_not_depend_on_the_direction_of_travel() {
        let mut points = helix(0.049, -0.033, 60.0, 0.02);
        let a = fit_helix(&points).unwrap();
        points.reverse();
        let b = fit_helix(&points).unwrap();
        assert!((a.torsion_per_mm - b.torsion_per_mm).abs() < 1e-9, "{a:?} {b:?}");
        assert!((a.curvature_per_mm - b.curvature_per_mm).abs() < 1e-9);
    }
}
