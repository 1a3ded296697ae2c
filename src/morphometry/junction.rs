//! Where branches meet: how far their lumens overlap, the lines of their axes, and the point where the lines meet.
//!
//! Fitting from the junction outward is off by 3 to 28 degrees, because the medial line of overlapping lumens is not an
//! axis; from 1.5 diameters on it is within .03 degree. So the lines are fitted in a window that starts at 1.3 times the
//! crotch distance. Window, lines, meeting point and crotch depend on each other and are iterated to a standstill.
//! Samples enter a window by the share of their length that lies in it, so that nothing jumps when a window moves.

use crate::crotch::{divider, overlaps};
use crate::fit::{FittedLine, fit_line, meeting_point};
use crate::line::Polyline;
use crate::track::Track;
use implicit::Field;
use space::{DVec3, P3, V3};

/// Window start in crotch distances: within one of them the lumens overlap. The factor is a choice, not yet swept.
pub(crate) const FROM_CROTCH: f64 = 1.3;
/// A window shorter than this many diameters gives no line. The value is a choice, not yet swept.
pub(crate) const WINDOW_MIN: f64 = 1.0;
/// Where the crotch reaches so far that the wanted window is shorter than this, its end is moved out.
const WINDOW_WANTED: f64 = 1.5;

/// Axes that meet further than this many (largest) radii from the graph's node do not meet in the junction: branches that
/// bend apart have lines that cross upstream of it. At 4 the crossing of two iliac arteries' lines, 13 mm up the aorta,
/// pushed the window outward, which moved the crossing, without end.
const STRAY_RADII: f64 = 1.0;

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
    let radius = |l: &Leg| tracks[l.track].own_radius();
    others.sort_by(|a, b| radius(b).total_cmp(&radius(a)));
    let (next, side) = (others.first().copied()?, others.get(1)?);
    let (own, on) = (track.own_radius(), radius(&next));
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

/// A point of a leg's line, with its section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LegPoint {
    /// Its track, and its number on it.
    section: [usize; 2],
    /// Distance along the branch from the graph's node, mm.
    along: f64,
    pub(crate) point: DVec3,
    /// Of the inscribed sphere, mm.
    pub(crate) radius: f64,
}

/// The line of a leg from the graph's node outward, on past thin side branches.
pub(crate) fn leg_line(tracks: &[Track], leg: Leg) -> Vec<LegPoint> {
    let mut items = Vec::new();
    let mut before = 0.0;
    for piece in pieces(tracks, leg) {
        let (track, length) = (&tracks[piece.track], tracks[piece.track].length());
        let count = track.sections.len();
        // the first section of a piece is the last of the one before it
        for i in usize::from(before > 0.0)..count {
            let k = if piece.reversed { count - 1 - i } else { i };
            let s = &track.sections[k];
            let along = if piece.reversed { length - s.abscissa_mm } else { s.abscissa_mm };
            items.push(LegPoint {
                section: [piece.track, k],
                along: before + along,
                point: s.position.raw(),
                radius: s.radius_inscribed_mm,
            });
        }
        before += length;
    }
    items
}

