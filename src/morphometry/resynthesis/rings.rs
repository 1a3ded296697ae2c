//! Sections on changed lines: tubes, what of them is wall, and the wall as planar curves.

use crate::Error;
use crate::fit::fit_line;
use crate::line::{arc_length, nearest};
use crate::resynthesis::change::Changed;
use crate::resynthesis::path::{Path, arc};
use crate::resynthesis::{Model, ModelBranch, tip};
use crate::types::SectionOutline;
use imaging::{Axis, Contours, Curve, CutPlane, PeriodicSpline, Plane};
use space::{DMat3, DVec3, P3, V3};
use std::f64::consts::TAU;
use std::ops::Range;

/// Distance between rings, in the radius of the section: a constriction of one radius length still has three.
const SPACING_RADII: f64 = 0.4;
/// Ring points at least this far outside every other tube, in the other's radius, are wall: nearer ones lie where the
/// lumens' blend is, of which nothing is known.
const BLEND_RADII: f64 = 0.1;
/// Standard error of the curves, in pixels: the sections are those of a smooth function, not of pixels.
const ERROR_PX: f64 = 0.01;
/// Their degrees of freedom: size, place, and the next two harmonics.
const RING_FREEDOM: f64 = 7.0;
/// A cut reaches this many pixels past the longest ray of its section, or as far as the next vessel's wall allows.
const CUT_REACH_PX: f64 = 6.0;
/// So many pixels past its plane are meshed before they are cut away: the least that a cut must reach.
const MESHED_PX: f64 = 4.0;

/// A section in space.
#[derive(Clone, Debug)]
pub(crate) struct Ring {
    pub(crate) centre: DVec3,
    /// Columns: two normals and the tangent.
    pub(crate) frame: DMat3,
    /// Distance of the wall at even angles from the frame's first normal, mm.
    radii: Vec<f64>,
}

impl Ring {
    fn point(&self, k: usize) -> DVec3 {
        let (sin, cos) = (TAU * k as f64 / self.radii.len() as f64).sin_cos();
        self.centre + (self.frame.x_axis * cos + self.frame.y_axis * sin) * self.radii[k]
    }
    fn count(&self) -> usize {
        self.radii.len()
    }
    fn mean_radius(&self) -> f64 {
        self.radii.iter().fold(0.0, |s, r| s + r) / self.radii.len() as f64
    }
    fn longest(&self) -> f64 {
        self.radii.iter().copied().fold(0.0, f64::max)
    }
    /// Distance of the wall in the direction of a vector, mm.
    fn radius_towards(&self, offset: DVec3) -> f64 {
        let n = self.radii.len();
        let angle = offset.dot(self.frame.y_axis).atan2(offset.dot(self.frame.x_axis)).rem_euclid(TAU);
        let at = angle / TAU * n as f64;
        let (k, t) = (at as usize % n, at.fract());
        self.radii[k] + (self.radii[(k + 1) % n] - self.radii[k]) * t
    }
}

/// A branch as rings, from its first node outward.
#[derive(Clone, Debug)]
pub(crate) struct Tube {
    pub(crate) rings: Vec<Ring>,
    /// Of the rings: first and one past the last that were measured; the others carry these on into junctions.
    measured: [usize; 2],
    centres: Vec<DVec3>,
}

impl Tube {
    pub(crate) fn middle(&self) -> Option<P3> {
        let [a, b] = self.measured;
        self.rings.get((a + b) / 2).map(|r| P3::from_raw(r.centre))
    }
    /// How deep a point lies in the tube, mm; negative outside. A ball closes it at its ends.
    fn depth(&self, x: DVec3) -> f64 {
        self.depth_in(x, 0..self.rings.len())
    }
    /// The same for some of its rings.
    fn depth_in(&self, x: DVec3, rings: std::ops::Range<usize>) -> f64 {
        let (first, end) = (rings.start, rings.end);
        if rings.is_empty() {
            return f64::NEG_INFINITY;
        }
        let (_, i, t) = if rings.len() > 1 { nearest(&self.centres[rings], x) } else { (0.0, 0, 0.0) };
        let towards = |ring: &Ring| ring.radius_towards(x - ring.centre);
        let (a, b) = (&self.rings[first + i], &self.rings[(first + i + 1).min(end - 1)]);
        let centre = a.centre.lerp(b.centre, t);
        towards(a) + (towards(b) - towards(a)) * t - x.distance(centre)
    }
}

/// The tubes of all branches on their changed lines.
pub(crate) fn tubes(model: &Model, changed: &Changed) -> Result<Vec<Tube>, Error> {
    (0..model.branches.len()).map(|b| tube(model, changed, b)).collect()
}

