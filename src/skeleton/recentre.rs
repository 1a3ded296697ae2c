//! The medial line on f: where a voxel line lies .35 to 1.3 voxels off the axis, this one lies at the area centroids of
//! its own normal sections.
//!
//! Per pass every point gets the section of f in its normal plane and moves to the section's area centroid. Sections
//! that are open (a ray meets a cut plane), that leak into a neighbour (unequal radii, a jump of the radius) or that
//! swell towards a junction are not used; there the line is straight from the last good centre to the node, or follows
//! the voxel line where the straight line would leave the lumen. A junction lies at the point nearest (least squares) to
//! the lines through the good centres next to it, which is the crossing of the axes; the centre of the largest sphere
//! was not taken because it slides along a host vessel, whose spheres are all alike. Nothing is smoothed after the first
//! pass: on a smooth f the centroids are smooth.

use crate::lumen::Section;
use crate::medial::abscissae;
use crate::{Error, Lumen, MedialGraph, NodeKind, Settings};
use exec::Ctx;
use space::{DMat3, DVec3, P3, V3};
use std::ops::Range;

/// Half the window over which a tangent is taken, in inscribed radii: shorter windows turn noise of the first pass into
/// tilted sections, longer ones cut the corners of bends of three radii.
const TANGENT_RADII: f64 = 0.5;
/// A section this much larger than the median of those one to three radii farther out belongs to the junction. A taper
/// of 1 : 28 in radius passes.
const SWELLING: f64 = 1.15;
/// How far from a junction swelling is looked for, in the junction's inscribed radii: the lumens of a graft at 20 degrees
/// part 5.7 radii out.
const SWELLING_RADII: f64 = 8.0;
/// Behind this length without swelling, in the same radii, the junction has ended: what swells farther out is a bump or
/// the taper of the vessel itself.
const CALM_RADII: f64 = 4.0;
/// Length of the line through the centres next to a junction, in their radii. Short enough for bends of ten radii (.11
/// radius off), long enough to average the ripple of a noisy wall.
const AXIS_RADII: f64 = 3.0;
/// Weight of the present position in the least squares of a junction, against 1 for each line; repeated
/// [`PROXIMAL_STEPS`] times, it acts only along directions in which the lines say nothing.
const PROXIMAL_WEIGHT: f64 = 0.02;
const PROXIMAL_STEPS: usize = 20;
/// How far a junction may move to the crossing of the axes, in the largest radius of its branches: thinning puts it towards the crotch,
/// 1.3 radii from the crossing for a graft at 45 degrees, 4.3 for one at 20 (the crotch itself lies 1 / tan 10 = 5.7 out).
const JUNCTION_REACH_RADII: f64 = 6.0;
/// And towards each junction that a line leads to, in the distance to it: two side branches of one trunk do not change
/// places.
const NEIGHBOUR_REACH: f64 = 0.4;
/// The crossing has at least this share of the inscribed radius at the present place or of the second thickest branch's
/// (a graft may be wider than its host), whichever is smaller. In the crotch of two iliac arteries side by side the axes
/// cross in the wall (.06); an opening between two touching lumens, where a junction does belong, has .36.
const KEPT_RADIUS: f64 = 0.3;
/// The same where a side branch joins, as [`SIDE_BRANCH`] says: the trunk's axis has the trunk's radius. At .3 the crossing
/// of an aorta with both renal arteries slid 24 mm down the trunk.
const KEPT_TRUNK: f64 = 0.8;
/// A branch thinner than both others by this factor joins a vessel whose axis says where: the branch's own axis, carried
/// on through a wide trunk, passes beside it.
const SIDE_BRANCH: f64 = 2.0;
/// Two branches whose radii differ by less than this factor, both thicker than the third, are one vessel that runs on.
const SAME_VESSEL: f64 = 1.6;

