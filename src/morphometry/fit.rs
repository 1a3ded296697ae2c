//! Straight lines through points, and the point where several lines meet.
//!
//! Total least squares (the first principal axis) with Tukey's biweight, iterated to a standstill (Huber and Ronchetti
//! 2009): a medial line has errors at a right angle to itself in every direction, and a few points that a side branch or
//! a plaque has pulled off. Ordinary regression on one coordinate is biased when the vessel is oblique.

use crate::linear::{eigen3, median, outer, positive};
use space::{DMat3, DVec3, P3, V3};

/// Tukey's constant: 95 % efficiency for normal errors.
const TUKEY: f64 = 4.685;
/// Residuals below this, mm, are never outliers: a thousandth of a fine voxel.
const SCALE_FLOOR_MM: f64 = 1e-3;

/// A fitted straight line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLine {
    /// Weighted mean of the points.
    pub point: P3,
    /// Unit direction, from the first point towards the last.
    pub direction: V3,
    /// Root mean square distance of the points from it (robust weights), mm.
    pub rms_mm: f64,
}

/// The robust total least squares line through weighted points; `None` with fewer than three weighted points or when
/// they coincide. Cost: a few dozen passes over the points.
pub fn fit_line(points: &[(P3, f64)]) -> Option<FittedLine> {
    const TURNS: usize = 200;
    let points: Vec<(DVec3, f64)> = points.iter().filter(|p| p.1 > 0.0).map(|&(p, w)| (p.raw(), w)).collect();
    if points.len() < 3 {
        return None;
    }
    let towards = points[points.len() - 1].0 - points[0].0;
    let mut robust = vec![1.0; points.len()];
    let mut line = principal(&points, &robust, towards)?;
    for _ in 0..TURNS {
        let distance: Vec<f64> =
            points.iter().map(|&(p, _)| (p - line.0).reject_from_normalized(line.1).length()).collect();
        let scale = (1.4826 * median(distance.clone())?).max(SCALE_FLOOR_MM);
        for (w, d) in robust.iter_mut().zip(&distance) {
            let x = d / (TUKEY * scale);
            *w = if x < 1.0 { (1.0 - x * x).powi(2) } else { 0.0 };
        }
        let next = principal(&points, &robust, towards)?;
        let still = next.1.distance(line.1) < 1e-14 && next.0.distance(line.0) < 1e-13 * (1.0 + next.0.length());
        line = next;
        if still {
            break;
        }
    }
    Some(FittedLine { point: P3::from_raw(line.0), direction: V3::from_raw(line.1), rms_mm: line.2 })
}

fn principal(points: &[(DVec3, f64)], robust: &[f64], towards: DVec3) -> Option<(DVec3, DVec3, f64)> {
    let total: f64 = points.iter().zip(robust).map(|(p, r)| p.1 * r).sum();
    // differences from the first point keep digits far from the origin
    let base = points[0].0;
    let mean = points.iter().zip(robust).fold(DVec3::ZERO, |m, (p, r)| m + (p.0 - base) * (p.1 * r)) / total;
    let spread = points.iter().zip(robust).fold(DMat3::ZERO, |m, (p, r)| m + outer(p.0 - base - mean, p.1 * r / total));
    let [(a, _), (b, _), (c, axis)] = eigen3(spread);
    if !positive(c) || !positive(total) {
        return None;
    }
    let axis = if axis.dot(towards) < 0.0 { -axis } else { axis };
    Some((base + mean, axis.normalize(), (a + b).max(0.0).sqrt()))
}

/// Smallest eigenvalue of the lines' normal matrix: two lines must be 18 degrees off parallel, or a third 13 degrees off
/// two that run straight on. At 11 degrees an error of .1 mm in a line already moves the point by half a millimetre, and
/// lines bent by a joining lumen send it 20 mm along the host.
const MEETING_MIN: f64 = 0.05;

/// The point with the least sum of squared distances to some lines; `None` when they are too nearly parallel to tell
/// (two lines within 18 degrees).
pub fn meeting_point(lines: &[FittedLine]) -> Option<P3> {
    let base = lines.first()?.point.raw();
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for line in lines {
        let d = line.direction.raw();
        let m = DMat3::IDENTITY - outer(d, 1.0);
        a += m;
        b += m * (line.point.raw() - base);
    }
    (eigen3(a)[0].0 > MEETING_MIN).then(|| P3::from_raw(base + a.inverse() * b))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn outliers_do_not_turn_the_line() {
        let d = V3::new(1.0, 2.0, -0.5).normalised().unwrap();
        let points: Vec<(P3, f64)> = (0..40)
            .map(|i| {
                let wobble = V3::new(0.0, 0.01 * f64::from(i * 7 % 5 - 2), 0.01 * f64::from(i * 3 % 5 - 2));
                let jump = if i % 13 == 0 { V3::new(0.0, 0.0, 1.5) } else { V3::ZERO };
                (P3::new(100.0, -40.0, 7.0) + d * f64::from(i) * 0.4 + wobble + jump, 1.0)
            })
            .collect();
        let line = fit_line(&points).unwrap();
        assert!(line.direction.angle_to(d).to_degrees() < 0.05, "{}", line.direction.angle_to(d).to_degrees());
        assert!(line.rms_mm < 0.03);
    }

    #[test]
    fn lines_meet_where_they_were_drawn_from() {
        let at = P3::new(3.0, 4.0, 5.0);
        let line = |d: V3| FittedLine { point: at + d * 7.0, direction: d.normalised().unwrap(), rms_mm: 0.0 };
        let lines = [line(V3::X), line(V3::new(1.0, 1.0, 0.2)), line(V3::new(-1.0, 0.1, 0.0))];
        assert!(meeting_point(&lines).unwrap().distance(at) < 1e-12);
        assert!(meeting_point(&[lines[0], lines[0]]).is_none());
    }
}