fn tube(model: &Model, changed: &Changed, b: usize) -> Result<Tube, Error> {
    let (branch, path) = (&model.branches[b], &changed.paths[b]);
    let measured = measured(branch, path, changed.carried[b].clone());
    if measured.is_empty() {
        return Err(Error::VariantSections { branch: branch.id });
    }
    let junction = |node: usize| model.junctions.iter().position(|j| j.node == node).map(|j| changed.junctions[j]);
    let mut before = carried_on(measured.iter(), -1.0, junction(branch.nodes[0]));
    before.reverse();
    let after = carried_on(measured.iter().rev(), 1.0, junction(branch.nodes[1]));
    let range = [before.len(), before.len() + measured.len()];
    let rings: Vec<Ring> = before.into_iter().chain(measured).chain(after).collect();
    for (k, pair) in rings.windows(2).enumerate() {
        if folds(&pair[0], &pair[1]) {
            let at = P3::from_raw(pair[0].centre);
            return Err(Error::VariantFolds { branch: branch.id, ring: k, radius_mm: pair[0].longest(), at });
        }
    }
    let centres = rings.iter().map(|r| r.centre).collect();
    Ok(Tube { rings, measured: range, centres })
}

/// The measured sections on the changed line, thinned out; the first and the last are kept.
fn measured(branch: &ModelBranch, path: &Path, carried: Range<usize>) -> Vec<Ring> {
    let original = Path::of(branch);
    let along = arc_length(&path.points);
    let clear: Vec<usize> = carried.filter(|&k| branch.sections[k].outline.is_some()).collect();
    let mut rings = Vec::new();
    let mut placed = f64::NEG_INFINITY;
    for &k in &clear {
        let Some(outline) = &branch.sections[k].outline else { continue };
        let ring =
            Ring { centre: path.points[k], frame: path.frames[k], radii: in_frame(outline, &original.frames[k]) };
        let far = along[k] - placed >= SPACING_RADII * ring.mean_radius();
        if k == clear[clear.len() - 1] {
            // the last ring is where the vessel is cut: one that would crowd it gives way
            if !far && rings.len() > 1 {
                rings.pop();
            }
            rings.push(ring);
        } else if far {
            placed = along[k];
            rings.push(ring);
        }
    }
    rings
}

/// An outline's radii at even angles from the frame's first normal.
fn in_frame(outline: &SectionOutline, frame: &DMat3) -> Vec<f64> {
    let n = outline.radii_mm.len();
    let first = outline.first.raw();
    let phase = first.dot(frame.y_axis).atan2(first.dot(frame.x_axis));
    let at = |angle: f64| {
        let k = ((angle - phase) / TAU * n as f64).rem_euclid(n as f64);
        let (i, t) = (k as usize % n, k.fract());
        // cubic through four neighbours: 48 rays carry an ellipse of ratio 2 to 1e-4
        let r = |j: usize| outline.radii_mm[(i + n + j - 1) % n];
        let (a, b, c, d) = (r(0), r(1), r(2), r(3));
        b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
    };
    (0..n).map(|k| at(TAU * k as f64 / n as f64)).collect()
}

/// Stretch of the line by which its first ring is carried on, in its radius: one section's own tangent errs by a degree, and
/// its carried tube by .15 mm where the next window begins.
const AXIS_RADII: f64 = 3.0;

/// And at most this bend along it, cosine (10 degrees): what bends more says how it goes on by itself.
const AXIS_COSINE: f64 = 0.985;

/// The first of some rings carried on to a junction, straight along the line through those next to it.
fn carried_on<'a>(mut rings: impl Iterator<Item = &'a Ring>, side: f64, junction: Option<DVec3>) -> Vec<Ring> {
    let (Some(junction), Some(first)) = (junction, rings.next()) else { return Vec::new() };
    let reach = AXIS_RADII * first.mean_radius();
    let tangent = first.frame.z_axis;
    let straight = |r: &&Ring| r.centre.distance(first.centre) <= reach && r.frame.z_axis.dot(tangent) >= AXIS_COSINE;
    let near = std::iter::once(first).chain(rings.take_while(straight));
    let line: Vec<(P3, f64)> = near.map(|r| (P3::from_raw(r.centre), 1.0)).collect();
    let fitted = fit_line(&line).map(|l| l.direction.raw());
    let along = fitted.map_or(tangent, |d| if d.dot(tangent) < 0.0 { -d } else { d });
    let frame = arc(tangent, along) * first.frame;
    let distance = (junction - first.centre).dot(along * side);
    let step = SPACING_RADII * first.mean_radius();
    let count = (distance / step).max(0.0) as usize;
    let at = |k: usize| Ring { centre: first.centre + along * (side * step * k as f64), frame, ..first.clone() };
    (1..=count).map(at).collect()
}

