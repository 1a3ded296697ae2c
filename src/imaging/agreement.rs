//! Whether a contour agrees with its neighbours: an error that the contour alone cannot show.
//!
//! The spline's standard error sees what scatters about the curve within its plane. Noise that is smooth along the
//! contour (interpolated pixels, a local level that errs) moves or deforms the whole curve and shows only from plane to
//! plane: on a coil-faded aorta contours .9 mm apart differ by 1 mm where their splines say .1, and a function through
//! them folds. So every curve is compared with what its neighbours say, centroids and shapes apart: the cubic through two on
//! either side, so that a vessel which leans, tapers, bends or grows into a junction agrees, or the line through one on
//! either side where there are no more. (Lines alone call the growth of a bifurcation noise: .12 mm where the contours err by
//! .03, and the graft's bands twice too wide.) The median over the curve and its next neighbours along the vessel counts.

use crate::curve::{Curve, Plane};

/// Points compared on a curve.
const SAMPLES: usize = 48;
/// A neighbour has an area between 1 / this and this times the curve's.
const LIKE: f64 = 1.4;
/// Curves up to this many planes away count in the median.
const ALONG: usize = 3;
/// Fewest differences for a median.
const LEAST: usize = 4;

/// A curve's outline about its centroid.
struct Shape {
    /// Radii of the outline at even angles about the centroid, mm.
    radii: Vec<f64>,
    centroid: [f64; 2],
    area: f64,
}

/// Raise each curve's standard error to what its disagreement with its neighbours asks for.
pub(crate) fn widen_errors(curves: &mut [Curve], planes: &[Plane]) {
    let shapes: Vec<Option<Shape>> = curves.iter().map(shape).collect();
    let mut in_plane = vec![Vec::new(); planes.len()];
    for (i, c) in curves.iter().enumerate().filter(|(_, c)| !c.hole) {
        in_plane[c.plane].push(i);
    }
    let like = |i: usize, plane: usize| -> Option<usize> {
        let own = shapes[i].as_ref()?;
        let mut found = in_plane.get(plane)?.iter().copied().filter(|&j| {
            shapes[j].as_ref().is_some_and(|s| {
                let shift = (s.centroid[0] - own.centroid[0]).hypot(s.centroid[1] - own.centroid[1]);
                let ratio = s.area / own.area;
                shift < (own.area.max(s.area)).sqrt() && ratio < LIKE && ratio > 1.0 / LIKE
            })
        });
        found.next().filter(|_| found.next().is_none())
    };
    let before: Vec<Option<usize>> = curves.iter().enumerate().map(|(i, c)| like(i, c.plane.checked_sub(1)?)).collect();
    let after: Vec<Option<usize>> = curves.iter().enumerate().map(|(i, c)| like(i, c.plane + 1)).collect();
    let squares: Vec<Option<f64>> = (0..curves.len())
        .map(|i| {
            let (a, b) = (before[i]?, after[i]?);
            let beyond = before[a].zip(after[b]);
            let others: Vec<usize> =
                [Some(a), Some(b), beyond.map(|o| o.0), beyond.map(|o| o.1)].into_iter().flatten().collect();
            let plane = |j: usize| &planes[curves[j].plane];
            let heights: Vec<f64> =
                others.iter().map(|&j| (plane(j).origin - plane(i).origin).dot(plane(i).normal())).collect();
            let others = others.iter().map(|&j| shapes[j].as_ref()).collect::<Option<Vec<&Shape>>>()?;
            disagreement(shapes[i].as_ref()?, &others, &heights)
        })
        .collect();
    let errors: Vec<f64> = (0..curves.len())
        .map(|i| {
            let walk = |next: &[Option<usize>]| {
                let steps = std::iter::successors(Some(i), |&j| next[j]);
                steps.take(ALONG + 1).skip(1).filter_map(|j| squares[j]).collect::<Vec<f64>>()
            };
            let mut near: Vec<f64> = [walk(&before), walk(&after)].concat();
            near.extend(squares[i]);
            if near.len() < LEAST { 0.0 } else { crate::volume::median(&mut near).sqrt() }
        })
        .collect();
    for (curve, error) in curves.iter_mut().zip(errors) {
        curve.standard_error_mm = curve.standard_error_mm.max(error);
    }
}