/// A trunk has at least this many times the radius of the wider of its branches; a vessel that runs on past a graft or
/// a side branch keeps its radius, one that divides evenly by Murray's law has 1.26 times that of its branches.
const DIVIDED_RADIUS: f64 = 1.15;
/// The axes' crossing is far from the divider beyond this many radii of the sphere at the crossing. At branches of 60
/// degrees, where it is nearer, the crossing stays.
const FAR_CROSSING_RADII: f64 = 2.0;
/// Steps down the trunk to the sphere that touches the divider: each takes the sphere of the last.
const SPHERE_STEPS: usize = 5;

/// A medial line while it is recentred.
#[derive(Clone)]
struct Line {
    points: Vec<P3>,
    /// The section whose centroid a point is.
    sections: Vec<Option<Section>>,
    /// Inscribed radius halfway, mm.
    radius: f64,
    /// A loop whose base node has no other branch.
    closed: bool,
}

/// Resample all edges by arc length (steps of about one voxel), move them to the centroids of their sections in
/// `settings.passes` passes, place the junctions, and measure the inscribed radii of points and nodes on f. Ends at caps
/// stay where they are; other ends move within their section.
///
/// # Errors
/// [`Error::Cancelled`].
///
/// Cost: 150 values and 210 gradients of f per point and pass (64 rays, measured), in parallel.
pub fn recentre(graph: &mut MedialGraph, lumen: &Lumen<'_>, settings: &Settings, ctx: &Ctx) -> Result<(), Error> {
    let mut lines = starting_lines(graph, lumen, ctx)?;
    for pass in 0..settings.passes {
        let part =
            ctx.part(pass as f64 / (settings.passes + 1) as f64, (pass + 1) as f64 / (settings.passes + 1) as f64);
        for e in 0..lines.len() {
            if pass > 0 {
                lines[e].points = resampled(&lines[e].points, lumen.spacing_mm());
            }
            take_sections(&mut lines[e], graph, e, lumen, settings, ctx)?;
            part.progress(e as f64 / lines.len() as f64);
        }
        place_nodes(graph, &lines, lumen);
        for (e, line) in lines.iter_mut().enumerate() {
            let ends = graph.edges[e].nodes.map(|n| graph.nodes[n].position);
            *line = joined(line, ends, lumen);
        }
    }
    measure_radii(graph, lines, lumen, ctx)?;
    ctx.progress(1.0);
    Ok(())
}

fn starting_lines(graph: &MedialGraph, lumen: &Lumen<'_>, ctx: &Ctx) -> Result<Vec<Line>, Error> {
    let degree: Vec<usize> = graph.incidence().iter().map(Vec::len).collect();
    let start = |edge: &crate::Edge| {
        let middle = edge.points[edge.points.len() / 2];
        let fallback = edge.nodes.iter().map(|&n| graph.nodes[n].radius_mm).fold(0.0, f64::max);
        let radius = lumen.inscribed(middle).unwrap_or(fallback).max(lumen.spacing_mm());
        let closed = edge.is_loop() && degree[edge.nodes[0]] == 2;
        let mut points = resampled(&edge.points, lumen.spacing_mm());
        let half = half_window(radius, lumen);
        for _ in 0..2 {
            points = averaged(&points, half);
        }
        Line { sections: vec![None; points.len()], points, radius, closed }
    };
    Ok(ctx.map(&graph.edges, start)?)
}

fn half_window(radius: f64, lumen: &Lumen<'_>) -> usize {
    ((TANGENT_RADII * radius / lumen.spacing_mm()).round() as usize).clamp(2, 20)
}

/// Equal steps of arc length near `step`, the ends kept.
fn resampled(points: &[P3], step: f64) -> Vec<P3> {
    let s = abscissae(points);
    let (Some(&length), Some(&first), Some(&last)) = (s.last(), points.first(), points.last()) else {
        return points.to_vec();
    };
    let n = (length / step).round().max(1.0) as usize;
    let mut out = vec![first];
    let mut i = 0;
    for k in 1..n {
        let wanted = length * k as f64 / n as f64;
        while i + 2 < s.len() && s[i + 1] < wanted {
            i += 1;
        }
        let span = (s[i + 1] - s[i]).max(f64::MIN_POSITIVE);
        out.push(points[i].lerp(points[i + 1], ((wanted - s[i]) / span).clamp(0.0, 1.0)));
    }
    out.push(last);
    out
}