/// Whether two neighbouring sections cut each other: r kappa >= 1.
fn folds(a: &Ring, b: &Ring) -> bool {
    let ahead = (0..b.count()).all(|k| (b.point(k) - a.centre).dot(a.frame.z_axis) > 0.0);
    let behind = (0..a.count()).all(|k| (a.point(k) - b.centre).dot(b.frame.z_axis) < 0.0);
    !(ahead && behind)
}

/// By branch, ring and angle: whether the point is wall.
pub(crate) type Walls = Vec<Vec<Vec<bool>>>;

/// What of each tube lies outside all others. Tubes that share a junction overlap from there on until they part, and
/// nowhere else.
pub(crate) fn walls(model: &Model, tubes: &[Tube]) -> Result<Walls, Error> {
    let mut walls: Walls = tubes.iter().map(|t| t.rings.iter().map(|r| vec![true; r.count()]).collect()).collect();
    for b in 0..tubes.len() {
        meets_itself(&tubes[b], model.branches[b].id)?;
        for other in (0..tubes.len()).filter(|&o| o != b) {
            apart(model, tubes, [b, other], &mut walls[b])?;
        }
    }
    Ok(walls)
}

/// A tube that turns back on itself: two sections that touch are at least half a turn of one radius apart along it.
fn meets_itself(tube: &Tube, branch: usize) -> Result<(), Error> {
    let along = arc_length(&tube.centres);
    for (k, ring) in tube.rings.iter().enumerate() {
        let apart = std::f64::consts::PI * ring.longest();
        let before = along.partition_point(|s| *s < along[k] - apart);
        let after = along.partition_point(|s| *s <= along[k] + apart);
        let touches = |x: DVec3| tube.depth_in(x, 0..before).max(tube.depth_in(x, after..tube.rings.len())) >= 0.0;
        if (0..ring.count()).any(|i| touches(ring.point(i))) {
            return Err(Error::VariantCollision { branch, other: branch, at: P3::from_raw(ring.centre) });
        }
    }
    Ok(())
}

fn apart(model: &Model, tubes: &[Tube], [b, other]: [usize; 2], wall: &mut [Vec<bool>]) -> Result<(), Error> {
    let rings = &tubes[b].rings;
    let depths: Vec<Vec<f64>> =
        rings.iter().map(|r| (0..r.count()).map(|k| tubes[other].depth(r.point(k))).collect()).collect();
    let deepest = |k: usize| depths[k].iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let shares = |end: usize| {
        let node = model.branches[b].nodes[end];
        model.junction(node).is_some() && model.branches[other].nodes.contains(&node)
    };
    let count = rings.len();
    // rings of the stretches next to shared junctions whose lumens overlap
    let mut overlaps = vec![false; count];
    for end in (0..2).filter(|&end| shares(end)) {
        let ring = |i: usize| if end == 0 { i } else { count - 1 - i };
        // at the node itself the wall of the wider vessel may lie outside the thinner one, which leaves it farther out
        let gap = (PARTING_RADII * rings[ring(0)].longest() / SPACING_RADII / rings[ring(0)].mean_radius()) as usize;
        let mut parted = 0;
        for i in 0..count {
            if i <= parted + gap && deepest(ring(i)) >= 0.0 {
                parted = i + 1;
            }
        }
        (0..parted).for_each(|i| overlaps[ring(i)] = true);
    }
    let meets = (0..count).find(|&k| !overlaps[k] && deepest(k) >= 0.0);
    let never = overlaps.iter().all(|&o| o);
    if let Some(k) = meets.or(never.then_some(count - 1)) {
        let [branch, other] = [b, other].map(|i| model.branches[i].id);
        return Err(Error::VariantCollision { branch, other, at: P3::from_raw(rings[k].centre) });
    }
    for k in 0..count {
        // just past the parting the blend still reaches
        let margin = BLEND_RADII * rings[k].mean_radius();
        for (keep, depth) in wall[k].iter_mut().zip(&depths[k]) {
            *keep &= *depth < -margin || !near_overlap(&overlaps, k);
        }
    }
    Ok(())
}

/// Lumens of one junction that are apart for this many radii along a branch have parted.
const PARTING_RADII: f64 = 2.0;

/// Whether a ring lies in an overlap or within two rings of one.
fn near_overlap(overlaps: &[bool], k: usize) -> bool {
    (k.saturating_sub(2)..(k + 3).min(overlaps.len())).any(|i| overlaps[i])
}

/// Fewest wall points of a ring that is used.
const LEAST_POINTS: usize = 6;

