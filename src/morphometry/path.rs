//! The line that VMTK takes through a junction: of all that join two ends the one with the least integral of ds / R, R the
//! distance to the wall. It lies on the medial surface where the lumens overlap and passes wide of the medial graph's node,
//! whose place there says little. Found by descent from our own line, coarse steps first.

use crate::section::Lumen;
use crate::vmtk::Ball;
use space::{DVec3, P3, V3};

/// Steps of the line, shares of the radius, and turns of the descent at each.
const LEVELS: [(f64, usize); 2] = [(0.5, 60), (0.2, 60)];
/// Descent at each turn, shares of the step.
const RATE: f64 = 0.3;
/// Longest move of a turn, shares of the step: longer ones leave the lumen at the crotch.
const LONGEST: f64 = 0.15;
/// Turns between two resamplings.
const EVEN_TURNS: usize = 20;
/// Sharpness of the distance's minimum over wall points, times the radius: rounds its ridge over a thirtieth of it.
const SHARPNESS: f64 = 36.0;
/// Directions of the rays that find the wall from a ball.
const RAYS: usize = 256;
/// Distance of the balls that they start from, radii.
const RAYS_APART: f64 = 0.25;
/// How far from the junction the line is changed, radii.
const REACH: f64 = 4.0;

/// The wall about a junction: points seen from the balls of its legs.
pub(crate) fn wall(lines: &[Vec<Ball>], lumen: Lumen<'_>, radius: f64) -> Vec<DVec3> {
    let mut points = Vec::new();
    for line in lines {
        let mut last: Option<DVec3> = None;
        for ball in line.iter().take_while(|b| b.centre.distance(line[0].centre) < (REACH + 1.0) * radius) {
            if last.is_some_and(|l| l.distance(ball.centre) < RAYS_APART * radius) {
                continue;
            }
            last = Some(ball.centre);
            points.extend(lumen.wall_about(P3::from_raw(ball.centre), ball.radius, &directions()));
        }
    }
    points
}

/// Even directions: a spiral of the golden angle.
fn directions() -> Vec<DVec3> {
    let golden = std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    let at = |k: usize| {
        let z = 1.0 - (2.0 * k as f64 + 1.0) / RAYS as f64;
        let (s, c) = (golden * k as f64).sin_cos();
        let flat = (1.0 - z * z).sqrt();
        DVec3::new(flat * c, flat * s, z)
    };
    (0..RAYS).map(at).collect()
}

/// The line led through the junction at `centre` at the least cost; its parts beyond [`REACH`] stay.
pub(crate) fn least(line: Vec<Ball>, centre: DVec3, lumen: Lumen<'_>, wall: &[DVec3], radius: f64) -> Vec<Ball> {
    let near = |b: &Ball| b.centre.distance(centre) < REACH * radius;
    let (Some(first), Some(last)) = (line.iter().position(near), line.iter().rposition(near)) else { return line };
    if last < first + 2 || wall.is_empty() {
        return line;
    }
    let mut x: Vec<DVec3> = line[first..=last].iter().map(|b| b.centre).collect();
    through(&mut x, wall, radius);
    let ball = |&centre: &DVec3| {
        let near = distance(centre, wall, SHARPNESS / radius);
        let exact = (-near.1)
            .try_normalize()
            .and_then(|to_wall| lumen.inscribed_radius(P3::from_raw(centre), V3::from_raw(to_wall), near.0));
        Ball { centre, radius: exact.unwrap_or(near.0) }
    };
    let through = x.iter().map(ball);
    line[..first].iter().copied().chain(through).chain(line[last + 1..].iter().copied()).collect()
}

/// Descend from coarse to fine; the ends stay.
fn through(x: &mut Vec<DVec3>, wall: &[DVec3], radius: f64) {
    for (share, turns) in LEVELS {
        let step = share * radius;
        *x = even(x, step);
        for turn in 1..=turns {
            descend(x, wall, step, SHARPNESS / radius);
            if turn % EVEN_TURNS == 0 {
                *x = even(x, step);
            }
        }
    }
}

fn nearest(x: DVec3, wall: &[DVec3]) -> f64 {
    wall.iter().map(|w| w.distance_squared(x)).fold(f64::INFINITY, f64::min).sqrt()
}