/// Running means over up to `half` points on either side, fewer near the ends, which stay.
fn averaged(points: &[P3], half: usize) -> Vec<P3> {
    let n = points.len();
    let mean = |i: usize| {
        let h = half.min(i).min(n - 1 - i);
        P3::centroid(&points[i - h..=i + h]).unwrap_or(points[i])
    };
    (0..n).map(mean).collect()
}

/// Unit tangent over `half` points on either side.
fn tangent(line: &Line, i: usize, half: usize) -> Option<V3> {
    let n = line.points.len();
    let (a, b) = if line.closed && n > 2 * half + 1 {
        // The last point repeats the first.
        ((i + n - 1 - half) % (n - 1), (i + half) % (n - 1))
    } else {
        (i.saturating_sub(half), (i + half).min(n - 1))
    };
    (line.points[b] - line.points[a]).normalised()
}

fn take_sections(
    line: &mut Line,
    graph: &MedialGraph,
    edge: usize,
    lumen: &Lumen<'_>,
    settings: &Settings,
    ctx: &Ctx,
) -> Result<(), Error> {
    let n = line.points.len();
    let half = half_window(line.radius, lumen);
    let ends = graph.edges[edge].nodes.map(|k| &graph.nodes[k]);
    let fixed = |i: usize| {
        let node = if i == 0 { ends[0] } else { ends[1] };
        (i == 0 || i == n - 1) && !line.closed && (node.kind == NodeKind::Junction || node.cap.is_some())
    };
    let section = |i: usize| {
        if fixed(i) { None } else { lumen.section(line.points[i], tangent(line, i, half)?, settings) }
    };
    line.sections = ctx.map_range(n, section)?;
    if line.closed {
        line.sections[n - 1] = line.sections[0].clone();
        return Ok(());
    }
    let s = abscissae(&line.points);
    for (end, node) in ends.iter().enumerate().filter(|(_, node)| node.kind == NodeKind::Junction) {
        drop_swelling(&mut line.sections, &s, end, node.radius_mm.max(line.radius));
    }
    Ok(())
}

/// Drop the sections of the line's first (end 0) or last part that lie within a junction of inscribed radius `radius`.
fn drop_swelling(sections: &mut [Option<Section>], s: &[f64], end: usize, radius: f64) {
    let areas: Vec<Option<f64>> = sections.iter().map(|x| x.as_ref().map(|x| x.area)).collect();
    sections[swollen(&areas, s, end, radius, Missing::Swollen)].fill(None);
}

/// What a section without area says of a junction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Missing {
    /// It leaks into the junction, unless it lies behind all others.
    Swollen,
    /// Nothing.
    Unknown,
}

/// The sections of a line, `areas` at abscissae `s`, mm, that a junction of inscribed radius `radius` swells at its first (end
/// 0) or last point: up to the outermost that is larger by [`SWELLING`] than the median of those one to three radii farther
/// out.
pub fn swollen(areas: &[Option<f64>], s: &[f64], end: usize, radius: f64, missing: Missing) -> Range<usize> {
    let n = areas.len();
    let from = |i: usize| if end == 0 { i } else { n - 1 - i };
    let outward: Vec<Option<f64>> = (0..n).map(|i| areas[from(i)]).collect();
    let way: Vec<f64> = (0..n).map(|i| (s[from(i)] - s[from(0)]).abs()).collect();
    match (last_swollen(&outward, &way, radius, missing), end) {
        (None, _) => 0..0,
        (Some(last), 0) => 0..last + 1,
        (Some(last), _) => n - 1 - last..n,
    }
}