fn shape(curve: &Curve) -> Option<Shape> {
    const SIDES: usize = 192;
    if curve.hole || !curve.border.is_empty() {
        return None;
    }
    let length = curve.length_mm();
    let outline: Vec<[f64; 2]> =
        (0..SIDES).map(|k| curve.spline.derivatives(k as f64 * length / SIDES as f64)[0]).collect();
    let (mut area, mut moment) = (0.0, [0.0; 2]);
    for (k, p) in outline.iter().enumerate() {
        let q = outline[(k + 1) % SIDES];
        let cross = 0.5 * (p[0] * q[1] - p[1] * q[0]);
        area += cross;
        (0..2).for_each(|a| moment[a] += cross * (p[a] + q[a]) / 3.0);
    }
    if area <= 0.0 {
        return None;
    }
    let centroid = moment.map(|m| m / area);
    // not star-shaped about its centroid: two lumens about to part
    let angle = |p: &[f64; 2]| (p[1] - centroid[1]).atan2(p[0] - centroid[0]);
    let mut polar: Vec<(f64, f64)> =
        outline.iter().map(|p| (angle(p), (p[0] - centroid[0]).hypot(p[1] - centroid[1]))).collect();
    let start = (0..SIDES).min_by(|&a, &b| polar[a].0.total_cmp(&polar[b].0))?;
    polar.rotate_left(start);
    if polar.windows(2).any(|w| w[1].0 <= w[0].0) {
        return None;
    }
    let tau = std::f64::consts::TAU;
    let (first, last) = (polar[0], polar[SIDES - 1]);
    polar.insert(0, (last.0 - tau, last.1));
    polar.push((first.0 + tau, first.1));
    let mut k = 0;
    let radii = (0..SAMPLES)
        .map(|i| {
            let wanted = tau * ((i as f64 + 0.5) / SAMPLES as f64 - 0.5);
            while polar[k + 1].0 < wanted {
                k += 1;
            }
            let t = (wanted - polar[k].0) / (polar[k + 1].0 - polar[k].0);
            polar[k].1 + t * (polar[k + 1].1 - polar[k].1)
        })
        .collect();
    Some(Shape { radii, centroid, area })
}

/// Variance of a curve's position that explains its difference from the polynomial through others, mm^2. `heights` are the
/// distances of their planes from the curve's along its normal.
fn disagreement(own: &Shape, others: &[&Shape], heights: &[f64]) -> Option<f64> {
    // Lagrange's weights at height 0
    let weights: Vec<f64> = (0..heights.len())
        .map(|k| {
            let factor = |j: usize| -heights[j] / (heights[k] - heights[j]);
            (0..heights.len()).filter(|&j| j != k).map(factor).product()
        })
        .collect();
    if !weights.iter().all(|w| w.is_finite()) {
        return None;
    }
    let off = |of: &dyn Fn(&Shape) -> f64| others.iter().zip(&weights).fold(of(own), |d, (o, w)| d - w * of(o));
    // a shift of the centroid shows in the curve's normal direction by its cosine: half of its square
    let shift = (0..2).map(|k| off(&|s| s.centroid[k]).powi(2)).sum::<f64>();
    let shape = (0..SAMPLES).map(|k| off(&|s| s.radii[k]).powi(2)).sum::<f64>() / SAMPLES as f64;
    Some((0.5 * shift + shape) / weights.iter().fold(1.0, |s, w| s + w * w))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disc of radius `r` about `centre`, its outline moved by `wave` once around.
    fn disc(centre: [f64; 2], r: f64, wave: f64) -> Shape {
        let angle = |i: usize| std::f64::consts::TAU * ((i as f64 + 0.5) / SAMPLES as f64 - 0.5);
        let radii = (0..SAMPLES).map(|i| r + wave * (3.0 * angle(i)).cos()).collect();
        Shape { radii, centroid: centre, area: std::f64::consts::PI * r * r }
    }

    #[test]
    fn a_leaning_tapering_vessel_agrees_and_a_moved_or_deformed_curve_does_not() {
        let at = |k: f64| disc([1.5 * k, -0.4 * k], 5.0 + 0.1 * k, 0.0);
        let agreed = disagreement(&at(0.0), &[&at(-1.0), &at(2.0)], &[-1.0, 2.0]);
        assert!(agreed.is_some_and(|v| v < 1e-20), "{agreed:?}");
        // of three curves with independent shifts of variance v per coordinate, the second differs from the mean of the
        // others by 1.5 v
        let still = disc([0.0; 2], 5.0, 0.0);
        let v = disagreement(&disc([0.3, 0.0], 5.0, 0.0), &[&still, &still], &[-1.0, 1.0]);
        assert!(v.is_some_and(|v| (v - 0.5 * 0.09 / 1.5).abs() < 1e-12), "{v:?}");
        let v = disagreement(&disc([0.0; 2], 5.0, 0.2), &[&still, &still], &[-1.0, 1.0]);
        assert!(v.is_some_and(|v| (v - 0.5 * 0.04 / 1.5).abs() < 1e-12), "{v:?}");
    }

    #[test]
    fn a_vessel_that_bends_and_grows_into_a_junction_agrees_with_two_neighbours_on_either_side() {
        let at = |k: f64| disc([0.3 * k * k, 0.05 * k.powi(3)], 5.0 + 0.2 * k * k, 0.02 * k * k);
        let [a, b, c, d] = [-2.0, -1.0, 1.0, 3.0].map(at);
        let agreed = disagreement(&at(0.0), &[&b, &c, &a, &d], &[-1.0, 1.0, -2.0, 3.0]);
        assert!(agreed.is_some_and(|v| v < 1e-20), "{agreed:?}");
        // weights of the cubic through even neighbours: -1/6, 2/3, 2/3, -1/6
        let still = disc([0.0; 2], 5.0, 0.0);
        let v = disagreement(&disc([0.3, 0.0], 5.0, 0.0), &[&still; 4], &[-1.0, 1.0, -2.0, 2.0]);
        assert!(v.is_some_and(|v| (v - 0.5 * 0.09 / (1.0 + 34.0 / 36.0)).abs() < 1e-12), "{v:?}");
    }
}