/// The wall as closed planar curves, one plane per ring, cut at the last ring of each open end.
pub(crate) fn contours(model: &Model, tubes: &[Tube], walls: &Walls) -> Result<Contours, Error> {
    let mut out = Contours {
        axis: Axis::Slice,
        planes: Vec::new(),
        curves: Vec::new(),
        cuts: Vec::new(),
        tips: Vec::new(),
        pixel_mm: model.pixel_mm,
        thickness_mm: None,
        blur: None,
    };
    for (b, (tube, wall)) in tubes.iter().zip(walls).enumerate() {
        let branch = &model.branches[b];
        let first = out.planes.len();
        for (ring, keep) in tube.rings.iter().zip(wall) {
            if keep.iter().filter(|k| **k).count() >= LEAST_POINTS {
                push_ring(ring, keep, &mut out);
            }
        }
        let last = out.planes.len();
        if last == first {
            continue;
        }
        for (end, plane) in [(0, first), (1, last - 1)] {
            if model.junction(branch.nodes[end]).is_none() {
                close(model, tubes, (b, end), plane, &mut out)?;
            }
        }
    }
    Ok(out)
}

fn push_ring(ring: &Ring, keep: &[bool], out: &mut Contours) {
    let n = ring.count();
    let (u, v) = (ring.frame.x_axis, ring.frame.y_axis);
    let raw: Vec<[f64; 2]> = (0..n)
        .map(|k| {
            let d = ring.point(k) - ring.centre;
            [d.dot(u), d.dot(v)]
        })
        .collect();
    let spline = PeriodicSpline::through(&raw);
    let index = out.planes.len();
    out.planes.push(Plane {
        index,
        origin: P3::from_raw(ring.centre),
        u: V3::from_raw(u),
        v: V3::from_raw(v),
        u_mm: vec![0.0],
        v_mm: vec![0.0],
    });
    let border = hidden(&raw, keep, spline.length());
    out.curves.push(Curve {
        plane: index,
        lumen: 0,
        spline,
        raw,
        level: 0.0,
        standard_error_mm: ERROR_PX * out.pixel_mm,
        level_error_mm: 0.0,
        freedom: RING_FREEDOM,
        border,
        hole: false,
    });
}

/// Arc length intervals of the points that are no wall, half a step wider on both sides.
fn hidden(points: &[[f64; 2]], keep: &[bool], length: f64) -> Vec<[f64; 2]> {
    let n = points.len();
    let mut at = vec![0.0];
    for k in 0..n {
        let (a, b) = (points[k], points[(k + 1) % n]);
        at.push(at[k] + (b[0] - a[0]).hypot(b[1] - a[1]));
    }
    let scale = length / at[n];
    let middle = |k: usize| {
        let (i, turns) = (k % n, (k / n) as f64);
        (turns * at[n] + 0.5 * (at[i] + at[i + 1])) * scale
    };
    let begins = (0..n).filter(|&k| !keep[k] && keep[(k + n - 1) % n]);
    begins
        .map(|k| {
            let end = (k..k + n).find(|&j| keep[j % n]).unwrap_or(k + n) - 1;
            [middle(k + n - 1) - length, middle(end)]
        })
        .map(|interval| interval.map(|s| s.rem_euclid(length)))
        .collect()
}

/// An open end is cut at its last ring; a blind one closes half a radius past it.
fn close(
    model: &Model,
    tubes: &[Tube],
    (b, end): (usize, usize),
    plane: usize,
    out: &mut Contours,
) -> Result<(), Error> {
    let (branch, rings) = (&model.branches[b], &tubes[b].rings);
    let side = if end == 0 { -1.0 } else { 1.0 };
    let Some(ring) = (if end == 0 { rings.first() } else { rings.last() }) else { return Ok(()) };
    let outward = V3::from_raw(ring.frame.z_axis * side);
    let centre = P3::from_raw(ring.centre);
    if branch.tip[end] {
        out.tips.push(tip(plane, centre + outward * (0.5 * ring.mean_radius()), outward));
        return Ok(());
    }
    let wanted = ring.longest() + CUT_REACH_PX * out.pixel_mm;
    let least = ring.longest().hypot(MESHED_PX * out.pixel_mm) + out.pixel_mm;
    let mut reach = wanted;
    for (o, other) in tubes.iter().enumerate().filter(|(o, _)| *o != b) {
        let points = other.rings.iter().flat_map(|r| (0..r.count()).map(|k| r.point(k)));
        let past = points.filter(|p| (*p - ring.centre).dot(outward.raw()) > -out.pixel_mm);
        let free = past.fold(f64::INFINITY, |d, p| d.min(p.distance(ring.centre))) - out.pixel_mm;
        if free < least {
            return Err(Error::VariantCollision { branch: branch.id, other: model.branches[o].id, at: centre });
        }
        reach = reach.min(free);
    }
    out.cuts.push(CutPlane::new(centre, outward).within(reach));
    Ok(())
}