/// [`swollen`] from the junction outward.
fn last_swollen(areas: &[Option<f64>], way: &[f64], radius: f64, missing: Missing) -> Option<usize> {
    let mut last = None;
    // sections that are missing behind all others are open at a cap, not leaking at the junction
    let outermost = areas.iter().rposition(Option::is_some)?;
    for i in (0..outermost).take_while(|&i| way[i] < SWELLING_RADII * radius) {
        if way[i] > CALM_RADII * radius + last.map_or(0.0, |l: usize| way[l]) {
            break;
        }
        let Some(a) = areas[i] else {
            last = if missing == Missing::Swollen { Some(i) } else { last };
            continue;
        };
        let r = (a / std::f64::consts::PI).sqrt();
        let mut outward: Vec<f64> = (i + 1..areas.len())
            .filter(|&j| way[j] > way[i] + r && way[j] <= way[i] + 3.0 * r)
            .filter_map(|j| areas[j])
            .collect();
        outward.sort_by(f64::total_cmp);
        if outward.get(outward.len() / 2).is_some_and(|&median| a > SWELLING * median) {
            last = Some(i);
        }
    }
    last
}

/// Junctions to the point nearest to their branches' axes; free ends and the bases of closed lines to their centroids.
fn place_nodes(graph: &mut MedialGraph, lines: &[Line], lumen: &Lumen<'_>) {
    let incidence = graph.incidence();
    let neighbours = neighbours(graph);
    for (n, (node, at)) in graph.nodes.iter_mut().zip(&incidence).enumerate() {
        let centre = |&(e, end): &(usize, usize)| {
            let sections = &lines[e].sections;
            let section = if end == 0 { sections.first() } else { sections.last() };
            section.and_then(|s| s.as_ref()).map(|s| s.centre)
        };
        if node.kind == NodeKind::End || at.iter().all(|&(e, _)| lines[e].closed) {
            if let Some(centre) = at.first().and_then(centre).filter(|_| node.cap.is_none()) {
                node.position = centre;
            }
            continue;
        }
        let mut radii: Vec<f64> = at.iter().map(|&(e, _)| lines[e].radius).collect();
        radii.sort_by(|a, b| b.total_cmp(a));
        let radius = radii[0];
        // a junction that thinning put into the crotch has a small sphere
        let reach = JUNCTION_REACH_RADII * radius.max(node.radius_mm);
        let second = *radii.get(1).unwrap_or(&radius);
        let side_branch = radii.get(2).is_some_and(|&third| second >= SIDE_BRANCH * third);
        let kept = if side_branch { KEPT_TRUNK } else { KEPT_RADIUS };
        let deep = kept * lumen.inscribed(node.position).unwrap_or(0.0).min(second);
        let passes = |x: P3, to: V3| (x - node.position).dot(to) > NEIGHBOUR_REACH * to.length_squared();
        let may = |x: P3| {
            x.distance(node.position) <= reach
                && neighbours[n].iter().all(|&q| !passes(x, q - node.position))
                && lumen.contains(x)
                && lumen.sees(node.position, x)
                && lumen.inscribed(x).is_some_and(|r| r >= deep)
        };
        let axes: Vec<(P3, V3)> = at.iter().filter_map(|&(e, end)| axis(&lines[e], end)).collect();
        let crossing = (axes.len() > 1).then(|| nearest_to_lines(&axes, node.position)).filter(|&x| may(x));
        let foot = |from: P3, thinner: f64| on_trunk(from, at, lines, thinner).filter(|&x| may(x));
        let placed = match crossing {
            Some(x) => foot(x, SIDE_BRANCH).or(crossing),
            None => foot(node.position, DIVIDED_RADIUS),
        };
        if let Some(x) = placed {
            node.position = x;
        }
        if let Some(point) = division(node.position, at, lines, lumen) {
            node.position = point;
        }
    }
}

/// For each node the junctions to which a line leads.
fn neighbours(graph: &MedialGraph) -> Vec<Vec<P3>> {
    let mut of = vec![Vec::new(); graph.nodes.len()];
    for edge in graph.edges.iter().filter(|e| !e.is_loop()) {
        let [a, b] = edge.nodes;
        for (from, to) in [(a, b), (b, a)] {
            if graph.nodes[to].kind == NodeKind::Junction {
                of[from].push(graph.nodes[to].position);
            }
        }
    }
    of
}

