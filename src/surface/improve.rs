//! The four passes of Botsch and Kobbelt (2004): split long edges, collapse short ones, flip towards valence six, move
//! vertices within the surface. Connectivity changes one edge at a time in a fixed order; f is evaluated in parallel
//! batches, so the result does not depend on the number of threads.

use crate::fabric::{Fabric, Seat};
use crate::land::{Approach, Landing, Tie, land};
use crate::sizing::{Rule, meet};
use crate::web::prev;
use crate::{Error, WALL};
use exec::Ctx;
use glam::DVec3;
use space::P3;

/// Edges longer than this times the wanted length are split, the bounds of Botsch and Kobbelt.
pub(crate) const LONG: f64 = 4.0 / 3.0;
/// Edges shorter than this times the wanted length are collapsed.
const SHORT: f64 = 4.0 / 5.0;
/// No pass may leave an angle below that of this cotangent (12 degrees), unless there was a smaller one before.
const FLOOR: f64 = 4.93;
/// Edges between two looks at the cancel token.
const BETWEEN_CHECKS: usize = 2048;

/// Split every edge that is too long, until none is. New vertices take their normals and sizes from their neighbours and
/// ask f nothing ([`meet_fresh`] does, for those that outlive the collapses); those on curves are landed at once.
pub(crate) fn split_long(fabric: &mut Fabric<'_>, rule: &Rule, limit: usize, ctx: &Ctx) -> Result<usize, Error> {
    /// Rounds after which a coarse start is fine enough: each halves the edges, 2^-8 covers 128 mm to .5 mm.
    const ROUNDS: usize = 8;
    let mut count = 0;
    for _ in 0..ROUNDS {
        let mut long: Vec<(f64, u32)> = fabric.edges().filter_map(|h| Some((excess(fabric, h)?, h))).collect();
        if long.is_empty() {
            break;
        }
        long.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        let fresh: Vec<u32> = long.iter().map(|&(_, h)| fabric.split(h)).collect();
        if fabric.triangles() > limit {
            let at = P3::from_raw(fabric.web.at[fresh[0] as usize]);
            return Err(Error::TooManyTriangles { limit, at });
        }
        count += fresh.len();
        let on_curves: Vec<u32> = fresh.into_iter().filter(|&v| fabric.on_crease(v)).collect();
        fabric.settle(&on_curves, Approach::follow(rule.edge_mm[1]), ctx)?;
    }
    Ok(count)
}

/// Land and measure the living vertices from number `first` on, but let none be coarser than the size it has.
pub(crate) fn meet_fresh(fabric: &mut Fabric<'_>, first: usize, rule: &Rule, ctx: &Ctx) -> Result<(), Error> {
    let fresh: Vec<u32> = fabric.living().into_iter().filter(|&v| v as usize >= first).collect();
    let born: Vec<f64> = fresh.iter().map(|&v| fabric.size[v as usize]).collect();
    meet(fabric, &fresh, rule, ctx)?;
    for (&v, b) in fresh.iter().zip(born) {
        fabric.size[v as usize] = fabric.size[v as usize].min(b);
    }
    Ok(())
}

/// By what factor an edge is too long; `None` when it is not. A wall edge from rim to rim is always too long: it lies
/// in the cap's plane instead of the wall.
fn excess(fabric: &Fabric<'_>, h: u32) -> Option<f64> {
    let ratio = fabric.web.length(h) / fabric.wanted(h);
    if ratio > LONG {
        return Some(ratio);
    }
    let (a, b) = (fabric.web.origin[h as usize], fabric.web.target(h));
    let chord = !fabric.web.is_feature(h) && fabric.web.id(h) == WALL && fabric.on_crease(a) && fabric.on_crease(b);
    (chord && ratio > 0.5).then_some(ratio)
}

/// Collapse edges that are too short, the shortest first.
pub(crate) fn collapse_short(fabric: &mut Fabric<'_>, ctx: &Ctx) -> Result<usize, Error> {
    collapse_below(fabric, SHORT, |_, _| true, ctx)
}

/// Collapse rim edges shorter than `part` of the mesh's mean edge.
pub(crate) fn collapse_curves(fabric: &mut Fabric<'_>, part: f64, ctx: &Ctx) -> Result<usize, Error> {
    /// Wall edges next to a fresh rim may be longer than the mean: only rims are to be judged by length.
    const AMPLE: f64 = 10.0;
    let size = AMPLE * fabric.mean_edge();
    fabric.size.fill(size);
    collapse_below(fabric, part / AMPLE, |fabric, h| fabric.web.is_feature(h), ctx)
}

