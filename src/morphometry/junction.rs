//! Where branches meet: how far their lumens overlap, the lines of their axes, and the point where the lines meet.
//!
//! Fitting from the junction outward is off by 3 to 28 degrees, because the medial line of overlapping lumens is not an
//! axis; from 1.5 diameters on it is within .03 degree. So the lines are fitted in a window that starts at 1.3 times the
//! crotch distance. Window, lines, meeting point and crotch depend on each other and are iterated to a standstill.
//! Samples enter a window by the share of their length that lies in it, so that nothing jumps when a window moves.

use crate::fit::{FittedLine, fit_line, meeting_point};
use crate::track::Track;
use space::{DVec3, P3, V3};

/// Window start in crotch distances: within one of them the lumens overlap. The factor is a choice, not yet swept.
pub(crate) const FROM_CROTCH: f64 = 1.3;
/// A window shorter than this many diameters gives no line. The value is a choice, not yet swept.
pub(crate) const WINDOW_MIN: f64 = 1.0;
/// Where the crotch reaches so far that the wanted window is shorter than this, its end is moved out.
const WINDOW_WANTED: f64 = 1.5;

/// Axes that meet further than this many (largest) radii from the graph's node do not belong to one junction's lumens.
const STRAY_RADII: f64 = 4.0;

/// An edge seen from one of its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Leg {
    pub(crate) track: usize,
    pub(crate) reversed: bool,
}

/// The legs at a node, by branch number; a loop from a junction to itself has two.
pub(crate) fn legs_at(tracks: &[Track], node: usize) -> Vec<Leg> {
    let mut legs = Vec::new();
    for (track, t) in tracks.iter().enumerate() {
        if t.from_node == node {
            legs.push(Leg { track, reversed: false });
        }
        if t.to_node == node {
            legs.push(Leg { track, reversed: true });
        }
    }
    legs
}

/// Distance from the meeting point of two axes within which their lumens (round tubes of radii a and b, axes at
/// `angle`, radians) overlap: the further of the two points where the wall lines cross, (r_b + r_a cos) / sin along a's
/// axis; for equal radii r / tan(angle / 2). Beyond a right angle at most the larger radius, so that a pair that runs
/// straight on, which has no crotch, does not claim one.
pub fn crotch_distance(angle: f64, radius_a_mm: f64, radius_b_mm: f64) -> f64 {
    let (sin, cos) = angle.sin_cos();
    let larger = radius_a_mm.max(radius_b_mm);
    let along_a = (radius_b_mm + radius_a_mm * cos) / sin;
    let along_b = (radius_a_mm + radius_b_mm * cos) / sin;
    let exact = along_a.max(along_b).max(0.0);
    if cos > 0.0 && sin > 0.0 {
        exact
    } else if sin > 1e-9 {
        exact.min(larger)
    } else {
        larger
    }
}

/// A vessel runs on past side branches thinner than it by this factor, and itself changes by less than this.
const SIDE_BRANCH: f64 = 1.6;
/// And bends by less than 45 degrees there.
const STRAIGHT_ON: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Most branches that one leg is followed through: an aorta has four side branches in the reach of a window.
const PIECES: usize = 6;

/// A leg and what continues it past thin side branches, which end no vessel: an iliac artery with a lumbar branch 15 mm
/// from the aortic bifurcation is straight far beyond.
fn pieces(tracks: &[Track], leg: Leg) -> Vec<Leg> {
    let mut pieces = vec![leg];
    while let Some(next) =
        onward(tracks, pieces[pieces.len() - 1]).filter(|n| pieces.iter().all(|p| p.track != n.track))
    {
        pieces.push(next);
        if pieces.len() == PIECES {
            break;
        }
    }
    pieces
}

fn onward(tracks: &[Track], leg: Leg) -> Option<Leg> {
    let track = &tracks[leg.track];
    let node = if leg.reversed { track.from_node } else { track.to_node };
    let mut others: Vec<Leg> = legs_at(tracks, node).into_iter().filter(|l| l.track != leg.track).collect();
    let radius = |l: &Leg| tracks[l.track].radius();
    others.sort_by(|a, b| radius(b).total_cmp(&radius(a)));
    let (next, side) = (others.first().copied()?, others.get(1)?);
    let (own, on) = (track.radius(), radius(&next));
    let alike = own.max(on) < SIDE_BRANCH * own.min(on);
    let straight = tangent_at(track, leg, End::Far)?.dot(tangent_at(&tracks[next.track], next, End::Near)?);
    (alike && SIDE_BRANCH * radius(side) < own.min(on) && straight > STRAIGHT_ON).then_some(next)
}

#[derive(Clone, Copy, PartialEq)]
enum End {
    Near,
    Far,
}

/// Direction away from the junction at one end of a leg: of the chord over two radii.
fn tangent_at(track: &Track, leg: Leg, end: End) -> Option<V3> {
    let (length, reach) = (track.length(), (2.0 * track.radius()).min(track.length()));
    let from_start = (end == End::Near) != leg.reversed;
    let within = |s: f64| if from_start { s <= reach } else { s >= length - reach };
    let mut points = track.sections.iter().filter(|s| within(s.abscissa_mm)).map(|s| s.position);
    let first = points.next()?;
    let chord = (points.next_back()? - first).normalised()?;
    Some(if leg.reversed { -chord } else { chord })
}