/// The foot of a side branch's junction on the straight line between the nearest good centres of the vessel that runs on,
/// both of whose branches are `thinner` times as thick as the next.
fn on_trunk(junction: P3, at: &[(usize, usize)], lines: &[Line], thinner: f64) -> Option<P3> {
    let mut order = at.to_vec();
    order.sort_by(|x, y| lines[y.0].radius.total_cmp(&lines[x.0].radius));
    let &[first, second, third, ..] = order.as_slice() else { return None };
    let radius = |branch: (usize, usize)| lines[branch.0].radius;
    if first.0 == second.0 || radius(first) > SAME_VESSEL * radius(second) || radius(second) < thinner * radius(third) {
        return None;
    }
    let next = |(e, end): (usize, usize)| {
        let mut centres = lines[e].sections.iter().flatten().map(|s| s.centre);
        if end == 0 { centres.next() } else { centres.next_back() }
    };
    let (a, b) = (next(first)?, next(second)?);
    let along = b - a;
    let t = (junction - a).dot(along) / along.length_squared();
    (0.0..=1.0).contains(&t).then(|| a + along * t)
}

/// Where a trunk divides into two thinner branches, the axes may cross far upstream of the divider between them: in an
/// aorta whose iliac arteries leave it at 35 degrees, 20 mm. The junction then lies where the largest sphere touches
/// the divider. `None` for a branch that joins a vessel which runs on, and where the crossing is nearer than that.
fn division(crossing: P3, at: &[(usize, usize)], lines: &[Line], lumen: &Lumen<'_>) -> Option<P3> {
    let &[a, b, c] = at else { return None };
    let radius = |(e, end): (usize, usize)| own_radius(&lines[e], end);
    let mut order = [a, b, c];
    order.sort_by(|x, y| radius(*x).total_cmp(&radius(*y)));
    let [first, second, trunk] = order;
    if first.0 == second.0 || radius(trunk) < DIVIDED_RADIUS * radius(second) {
        return None;
    }
    let outward = |(e, end): (usize, usize)| {
        let mut points = resampled(&lines[e].points, lumen.spacing_mm());
        if end == 1 {
            points.reverse();
        }
        points
    };
    let (p, q) = (outward(first), outward(second));
    let reach = (SWELLING_RADII * radius(trunk) / lumen.spacing_mm()) as usize;
    let apart = (1..p.len().min(q.len()).min(reach)).find(|&i| !lumen.sees(p[i], q[i]))?;
    let divider = p[apart - 1].lerp(q[apart - 1], 0.5);
    if crossing.distance(divider) < FAR_CROSSING_RADII * lumen.inscribed(crossing)? {
        return None;
    }
    let upstream = (crossing - divider).normalised()?;
    let mut point = crossing;
    for _ in 0..SPHERE_STEPS {
        point = divider + upstream * lumen.inscribed(point)?;
    }
    (point.distance(divider) < crossing.distance(divider) && lumen.contains(point)).then_some(point)
}

/// Median area-equivalent radius of a line's good sections next to one end: the inscribed radius halfway along a short
/// branch may be the junction's, and that of a voxel line off its axis a quarter too small.
fn own_radius(line: &Line, end: usize) -> f64 {
    let mut good: Vec<&Section> = line.sections.iter().flatten().collect();
    if end == 1 {
        good.reverse();
    }
    let near = good.iter().take_while(|s| s.centre.distance(good[0].centre) <= 2.0 * AXIS_RADII * line.radius);
    let mut radii: Vec<f64> = near.map(|s| (s.area / std::f64::consts::PI).sqrt()).collect();
    radii.sort_by(f64::total_cmp);
    radii.get(radii.len() / 2).copied().unwrap_or(line.radius)
}

