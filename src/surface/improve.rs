//! The four passes of Botsch and Kobbelt (2004): split long edges, collapse short ones, flip towards valence six, move
//! vertices within the surface. Connectivity changes one edge at a time in a fixed order; f is evaluated in parallel
//! batches, so the result does not depend on the number of threads.

use crate::fabric::{Fabric, Seat};
use crate::land::{Approach, Landing, land};
use crate::sizing::{Rule, measure};
use crate::web::{NONE, prev};
use crate::{Error, WALL};
use exec::Ctx;
use glam::DVec3;
use space::P3;

/// Edges longer than this times the wanted length are split, the bounds of Botsch and Kobbelt.
pub(crate) const LONG: f64 = 4.0 / 3.0;
/// Edges shorter than this times the wanted length are collapsed.
const SHORT: f64 = 4.0 / 5.0;
/// No pass may leave an angle below this, radians (12 degrees), unless there was a smaller one before.
const FLOOR: f64 = 0.2;
/// Edges between two looks at the cancel token.
const BETWEEN_CHECKS: usize = 2048;

/// Split every edge that is too long, until none is (each batch is landed and measured before the next).
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
        let mut fresh = Vec::with_capacity(long.len());
        for (_, h) in long {
            let (a, b) = (fabric.web.origin[h as usize] as usize, fabric.web.target(h) as usize);
            let (size, gradient) =
                (0.5 * (fabric.size[a] + fabric.size[b]), 0.5 * (fabric.gradient[a] + fabric.gradient[b]));
            let middle = 0.5 * (fabric.web.at[a] + fabric.web.at[b]);
            fresh.push(fabric.web.split(h, middle));
            fabric.size.push(size);
            fabric.gradient.push(gradient);
        }
        if fabric.triangles() > limit {
            let at = P3::from_raw(fabric.web.at[fresh[0] as usize]);
            return Err(Error::TooManyTriangles { limit, at });
        }
        count += fresh.len();
        fabric.settle(&fresh, Approach::follow(rule.edge_mm[1]), ctx)?;
        measure_graded(fabric, &fresh, rule, ctx)?;
    }
    Ok(count)
}

/// Measure new vertices, but let none be coarser than the interpolated size that it was born with times the grading.
fn measure_graded(fabric: &mut Fabric<'_>, fresh: &[u32], rule: &Rule, ctx: &Ctx) -> Result<(), Error> {
    let born: Vec<f64> = fresh.iter().map(|&v| fabric.size[v as usize]).collect();
    measure(fabric, fresh, rule, ctx)?;
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
    let ratio = |fabric: &Fabric<'_>, h: u32| fabric.web.length(h) / fabric.wanted(h);
    let mut short: Vec<(f64, u32)> = fabric.edges().map(|h| (ratio(fabric, h), h)).filter(|e| e.0 < SHORT).collect();
    short.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    let mut count = 0;
    for (i, (_, h)) in short.into_iter().enumerate() {
        if i % BETWEEN_CHECKS == 0 {
            ctx.check()?;
        }
        if !fabric.web.lives(h) || ratio(fabric, h) >= SHORT {
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
    let (mut count, mut corner, mut inner) = (0_i64, 0.0, true);
    for h in fabric.web.spokes(v) {
        if fabric.web.id(h) == id {
            count += 1;
            let p = fabric.places(fabric.web.corners(h as usize / 3));
            corner += crate::fabric::angles(p)[h as usize % 3];
        } else {
            inner = false;
        }
    }
    let ideal = if inner { 6 } else { ((corner / std::f64::consts::FRAC_PI_3).round() as i64).max(1) };
    (count + change - ideal).pow(2)
}

/// Move every vertex towards the weighted centroid of its surroundings, within its surface or curve.
pub(crate) fn smooth(fabric: &mut Fabric<'_>, longest_mm: f64, ctx: &Ctx) -> Result<usize, Error> {
    let vertices = fabric.living();
    let moves: Vec<Option<Landing>> = ctx.map(&vertices, |&v| {
        let seat = fabric.seat(v);
        let (to, tie) = match seat {
            Seat::Face(tie) => (centroid(fabric, v), tie),
            Seat::Crease(tie, marks) => (middle(fabric, v, marks), tie),
            Seat::Fixed => return None,
        };
        let here = fabric.web.at[v as usize];
        let way = tangential(fabric, v, &tie, to - here);
        Some(land(fabric.field, here + way, &tie, Approach::follow(longest_mm)))
    })?;
    let mut count = 0;
    for (&v, l) in vertices.iter().zip(&moves) {
        let Some(l) = l else { continue };
        fabric.evaluations += l.evaluations;
        let before = fabric.star(v);
        if l.at.is_finite() && fabric.star_moved(v, l.at).may_follow(before, FLOOR) {
            fabric.take(v, &Landing { evaluations: 0, ..*l });
            if l.evaluations > 0 {
                fabric.gradient[v as usize] = l.gradient;
            }
            count += 1;
        }
    }
    Ok(count)
}

/// The part of a way that stays in the vertex's surface.
pub(crate) fn tangential(fabric: &Fabric<'_>, v: u32, tie: &crate::land::Tie, way: DVec3) -> DVec3 {
    let free = tie.free(way);
    if !tie.wall {
        return free;
    }
    let n = tie.free(fabric.gradient[v as usize]).normalize_or_zero();
    free - n * n.dot(free)
}

/// Centroid of the surrounding triangles, weighted by area over size^4: the centroidal density for edges of that size.
fn centroid(fabric: &Fabric<'_>, v: u32) -> DVec3 {
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for h in fabric.web.spokes(v) {
        let k = fabric.web.corners(h as usize / 3);
        let p = fabric.places(k);
        let size = k.iter().map(|&u| fabric.size[u as usize]).sum::<f64>() / 3.0;
        let w = (p[1] - p[0]).cross(p[2] - p[0]).length() / size.powi(4);
        sum += (p[0] + p[1] + p[2]) * (w / 3.0);
        weight += w;
    }
    if weight > 0.0 { sum / weight } else { fabric.web.at[v as usize] }
}

/// The point of a curve between a vertex's two neighbours where both edges are equally long for their sizes.
fn middle(fabric: &Fabric<'_>, v: u32, marks: [u32; 2]) -> DVec3 {
    let here = fabric.web.at[v as usize];
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for h in marks {
        let u = fabric.web.target(h);
        let size = 0.5 * (fabric.size[u as usize] + fabric.size[v as usize]);
        let w = fabric.web.length(h) / size.powi(3);
        sum += (here + fabric.web.at[u as usize]) * (0.5 * w);
        weight += w;
    }
    if weight > 0.0 { sum / weight } else { here }
}

/// Drop what belongs to vertices that are gone, so that numbers stay dense.
pub(crate) fn compact(fabric: &mut Fabric<'_>) -> Result<(), Error> {
    let keep: Vec<usize> = (0..fabric.web.at.len()).filter(|&v| fabric.web.leaving[v] != NONE).collect();
    fabric.gradient = keep.iter().map(|&v| fabric.gradient[v]).collect();
    fabric.size = keep.iter().map(|&v| fabric.size[v]).collect();
    fabric.web = crate::web::Web::weave(&fabric.web.mesh())?;
    Ok(())
}