fn collapse_below(
    fabric: &mut Fabric<'_>,
    least: f64,
    of: impl Fn(&Fabric<'_>, u32) -> bool,
    ctx: &Ctx,
) -> Result<usize, Error> {
    let ratio = |fabric: &Fabric<'_>, h: u32| fabric.web.length(h) / fabric.wanted(h);
    let edges = fabric.edges().filter(|&h| of(fabric, h));
    let mut short: Vec<(f64, u32)> = edges.map(|h| (ratio(fabric, h), h)).filter(|e| e.0 < least).collect();
    short.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    let mut count = 0;
    for (i, (_, h)) in short.into_iter().enumerate() {
        if i % BETWEEN_CHECKS == 0 {
            ctx.check()?;
        }
        if !fabric.web.lives(h) || ratio(fabric, h) >= least {
            continue;
        }
        for way in [h, fabric.web.twin[h as usize]] {
            if fabric.collapse_worth(way, LONG).is_some_and(|(before, after)| after.may_follow(before, FLOOR)) {
                fabric.web.collapse(way);
                count += 1;
                break;
            }
        }
    }
    Ok(count)
}

/// Draw the slivers of a raw lattice mesh together: edges shorter than `times` the mean collapse onto vertices that
/// stay, no evaluation of f. Sizes are that length afterwards.
pub(crate) fn thin_out(fabric: &mut Fabric<'_>, times: f64, ctx: &Ctx) -> Result<(), Error> {
    let size = times * fabric.mean_edge();
    fabric.size.fill(size);
    for _ in 0..2 {
        collapse_short(fabric, ctx)?;
        flip_to_valence(fabric, ctx)?;
    }
    Ok(())
}

/// Flip edges where that brings the valences nearer to their ideal.
pub(crate) fn flip_to_valence(fabric: &mut Fabric<'_>, ctx: &Ctx) -> Result<usize, Error> {
    let mut count = 0;
    let edges: Vec<u32> = fabric.edges().collect();
    for (i, h) in edges.into_iter().enumerate() {
        if i % BETWEEN_CHECKS == 0 {
            ctx.check()?;
        }
        let t = fabric.web.twin[h as usize];
        let id = fabric.web.id(h);
        let gains = [
            (fabric.web.origin[h as usize], -1),
            (fabric.web.origin[t as usize], -1),
            (fabric.web.origin[prev(h) as usize], 1),
            (fabric.web.origin[prev(t) as usize], 1),
        ]
        .map(|(v, change)| strain(fabric, v, id, change) - strain(fabric, v, id, 0));
        if gains.iter().sum::<i64>() >= 0 {
            continue;
        }
        if fabric.flip_worth(h).is_some_and(|(before, after)| after.may_follow(before, FLOOR)) {
            fabric.web.flip(h);
            count += 1;
        }
    }
    Ok(count)
}

/// Squared distance of a vertex's triangle count within one face id from the ideal: six around an inner vertex, one per
/// 60 degrees of the corner that a curve leaves.
fn strain(fabric: &Fabric<'_>, v: u32, id: u32, change: i64) -> i64 {
    if !fabric.on_crease(v) {
        return (fabric.web.valence(v) as i64 + change - 6).pow(2);
    }
    let (mut count, mut corner) = (0_i64, 0.0);
    for h in fabric.web.spokes(v).filter(|&h| fabric.web.id(h) == id) {
        count += 1;
        let p = fabric.places(fabric.web.corners(h as usize / 3));
        corner += crate::fabric::angles(p)[h as usize % 3];
    }
    let ideal = ((corner / std::f64::consts::FRAC_PI_3).round() as i64).max(1);
    (count + change - ideal).pow(2)
}

/// Where a vertex goes, with the normal and the wanted size there.
struct Place {
    at: DVec3,
    normal: DVec3,
    size: f64,
    /// Calls of (f, grad f) it took.
    evaluations: usize,
}

/// Move every vertex towards the weighted centroid of its surroundings, within its surface or curve.
///
/// Inside the wall f is not asked: see [`followed`]. The drift of a few such passes is taken back by the next landing.
pub(crate) fn smooth(fabric: &mut Fabric<'_>, longest_mm: f64, ctx: &Ctx) -> Result<usize, Error> {
    let vertices = fabric.living();
    let moves: Vec<Option<Place>> = ctx.map(&vertices, |&v| match fabric.seat(v) {
        Seat::Face(tie) => Some(centroid(fabric, v, &tie)),
        Seat::Crease(tie, marks) => Some(middle(fabric, v, (tie, marks), longest_mm)),
        Seat::Fixed => None,
    })?;
    let mut count = 0;
    for (&v, place) in vertices.iter().zip(moves) {
        let Some(place) = place else { continue };
        fabric.evaluations += place.evaluations;
        let before = fabric.star(v);
        if place.at.is_finite() && fabric.star_moved(v, place.at).may_follow(before, FLOOR) {
            fabric.web.at[v as usize] = place.at;
            fabric.normal[v as usize] = place.normal;
            fabric.size[v as usize] = place.size;
            count += 1;
        }
    }
    Ok(count)
}

/// The point of the wall near `here + way` without asking f: with the normals n at `here` and m there, the chord of a
/// quadric stands at right angles to n + m exactly, which leaves an error of third order in the way.
fn followed(here: DVec3, way: DVec3, n: DVec3, m: DVec3) -> DVec3 {
    let sum = n + m;
    let slope = n.dot(sum);
    if slope < 1.0 { here + way } else { here + way - n * (way.dot(sum) / slope) }
}

/// The part of a way that stays in the vertex's surface.
pub(crate) fn tangential(fabric: &Fabric<'_>, v: u32, tie: &Tie, way: DVec3) -> DVec3 {
    let free = tie.free(way);
    if !tie.wall {
        return free;
    }
    let n = tie.free(fabric.normal[v as usize]).normalize_or_zero();
    free - n * n.dot(free)
}

/// Centroid of the surrounding triangles, weighted by area over size^4: the centroidal density for edges of that size.
fn centroid(fabric: &Fabric<'_>, v: u32, tie: &Tie) -> Place {
    let (mut to, mut normal, mut size, mut weight) = (DVec3::ZERO, DVec3::ZERO, 0.0, 0.0);
    for h in fabric.web.spokes(v) {
        let k = fabric.web.corners(h as usize / 3);
        let p = fabric.places(k);
        let mean = k.iter().map(|&u| fabric.size[u as usize]).sum::<f64>() / 3.0;
        let square = mean * mean;
        let w = (p[1] - p[0]).cross(p[2] - p[0]).length() / (square * square);
        to += (p[0] + p[1] + p[2]) * (w / 3.0);
        normal += k.iter().fold(DVec3::ZERO, |s, &u| s + fabric.normal[u as usize]) * w;
        size += w * mean;
        weight += w;
    }
    let here = fabric.web.at[v as usize];
    let n = fabric.normal[v as usize];
    if weight.is_nan() || weight <= 0.0 {
        return Place { at: here, normal: n, size: fabric.size[v as usize], evaluations: 0 };
    }
    let way = tangential(fabric, v, tie, to / weight - here);
    if !tie.wall {
        return Place { at: tie.settle(here + way), normal: n, size: size / weight, evaluations: 0 };
    }
    let normal = normal.normalize_or_zero();
    Place { at: followed(here, way, n, normal), normal, size: size / weight, evaluations: 0 }
}

/// The point of a curve between a vertex's two neighbours where both edges are equally long for their sizes, landed.
fn middle(fabric: &Fabric<'_>, v: u32, (tie, marks): (Tie, [u32; 2]), longest_mm: f64) -> Place {
    let here = fabric.web.at[v as usize];
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for h in marks {
        let u = fabric.web.target(h);
        let size = 0.5 * (fabric.size[u as usize] + fabric.size[v as usize]);
        let w = fabric.web.length(h) / (size * size * size);
        sum += (here + fabric.web.at[u as usize]) * (0.5 * w);
        weight += w;
    }
    let to = if weight > 0.0 { sum / weight } else { here };
    let way = tangential(fabric, v, &tie, to - here);
    let Landing { at, gradient, evaluations, .. } = land(fabric.field, here + way, &tie, Approach::follow(longest_mm));
    let normal = if evaluations > 0 { -gradient.normalize_or_zero() } else { fabric.normal[v as usize] };
    Place { at, normal, size: fabric.size[v as usize], evaluations }
}