/// The straight line through the good centres next to one end of a line: centroid and unit direction.
fn axis(line: &Line, end: usize) -> Option<(P3, V3)> {
    let mut centres: Vec<P3> = line.sections.iter().flatten().map(|s| s.centre).collect();
    if end == 1 {
        centres.reverse();
    }
    let first = *centres.first()?;
    centres.retain(|c| c.distance(first) <= AXIS_RADII * line.radius);
    if centres.len() < 4 {
        return None;
    }
    let mean = P3::centroid(&centres)?;
    let covariance = centres.iter().fold(DMat3::ZERO, |m, &c| m + outer((c - mean).raw()));
    let mut direction = (*centres.last()? - first).normalised()?.raw();
    for _ in 0..50 {
        direction = (covariance * direction).try_normalize()?;
    }
    Some((mean, V3::from_raw(direction)))
}

fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// argmin sum |(I - d d^T)(x - p)|^2, by proximal steps from `start`: exact in the directions that the lines determine,
/// unmoved in those that they do not.
fn nearest_to_lines(lines: &[(P3, V3)], start: P3) -> P3 {
    let mut matrix = DMat3::IDENTITY * PROXIMAL_WEIGHT;
    let mut right = DVec3::ZERO;
    for (p, d) in lines {
        let across = DMat3::IDENTITY - outer(d.raw());
        matrix += across;
        right += across * p.raw();
    }
    // The proximal weight makes the matrix positive definite.
    let inverse = matrix.inverse();
    (0..PROXIMAL_STEPS).fold(start, |x, _| P3::from_raw(inverse * (right + x.raw() * PROXIMAL_WEIGHT)))
}

/// The line through its good centres and its end nodes, gaps bridged.
fn joined(line: &Line, ends: [P3; 2], lumen: &Lumen<'_>) -> Line {
    let n = line.points.len();
    let mut out = Line { points: vec![ends[0]], sections: vec![line.sections[0].clone()], ..*line };
    let mut from = 0;
    let mut push = |to: usize, target: P3, section: Option<Section>| {
        if to > from + 1 {
            for p in bridge(out.points[out.points.len() - 1], target, &line.points[from + 1..to], lumen) {
                out.points.push(p);
                out.sections.push(None);
            }
        }
        out.points.push(target);
        out.sections.push(section);
        from = to;
    };
    let mut good: Vec<usize> = (1..n - 1).filter(|&i| line.sections[i].is_some()).collect();
    if !line.closed {
        drop_behind(&mut good, line, ends);
        good.reverse();
        drop_behind(&mut good, line, [ends[1], ends[0]]);
        good.reverse();
    }
    for i in good {
        if let Some(section) = &line.sections[i] {
            push(i, section.centre, line.sections[i].clone());
        }
    }
    push(n - 1, ends[1], line.sections[n - 1].clone());
    out
}

/// Drop the first good centres that lie behind the line's first end, where the node moved past them; all of them where it
/// moved past the whole line, as that of a vessel cut off within its junction does.
fn drop_behind(good: &mut Vec<usize>, line: &Line, [end, far]: [P3; 2]) {
    let centre = |i: &usize| line.sections[*i].as_ref().map_or(line.points[*i], |s| s.centre);
    let way: Vec<P3> = good.iter().map(centre).chain([far]).collect();
    let ahead = |w: &[P3]| (w[1] - w[0]).dot(w[0] - end) > 0.0;
    let behind = way.windows(2).position(ahead).unwrap_or(good.len());
    good.drain(..behind);
}

/// Points strictly between `a` and `b`: straight where that stays in the lumen, else the old points.
fn bridge(a: P3, b: P3, old: &[P3], lumen: &Lumen<'_>) -> Vec<P3> {
    if !lumen.sees(a, b) {
        return old.to_vec();
    }
    let n = (a.distance(b) / lumen.spacing_mm()).round().max(1.0) as usize;
    (1..n).map(|i| a.lerp(b, i as f64 / n as f64)).collect()
}