/// A leg's samples. Distance is straight within `inner` of `origin`, and along the line from where it leaves that sphere.
fn leg_samples(tracks: &[Track], leg: Leg, origin: DVec3, inner: f64) -> Vec<LegSample> {
    let items = leg_line(tracks, leg);
    let n = items.len();
    let straight = |i: usize| items[i].point.distance(origin);
    let first = (0..n).find(|&i| straight(i) > inner).unwrap_or(n - 1);
    let start = if first == 0 {
        items[0].along - straight(0)
    } else {
        let (a, b) = (straight(first - 1), straight(first));
        let t = if b > a { ((inner - a) / (b - a)).clamp(0.0, 1.0) } else { 0.0 };
        items[first - 1].along + (items[first].along - items[first - 1].along) * t - inner
    };
    (0..n)
        .map(|i| {
            let LegPoint { section: [track, index], along, point, .. } = items[i];
            let distance = if i < first { straight(i) } else { along - start };
            let (before, after) = (items[i.saturating_sub(1)].along, items[(i + 1).min(n - 1)].along);
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
    /// By leg: from the origin, how far its lumen overlaps with another leg's, mm.
    pub(crate) overlaps: Vec<f64>,
    /// By leg: window start, wanted end, and the fit.
    pub(crate) windows: Vec<([f64; 2], WindowFit)>,
    /// The window's end was moved out because the crotch reaches so far.
    pub(crate) moved: bool,
    /// The iteration came to rest.
    pub(crate) settled: bool,
}

impl Axes {
    /// How far the lumens overlap, mm; within it distances are straight.
    pub(crate) fn crotch(&self) -> f64 {
        self.overlaps.iter().copied().fold(0.0, f64::max)
    }

    /// A leg's samples, their distances from the origin.
    pub(crate) fn samples(&self, tracks: &[Track], leg: Leg) -> Vec<LegSample> {
        leg_samples(tracks, leg, self.origin, self.crotch())
    }

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

/// Lines, meeting point and overlaps of a junction's legs, iterated.
pub(crate) fn axes(
    tracks: &[Track],
    legs: &[Leg],
    field: &dyn Field,
    node: P3,
    node_radius: f64,
    ruler: Ruler,
) -> Axes {
    const TURNS: usize = 100;
    let site = Meeting::new(tracks, legs, field, node_radius);
    let largest = site.radii.iter().copied().fold(node_radius, f64::max);
    let mut axes = Axes {
        point: None,
        origin: node.raw(),
        overlaps: vec![1.5 * largest; legs.len()],
        windows: Vec::new(),
        moved: false,
        settled: false,
    };
    for turn in 0..TURNS {
        let (windows, moved, directions) = site.fits(&axes, ruler);
        let lines: Vec<FittedLine> = windows.iter().filter_map(|w| w.1.line).collect();
        let point = meeting_point(&lines).filter(|p| p.distance(node) <= STRAY_RADII * largest);
        let target = point.map_or(node.raw(), P3::raw);
        let overlaps = site.overlaps(target, &directions);
        // the first turns go all the way, later ones halfway, which stops a swing between two states
        let pace = if turn < 20 { 1.0 } else { 0.5 };
        let mut still = target.distance(axes.origin) < 1e-11 * (1.0 + target.length().min(1e3));
        for (present, next) in axes.overlaps.iter_mut().zip(overlaps) {
            still &= (next - *present).abs() < 1e-11;
            *present += (next - *present) * pace;
        }
        axes.origin = axes.origin.lerp(target, pace);
        (axes.point, axes.windows, axes.moved) = (point, windows, moved);
        if still {
            axes.settled = true;
            break;
        }
    }
    axes
}

/// How far from the node the lumens of two legs are watched, in the largest radius: tubes at 20 degrees part 5.7 out.
const REACH_RADII: f64 = 8.0;

/// The legs that meet at a node.
struct Meeting<'a> {
    tracks: &'a [Track],
    legs: &'a [Leg],
    radii: Vec<f64>,
    /// By pair (higher leg, lower leg): where each one's line passes the crotch between their lumens, where these part.
    partings: Vec<Vec<Option<[DVec3; 2]>>>,
}

type Fits = (Vec<([f64; 2], WindowFit)>, bool, Vec<Option<V3>>);

impl<'a> Meeting<'a> {
    fn new(tracks: &'a [Track], legs: &'a [Leg], field: &dyn Field, node_radius: f64) -> Self {
        let radii: Vec<f64> = legs.iter().map(|&l| leg_radius(&tracks[l.track], l, node_radius)).collect();
        let line = |&leg: &Leg| {
            let line = leg_line(tracks, leg);
            Polyline { along: line.iter().map(|p| p.along).collect(), points: line.iter().map(|p| p.point).collect() }
        };
        let lines: Vec<Polyline> = legs.iter().map(line).collect();
        let reach = REACH_RADII * radii.iter().copied().fold(node_radius, f64::max);
        let pair = |i: usize, j: usize| {
            let crotch = divider(field, [&lines[i], &lines[j]], node_radius, reach)?.raw();
            Some([i, j].map(|leg| lines[leg].nearest(crotch)))
        };
        let partings = (0..legs.len()).map(|i| (0..i).map(|j| pair(i, j)).collect()).collect();
        Self { tracks, legs, radii, partings }
    }

    /// Windows and their fits, whether an end was moved out, and directions, chords where there is no fit.
    fn fits(&self, axes: &Axes, ruler: Ruler) -> Fits {
        let mut moved = false;
        let mut windows = Vec::with_capacity(self.legs.len());
        let mut directions = Vec::with_capacity(self.legs.len());
        for ((&leg, &radius), &overlap) in self.legs.iter().zip(&self.radii).zip(&axes.overlaps) {
            let samples = axes.samples(self.tracks, leg);
            let (diameter, user_from, user_to) = match ruler {
                Ruler::Own { to } => (2.0 * radius, 0.0, to),
                Ruler::Shared { diameter, from, to } => (diameter, from, to),
            };
            // sections swollen by the junction may reach beyond what the angles say of the lumens' overlap
            let clear = samples.iter().find(|s| s.usable).map_or(0.0, |s| s.distance - s.half);
            let from = (FROM_CROTCH * overlap).max(user_from * diameter).max(clear);
            let wanted = user_to * diameter;
            let to = wanted.max(from + WINDOW_WANTED * diameter);
            moved |= to > wanted;
            let fit = fit_window(&samples, from, to, WINDOW_MIN * diameter);
            directions.push(fit.line.map(|l| l.direction).or_else(|| chord(&samples, axes.origin, radius)));
            windows.push(([from, to], fit));
        }
        (windows, moved, directions)
    }

    /// By leg: how far from `origin` its lumen overlaps with another's.
    fn overlaps(&self, origin: DVec3, directions: &[Option<V3>]) -> Vec<f64> {
        // branches that run side by side for their whole length would push the window past the data: the fits then fail
        // for want of data, with a warning
        let longest = self.legs.iter().map(|l| self.tracks[l.track].length()).fold(0.0, f64::max);
        let mut reach = vec![0.0; self.legs.len()];
        for (i, partings) in self.partings.iter().enumerate() {
            for (j, parting) in partings.iter().enumerate() {
                let (Some(a), Some(b)) = (directions[i], directions[j]) else { continue };
                let angle = a.angle_to(b);
                let tubes = overlaps(angle, self.radii[i], self.radii[j]);
                let seen =
                    parting.filter(|_| angle < std::f64::consts::FRAC_PI_2).map(|p| p.map(|x| x.distance(origin)));
                let own = seen.map_or(tubes, |seen| [tubes[0].min(seen[0]), tubes[1].min(seen[1])]);
                reach[i] = f64::max(reach[i], own[0].min(longest));
                reach[j] = f64::max(reach[j], own[1].min(longest));
            }
        }
        reach
    }
}

/// Flags the sections of each leg within which its lumen overlaps with another's.
pub(crate) fn flag(tracks: &mut [Track], legs: &[Leg], axes: &Axes) {
    for (&leg, &overlap) in legs.iter().zip(&axes.overlaps) {
        for s in axes.samples(tracks, leg).iter().filter(|s| s.distance < overlap) {
            tracks[s.track].sections[s.index].in_junction = true;
        }
    }
}