/// A sample of a leg.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LegSample {
    /// Its track, and its number on it.
    pub(crate) track: usize,
    pub(crate) index: usize,
    /// Distance along the branch from the meeting point, and half the length it stands for, mm.
    pub(crate) distance: f64,
    half: f64,
    pub(crate) point: DVec3,
    pub(crate) usable: bool,
}

/// A leg's samples, from the junction outward and on past thin side branches. Distance is straight within `inner` of
/// `origin`, and along the line from where it leaves that sphere.
pub(crate) fn leg_samples(tracks: &[Track], leg: Leg, origin: DVec3, inner: f64) -> Vec<LegSample> {
    let mut items: Vec<([usize; 2], f64, DVec3)> = Vec::new();
    let mut before = 0.0;
    for piece in pieces(tracks, leg) {
        let (track, length) = (&tracks[piece.track], tracks[piece.track].length());
        let count = track.sections.len();
        // the first section of a piece is the last of the one before it
        for i in usize::from(before > 0.0)..count {
            let k = if piece.reversed { count - 1 - i } else { i };
            let s = &track.sections[k];
            let along = if piece.reversed { length - s.abscissa_mm } else { s.abscissa_mm };
            items.push(([piece.track, k], before + along, s.position.raw()));
        }
        before += length;
    }
    let n = items.len();
    let straight = |i: usize| items[i].2.distance(origin);
    let first = (0..n).find(|&i| straight(i) > inner).unwrap_or(n - 1);
    let start = if first == 0 {
        items[0].1 - straight(0)
    } else {
        let (a, b) = (straight(first - 1), straight(first));
        let t = if b > a { ((inner - a) / (b - a)).clamp(0.0, 1.0) } else { 0.0 };
        items[first - 1].1 + (items[first].1 - items[first - 1].1) * t - inner
    };
    (0..n)
        .map(|i| {
            let ([track, index], s, point) = items[i];
            let distance = if i < first { straight(i) } else { s - start };
            let (before, after) = (items[i.saturating_sub(1)].1, items[(i + 1).min(n - 1)].1);
            let half = 0.25 * (after - before) * if i == 0 || i == n - 1 { 2.0 } else { 1.0 };
            LegSample { track, index, distance, half, point, usable: tracks[track].usable(index) }
        })
        .collect()
}

/// A line fitted to a window of a leg.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WindowFit {
    pub(crate) line: Option<FittedLine>,
    /// Length of the usable data in the window, mm.
    pub(crate) covered: f64,
    /// Where the usable data end, at most the window's end, mm.
    pub(crate) to: f64,
}

/// The line through the usable samples with distances in `from..to`; none when they cover less than `least` mm.
pub(crate) fn fit_window(samples: &[LegSample], from: f64, to: f64, least: f64) -> WindowFit {
    let mut points = Vec::new();
    let (mut covered, mut end) = (0.0, from);
    for s in samples.iter().filter(|s| s.usable) {
        let overlap = (s.distance + s.half).min(to) - (s.distance - s.half).max(from);
        if overlap > 0.0 {
            points.push((P3::from_raw(s.point), overlap / (2.0 * s.half)));
            covered += overlap;
            end = f64::max(end, (s.distance + s.half).min(to));
        }
    }
    let line = if covered >= least * (1.0 - 1e-9) { fit_line(&points) } else { None };
    WindowFit { line, covered, to: end }
}

/// In what the window is measured.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Ruler {
    /// Each branch's own diameter; the window as if the user had asked for `to` diameters.
    Own { to: f64 },
    /// One diameter for all, mm, and the user's window in it.
    Shared { diameter: f64, from: f64, to: f64 },
}

/// The axes of the branches at a junction.
#[derive(Clone, Debug)]
pub(crate) struct Axes {
    /// Point nearest to the lines; none when they are parallel.
    pub(crate) point: Option<P3>,
    /// From where distances are measured: `point`, or the graph's node.
    pub(crate) origin: DVec3,
    pub(crate) crotch: f64,
    /// By leg: window start, wanted end, and the fit.
    pub(crate) windows: Vec<([f64; 2], WindowFit)>,
    /// The window's end was moved out because the crotch reaches so far.
    pub(crate) moved: bool,
    /// The iteration came to rest.
    pub(crate) settled: bool,
}

impl Axes {
    /// Direction of a leg away from the junction, fitted.
    pub(crate) fn direction(&self, leg: usize) -> Option<V3> {
        self.windows[leg].1.line.map(|l| l.direction)
    }
}

/// Radius of a leg near its junction, mm: median area-equivalent radius within six node radii beyond the first two.
pub(crate) fn leg_radius(track: &Track, leg: Leg, node_radius: f64) -> f64 {
    let length = track.length();
    let near = track.area_radius(|s| {
        let s = if leg.reversed { length - s } else { s };
        s >= 2.0 * node_radius && s <= 8.0 * node_radius
    });
    near.or_else(|| track.area_radius(|_| true)).unwrap_or_else(|| track.radius())
}