fn measure_radii(graph: &mut MedialGraph, mut lines: Vec<Line>, lumen: &Lumen<'_>, ctx: &Ctx) -> Result<(), Error> {
    for line in &mut lines {
        let inner = 1..line.points.len().saturating_sub(1);
        for i in inner.filter(|&i| line.sections[i].is_none()) {
            line.points[i] = lumen.inward(line.points[i]);
        }
    }
    let radii = ctx.map(&graph.nodes, |n| lumen.inscribed(n.position).unwrap_or(0.0))?;
    for (node, r) in graph.nodes.iter_mut().zip(radii) {
        node.radius_mm = r;
    }
    for (e, line) in lines.into_iter().enumerate() {
        let last = line.points.len() - 1;
        let nodes = graph.edges[e].nodes;
        let radius = |i: usize| match &line.sections[i] {
            _ if i == 0 => graph.nodes[nodes[0]].radius_mm,
            _ if i == last => graph.nodes[nodes[1]].radius_mm,
            Some(section) => lumen.inscribed_from(line.points[i], section.near),
            None => lumen.inscribed(line.points[i]).unwrap_or(0.0),
        };
        graph.edges[e].radius_mm = ctx.map_range(line.points.len(), radius)?;
        graph.edges[e].points = line.points;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_point_nearest_to_crossing_lines_is_their_crossing_and_parallel_lines_keep_the_start() {
        let c = P3::new(1.0, 2.0, 3.0);
        let lines = [V3::X, V3::new(-1.0, 0.1, 0.0), V3::new(0.7, 0.0, 0.7)].map(|d| {
            let d = d / d.length();
            (c + d * 7.0, d)
        });
        assert!(nearest_to_lines(&lines, P3::new(1.5, 1.0, 2.0)).distance(c) < 1e-6);
        let along = [(c, V3::X), (c + V3::X * 5.0, V3::X)];
        assert!(nearest_to_lines(&along, P3::new(9.0, 2.5, 3.0)).distance(P3::new(9.0, 2.0, 3.0)) < 1e-6);
    }

    #[test]
    fn what_a_junction_swells_ends_where_the_sections_rest_and_a_taper_is_none() {
        let way: Vec<f64> = (0..40).map(|k| 0.5 * f64::from(k)).collect();
        let disc = |r: f64| Some(std::f64::consts::PI * r * r);
        let stepped: Vec<_> = way.iter().map(|&s| disc(if s < 7.0 { 5.0 } else { 3.6 })).collect();
        let found = |areas: &[Option<f64>], end| swollen(areas, &way[..areas.len()], end, 3.6, Missing::Unknown);
        assert_eq!(found(&stepped, 0), 0..14);
        let taper: Vec<_> = way.iter().map(|&s| disc(3.6 - s / 30.0)).collect();
        assert_eq!(found(&taper, 0), 0..0);
        // with nothing farther out there is nothing to compare with
        assert_eq!(found(&stepped[..14], 0), 0..0);
        let backwards: Vec<_> = stepped.iter().rev().copied().collect();
        assert_eq!((found(&backwards, 1), found(&backwards, 0)), (26..40, 0..0));
    }

    #[test]
    fn centres_behind_a_node_that_moved_are_dropped_and_all_of_them_behind_its_end() {
        let at = |z: f64| P3::new(0.0, 0.0, z);
        let points: Vec<P3> = (0..8).map(|k| at(7.0 - f64::from(k))).collect();
        let line = Line { sections: vec![None; points.len()], points, radius: 1.0, closed: false };
        let left = |end: f64| {
            let mut good: Vec<usize> = (1..7).collect();
            drop_behind(&mut good, &line, [at(end), at(0.0)]);
            good
        };
        assert_eq!(left(8.0), [1, 2, 3, 4, 5, 6]);
        assert_eq!(left(3.5), [4, 5, 6]);
        assert!(left(0.5).is_empty());
    }

    #[test]
    fn resampling_keeps_the_ends_and_the_length_of_a_straight_line() {
        let points = [0.0, 0.1, 0.35, 2.0, 2.05, 5.0].map(|x| P3::new(x, 2.0 * x, 0.0));
        let out = resampled(&points, 0.5);
        assert_eq!((out[0], out[out.len() - 1]), (points[0], points[5]));
        let s = abscissae(&out);
        let step = s[s.len() - 1] / (s.len() - 1) as f64;
        assert!(s.windows(2).all(|w| (w[1] - w[0] - step).abs() < 1e-9));
    }
}
