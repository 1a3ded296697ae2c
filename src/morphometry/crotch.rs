//! How far the lumens of two branches overlap.
//!
//! For round and straight tubes there is a formula. Arteries that leave a trunk side by side and bend apart part sooner than
//! tubes along their later axes would: then the lumen itself tells where. Of the two the smaller is taken, so that a
//! rounded crotch and its noise do not push out a window that the tubes would allow.

use crate::line::Polyline;
use implicit::Field;
use space::P3;

/// Distance from the meeting point of two axes within which their lumens (round tubes of radii a and b, axes at
/// `angle`, radians) overlap: the further of the two points where the wall lines cross, (r_b + r_a cos) / sin along a's
/// axis; for equal radii r / tan(angle / 2). Beyond a right angle at most the larger radius, so that a pair that runs
/// straight on, which has no crotch, does not claim one.
pub fn crotch_distance(angle: f64, radius_a_mm: f64, radius_b_mm: f64) -> f64 {
    let [a, b] = overlaps(angle, radius_a_mm, radius_b_mm);
    a.max(b)
}

/// As [`crotch_distance`], along each of the two axes: the mouth of a thin branch is short along a wide vessel, and the
/// way out of the wide vessel is long along the thin one.
pub(crate) fn overlaps(angle: f64, radius_a: f64, radius_b: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    let larger = radius_a.max(radius_b);
    [[radius_a, radius_b], [radius_b, radius_a]].map(|[own, other]| {
        let exact = ((other + own * cos) / sin).max(0.0);
        if cos > 0.0 && sin > 0.0 {
            exact
        } else if sin > 1e-9 {
            exact.min(larger)
        } else {
            larger
        }
    })
}

/// Points of a line of sight that are looked at.
const LOOKS: usize = 48;
/// Step outward, mm; the last line of sight is then found by bisection.
const STEP_MM: f64 = 0.25;

/// The point of the crotch between two legs, as the lumen has it: where the last line of sight between points at equal
/// distances along the two grazes the wall. The search begins at `from` mm, where they must see each other, and ends at
/// `to`; `None` when they do not part within it.
pub(crate) fn divider(field: &dyn Field, legs: [&Polyline; 2], from: f64, to: f64) -> Option<P3> {
    let pair = |s: f64| Some([P3::from_raw(legs[0].at(s)?), P3::from_raw(legs[1].at(s)?)]);
    let lowest = |[a, b]: [P3; 2]| {
        let looked = (0..=LOOKS).map(|i| a.lerp(b, i as f64 / LOOKS as f64)).map(|x| (field.value(x), x));
        looked.min_by(|x, y| x.0.total_cmp(&y.0))
    };
    let seen = |s: f64| Some(lowest(pair(s)?)?.0 > 0.0);
    let (mut low, mut high) = (from, from);
    if !seen(from)? {
        return None;
    }
    while seen(high)? {
        low = high;
        high += STEP_MM;
        if high > to {
            return None;
        }
    }
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if seen(middle)? { low = middle } else { high = middle }
    }
    lowest(pair(low)?).map(|(_, x)| x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_tubes_part_at_r_over_tan_half_the_angle() {
        for degrees in [20.0f64, 45.0, 90.0] {
            let theta = degrees.to_radians();
            let expected = 3.0 / (0.5 * theta).tan();
            assert!((crotch_distance(theta, 3.0, 3.0) - expected).abs() < 1e-12);
        }
    }

    #[test]
    fn a_straight_pair_of_unequal_tubes_claims_no_crotch_beyond_its_radius() {
        assert!(crotch_distance(3.1, 3.0, 2.5) <= 3.0);
        assert!((crotch_distance(std::f64::consts::PI, 3.0, 2.5) - 3.0).abs() < 1e-9);
    }

    #[test]
    fn the_crotch_of_unequal_tubes_is_where_their_walls_cross() {
        let theta = 60.0f64.to_radians();
        let s = crotch_distance(theta, 4.0, 2.0);
        // along the thinner tube's axis, the point of its wall on the side of the thicker one lies on the thicker wall
        let wall = s * theta.sin() - 2.0 * theta.cos();
        assert!((wall - 4.0).abs() < 1e-12);
    }

    #[test]
    fn a_thin_branch_at_a_right_angle_opens_a_mouth_of_its_own_radius_in_a_wide_vessel() {
        let [wide, thin] = overlaps(std::f64::consts::FRAC_PI_2, 10.0, 2.0);
        assert!((wide - 2.0).abs() < 1e-12);
        assert!((thin - 10.0).abs() < 1e-12);
    }
}
