//! The last degrees: triangle by triangle, the worst first, try what raises the smallest angle around.
//!
//! Botsch and Kobbelt's passes leave a few triangles of 15 to 28 degrees where valences 5 and 7 sit next to each other.
//! A flip, a better place for one of the corners, or a collapse is accepted only if the smallest angle of all triangles
//! that it touches grows, so the passes cannot undo each other.

use crate::Error;
use crate::fabric::{Fabric, Seat, Worth, cotangents};
use crate::improve::tangential;
use crate::land::{Approach, Landing, Tie, land};
use crate::web::GONE;
use exec::Ctx;
use glam::DVec3;

/// Angles with a cotangent below this are bad as well (105 degrees).
const WIDE: f64 = -0.268;
/// A collapse here may leave edges up to this times their wanted length.
const STRETCH: f64 = 1.6;

/// Work on triangles with an angle below `goal_deg` until none is left or nothing helps; gives the number of changes.
pub(crate) fn polish(fabric: &mut Fabric<'_>, goal_deg: f64, rounds: usize, ctx: &Ctx) -> Result<usize, Error> {
    let goal = goal_deg.to_radians().tan().recip();
    let mut total = 0;
    for _ in 0..rounds {
        let mut bad: Vec<(f64, usize)> = (0..fabric.web.face_id.len())
            .filter(|&t| fabric.web.face_id[t] != GONE && fabric.may_change(3 * t as u32))
            .filter_map(|t| Some((badness(fabric, t, goal)?, t)))
            .collect();
        bad.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        let mut changes = 0;
        for (i, &(_, t)) in bad.iter().enumerate() {
            if i % 64 == 0 {
                ctx.check()?;
            }
            if fabric.web.face_id[t] != GONE && badness(fabric, t, goal).is_some() && mend(fabric, t) {
                changes += 1;
            }
        }
        total += changes;
        if changes == 0 {
            break;
        }
    }
    Ok(total)
}

/// The largest cotangent of a triangle that is too thin or too wide.
fn badness(fabric: &Fabric<'_>, t: usize, goal: f64) -> Option<f64> {
    let c = cotangents(fabric.places(fabric.web.corners(t))).0;
    let (least, most) = (c[0].min(c[1]).min(c[2]), c[0].max(c[1]).max(c[2]));
    (most > goal || least < WIDE).then_some(most)
}

/// Try flips, then places, then collapses at one triangle.
fn mend(fabric: &mut Fabric<'_>, t: usize) -> bool {
    let edges = [0, 1, 2].map(|k| (3 * t + k) as u32);
    for h in edges {
        if fabric.flip_worth(h).is_some_and(|(before, after)| after.improves(before)) {
            fabric.web.flip(h);
            return true;
        }
    }
    let mut moved = false;
    for v in fabric.web.corners(t) {
        moved |= better_place(fabric, v);
    }
    if moved {
        return true;
    }
    for h in edges {
        for way in [h, fabric.web.twin[h as usize]] {
            if fabric.collapse_worth(way, STRETCH).is_some_and(|(before, after)| after.improves(before)) {
                fabric.web.collapse(way);
                return true;
            }
        }
    }
    false
}

/// Search a vertex's surroundings for the place with the largest smallest angle, in rings of shrinking radius; land
/// there if the gain survives the landing.
fn better_place(fabric: &mut Fabric<'_>, v: u32) -> bool {
    let (tie, ways) = match fabric.seat(v) {
        Seat::Fixed => return false,
        Seat::Face(tie) => (tie, around(fabric, v, &tie, None)),
        Seat::Crease(tie, marks) => {
            let chord = fabric.web.at[fabric.web.target(marks[0]) as usize]
                - fabric.web.at[fabric.web.target(marks[1]) as usize];
            (tie, around(fabric, v, &tie, Some(chord)))
        }
    };
    let before = fabric.star(v);
    let here = fabric.web.at[v as usize];
    let (mut best, mut place) = (before, here);
    let mut step = 0.25 * fabric.size[v as usize];
    for _ in 0..7 {
        let tries = ways.iter().map(|&w| (fabric.star_moved(v, place + w * step), place + w * step));
        let top = tries.fold((Worth::BEST, None::<DVec3>), |top, (w, p)| match top.1 {
            Some(_) if top.0.cot <= w.cot => top,
            _ => (w, Some(p)),
        });
        match top {
            (w, Some(p)) if w.improves(best) => (best, place) = (w, p),
            _ => step *= 0.5,
        }
    }
    if !best.improves(before) {
        return false;
    }
    let l: Landing = land(fabric.field, place, &tie, Approach::follow(fabric.size[v as usize]));
    fabric.evaluations += l.evaluations;
    if !l.at.is_finite() || !fabric.star_moved(v, l.at).improves(before) {
        return false;
    }
    fabric.evaluations -= l.evaluations; // `take` counts them
    fabric.take(v, &l);
    true
}

/// Unit ways in which a vertex may be moved: eight in its surface, two along its curve.
fn around(fabric: &Fabric<'_>, v: u32, tie: &Tie, along: Option<DVec3>) -> Vec<DVec3> {
    if let Some(chord) = along {
        let d = tangential(fabric, v, tie, chord).normalize_or_zero();
        return vec![d, -d];
    }
    let n = if tie.wall {
        fabric.normal[v as usize]
    } else {
        tie.planes[0].or(tie.planes[1]).map_or(DVec3::Z, |p| p.normal)
    };
    let (e, f) = n.try_normalize().unwrap_or(DVec3::Z).any_orthonormal_pair();
    (0..8)
        .map(|k| {
            let (s, c) = (f64::from(k) * std::f64::consts::FRAC_PI_4).sin_cos();
            e * c + f * s
        })
        .collect()
}