/// Rough direction of a leg where no line can be fitted: the chord from the origin to its last sample within four
/// diameters. Serves the crotch and the choice of roles, never an angle.
pub(crate) fn chord(samples: &[LegSample], origin: DVec3, radius: f64) -> Option<V3> {
    let last = samples.iter().take_while(|s| s.distance <= 8.0 * radius).last().or(samples.last())?;
    (last.point - origin).try_normalize().map(V3::from_raw)
}

/// Lines, meeting point and crotch of a junction's legs, iterated.
pub(crate) fn axes(tracks: &[Track], legs: &[Leg], node: P3, node_radius: f64, ruler: Ruler) -> Axes {
    const TURNS: usize = 100;
    let radii: Vec<f64> = legs.iter().map(|&l| leg_radius(&tracks[l.track], l, node_radius)).collect();
    let largest = radii.iter().copied().fold(node_radius, f64::max);
    let mut axes = Axes {
        point: None,
        origin: node.raw(),
        crotch: 1.5 * largest,
        windows: Vec::new(),
        moved: false,
        settled: false,
    };
    for turn in 0..TURNS {
        let (windows, moved, crotch) = turn_of(tracks, legs, &radii, &axes, ruler);
        let lines: Vec<FittedLine> = windows.iter().filter_map(|w| w.1.line).collect();
        let point = meeting_point(&lines).filter(|p| p.distance(node) <= STRAY_RADII * largest);
        let (origin, still) = {
            let target = point.map_or(node.raw(), P3::raw);
            // the first turns go all the way, later ones halfway, which stops a swing between two states
            let pace = if turn < 20 { 1.0 } else { 0.5 };
            let still = target.distance(axes.origin) < 1e-11 * (1.0 + target.length().min(1e3))
                && (crotch - axes.crotch).abs() < 1e-11;
            axes.crotch += (crotch - axes.crotch) * pace;
            (axes.origin.lerp(target, pace), still)
        };
        (axes.origin, axes.point, axes.windows, axes.moved) = (origin, point, windows, moved);
        if still {
            axes.settled = true;
            break;
        }
    }
    axes
}

type Turn = (Vec<([f64; 2], WindowFit)>, bool, f64);

fn turn_of(tracks: &[Track], legs: &[Leg], radii: &[f64], axes: &Axes, ruler: Ruler) -> Turn {
    let mut moved = false;
    let mut windows = Vec::with_capacity(legs.len());
    let mut directions = Vec::with_capacity(legs.len());
    for (&leg, &radius) in legs.iter().zip(radii) {
        let samples = leg_samples(tracks, leg, axes.origin, axes.crotch);
        let (diameter, user_from, user_to) = match ruler {
            Ruler::Own { to } => (2.0 * radius, 0.0, to),
            Ruler::Shared { diameter, from, to } => (diameter, from, to),
        };
        let from = (FROM_CROTCH * axes.crotch).max(user_from * diameter);
        let wanted = user_to * diameter;
        let to = wanted.max(from + WINDOW_WANTED * diameter);
        moved |= to > wanted;
        let fit = fit_window(&samples, from, to, WINDOW_MIN * diameter);
        directions.push(fit.line.map(|l| l.direction).or_else(|| chord(&samples, axes.origin, radius)));
        windows.push(([from, to], fit));
    }
    let mut crotch: f64 = 0.0;
    for i in 0..legs.len() {
        for j in 0..i {
            if let (Some(a), Some(b)) = (directions[i], directions[j]) {
                crotch = crotch.max(crotch_distance(a.angle_to(b), radii[i], radii[j]));
            }
        }
    }
    // branches that run side by side for their whole length would push the window past the data: the fits then fail for
    // want of data, with a warning
    let longest = legs.iter().map(|l| tracks[l.track].length()).fold(0.0, f64::max);
    (windows, moved, crotch.min(longest))
}

/// Mouth of a side branch along the vessel that runs on past it, in its radii, either way: an ellipse of 45 degrees and
/// the rounding of its rim. What leaks farther is known by its shape.
const MOUTH_RADII: f64 = 2.0;

/// Flags the sections of a leg that lie within the crotch distance; of a vessel that runs on past a thin side branch, those
/// at its mouth.
pub(crate) fn flag(tracks: &mut [Track], legs: &[Leg], axes: &Axes) {
    for &leg in legs {
        let back = Leg { reversed: !leg.reversed, ..leg };
        let mouth = onward(tracks, back).map(|next| {
            let sides = legs.iter().filter(|l| l.track != leg.track && l.track != next.track);
            MOUTH_RADII * sides.map(|l| tracks[l.track].radius()).fold(0.0, f64::max)
        });
        let reach = mouth.map_or(axes.crotch, |m| m.min(axes.crotch));
        let samples = leg_samples(tracks, leg, axes.origin, axes.crotch);
        for s in samples.iter().filter(|s| s.distance < reach) {
            tracks[s.track].sections[s.index].in_junction = true;
        }
    }
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
}