/// Distance to the wall and its gradient, averaged over the points that are nearly as near as the nearest.
fn distance(x: DVec3, wall: &[DVec3], sharpness: f64) -> (f64, DVec3) {
    let least = nearest(x, wall);
    let reach = least + 8.0 / sharpness;
    let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
    for &w in wall.iter().filter(|w| w.distance_squared(x) < reach * reach) {
        let d = w.distance(x);
        let weight = (sharpness * (least - d)).exp();
        sum += (x - w) * (weight / d.max(1e-9));
        weights += weight;
    }
    (least, sum / weights)
}

/// One turn: each inner point against the gradient of the sum of length over distance, across the line.
fn descend(x: &mut [DVec3], wall: &[DVec3], step: f64, sharpness: f64) {
    let seen: Vec<(f64, DVec3)> = x.iter().map(|&p| distance(p, wall, sharpness)).collect();
    let cost = |k: usize| 1.0 / seen[k].0.max(1e-3);
    let old = x.to_vec();
    for (k, point) in x.iter_mut().enumerate().take(old.len() - 1).skip(1) {
        let (before, after) = (old[k] - old[k - 1], old[k + 1] - old[k]);
        let (lengths, directions) =
            ((before.length(), after.length()), (before.normalize_or_zero(), after.normalize_or_zero()));
        let shorter = directions.0 * (0.5 * (cost(k - 1) + cost(k))) - directions.1 * (0.5 * (cost(k) + cost(k + 1)));
        let wider = -seen[k].1 * (cost(k).powi(2) * 0.5 * (lengths.0 + lengths.1));
        let gradient = (shorter + wider).reject_from(old[k + 1] - old[k - 1]);
        *point -= (gradient * (RATE * step / cost(k))).clamp_length_max(LONGEST * step);
    }
}

/// The same line in even steps of about this length.
fn even(x: &[DVec3], step: f64) -> Vec<DVec3> {
    let mut arc = vec![0.0];
    for pair in x.windows(2) {
        arc.push(arc[arc.len() - 1] + pair[0].distance(pair[1]));
    }
    let length = arc[arc.len() - 1];
    let count = ((length / step) as usize).max(4);
    let mut k = 0;
    (0..=count)
        .map(|n| {
            let s = length * n as f64 / count as f64;
            while k + 2 < x.len() && arc[k + 1] < s {
                k += 1;
            }
            let span = arc[k + 1] - arc[k];
            x[k].lerp(x[k + 1], if span > 0.0 { ((s - arc[k]) / span).clamp(0.0, 1.0) } else { 0.0 })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Wall points of a tube about z.
    fn tube(radius: f64) -> Vec<DVec3> {
        let ring = |z: f64| (0..24).map(move |k| DVec3::new(0.0, 0.0, z) + radius * spoke(f64::from(k) / 24.0));
        (-80..=80).flat_map(|k| ring(0.5 * f64::from(k))).collect()
    }

    fn spoke(turn: f64) -> DVec3 {
        let (s, c) = (std::f64::consts::TAU * turn).sin_cos();
        DVec3::new(c, s, 0.0)
    }

    #[test]
    fn a_detour_within_a_tube_is_led_back_to_its_axis() {
        let wall = tube(3.0);
        let bump = |z: f64| 1.5 * (-(z / 3.0).powi(2)).exp();
        let mut x: Vec<DVec3> =
            (-24..=24).map(|k| 0.5 * f64::from(k)).map(|z| DVec3::new(bump(z), 0.3 * bump(z), z)).collect();
        let off = |x: &[DVec3]| x.iter().map(|p| p.x.hypot(p.y)).fold(0.0, f64::max);
        assert!(off(&x) > 1.5);
        through(&mut x, &wall, 3.0);
        assert!(off(&x) < 0.1, "{}", off(&x));
    }

    #[test]
    fn even_steps_keep_the_ends_and_the_length() {
        let x = [DVec3::ZERO, DVec3::new(1.0, 0.0, 0.0), DVec3::new(1.0, 5.0, 0.0)];
        let y = even(&x, 0.5);
        assert_eq!((y.len(), y[0], y[12]), (13, x[0], x[2]));
        assert!(y.windows(2).all(|w| (w[0].distance(w[1]) - 0.5).abs() < 1e-12), "{y:?}");
    }
}
