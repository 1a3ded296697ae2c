//! How far the final surface lies from a reference surface (the fit before smoothing), signed.

use crate::land::{Approach, Tie, land};
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use glam::DVec3;
use implicit::Field;
use space::P3;

/// Signed distances of vertices from the reference, positive outward.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Displacement {
    /// Per vertex, mm.
    pub mm: Vec<f64>,
    /// Per vertex, pixels.
    pub px: Vec<f64>,
    /// Smallest (most inward), mm.
    pub min_mm: f64,
    /// Largest (most outward), mm.
    pub max_mm: f64,
    /// Root mean square over the vertices, mm.
    pub rms_mm: f64,
    /// Vertices whose foot point was not found; their distance is first-order, f / |grad f|.
    pub first_order: usize,
    /// Calls of (f, grad f) of the reference.
    pub evaluations: usize,
}

/// Rounds of Hartmann's iteration; from one pixel away it needs 3 to 6.
const ROUNDS: usize = 24;
/// The foot point stands still when it is off the normal by less than this, mm ...
const STILL_MM: f64 = 1e-7;
/// ... plus this part of the distance: the distance is then wrong by 5e-7 of itself.
const STILL: f64 = 1e-3;
/// A landing is over after the Newton step from a point this near: the step leaves about its square, mm.
const ENOUGH_MM: f64 = 1e-4;
/// |f| / |grad f| at which no step is needed, mm.
const LANDED_MM: f64 = 1e-9;

/// The signed distance of every vertex of `mesh` to the zero set of `reference`, positive where the vertex lies outside
/// (f < 0 there), in mm and in pixels of `pixel_mm`.
///
/// A vertex inside a cap is no part of the wall: its displacement is 0 and does not count.
///
/// The foot point is found by Hartmann's iteration (1999): land on f = 0 along the gradient, step within the tangent
/// plane towards the vertex, repeat. It is the nearest point when the vertex is nearer than the radius of curvature.
///
/// # Errors
/// [`Error::Settings`] for a pixel that is not positive, [`Error::NotFinite`], [`Error::Cancelled`].
pub fn displacement(mesh: &TriMesh, reference: &dyn Field, pixel_mm: f64, ctx: &Ctx) -> Result<Displacement, Error> {
    if !(pixel_mm.is_finite() && pixel_mm > 0.0) {
        return Err(Error::Settings { field: "pixel_mm", value: pixel_mm, need: "a positive length" });
    }
    let wall = wall_vertices(mesh);
    let feet = ctx.map_range(mesh.vertices.len(), |v| match wall[v] {
        true => foot(reference, mesh.vertices[v].raw(), pixel_mm),
        false => Foot { mm: 0.0, found: true, evaluations: 0 },
    })?;
    let mut d = Displacement { min_mm: f64::INFINITY, max_mm: f64::NEG_INFINITY, ..Displacement::default() };
    for (foot, &at) in feet.iter().zip(&mesh.vertices) {
        if !foot.mm.is_finite() {
            return Err(Error::NotFinite { at });
        }
        d.mm.push(foot.mm);
        d.px.push(foot.mm / pixel_mm);
        d.min_mm = d.min_mm.min(foot.mm);
        d.max_mm = d.max_mm.max(foot.mm);
        d.rms_mm += foot.mm * foot.mm;
        d.evaluations += foot.evaluations;
        d.first_order += usize::from(!foot.found);
    }
    if d.mm.is_empty() {
        return Ok(Displacement::default());
    }
    d.rms_mm = (d.rms_mm / wall.iter().filter(|w| **w).count().max(1) as f64).sqrt();
    ctx.progress(1.0);
    Ok(d)
}

/// Vertices that are not strictly inside a cap.
fn wall_vertices(mesh: &TriMesh) -> Vec<bool> {
    let mut touches = vec![(false, false); mesh.vertices.len()];
    for (t, &id) in mesh.triangles.iter().zip(&mesh.face_id) {
        for &v in t {
            let touch = &mut touches[v as usize];
            if id == WALL { touch.0 = true } else { touch.1 = true }
        }
    }
    touches.into_iter().map(|(wall, cap)| wall || !cap).collect()
}

struct Foot {
    mm: f64,
    found: bool,
    evaluations: usize,
}

fn foot(field: &dyn Field, x: DVec3, step_mm: f64) -> Foot {
    let approach = Approach { tolerance_mm: LANDED_MM, enough_mm: ENOUGH_MM, ..Approach::exact(step_mm) };
    let (mut at, mut evaluations) = (x, 0);
    for _ in 0..ROUNDS {
        let l = land(field, at, &Tie::WALL, approach);
        evaluations += l.evaluations;
        if !l.at.is_finite() || l.distance.is_nan() || l.distance > approach.enough_mm {
            break;
        }
        // -grad f / |grad f| looks outward
        let n = -l.gradient.normalize_or_zero();
        let way = x - l.at;
        let along = n.dot(way);
        let across = way - n * along;
        if across.length() <= STILL_MM + STILL * along.abs() {
            return Foot { mm: along, found: true, evaluations };
        }
        at = l.at + across.clamp_length_max(step_mm);
    }
    let (f, g) = field.gradient(P3::from_raw(x));
    Foot { mm: -f / g.length(), found: false, evaluations: evaluations + 1 }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fields;

    #[test]
    fn spheres_have_their_difference_of_radii_as_displacement() {
        let ctx = Ctx::new(2).unwrap();
        let small = fields::sphere(P3::ORIGIN, 3.0);
        let large = fields::sphere(P3::new(0.2, 0.0, 0.0), 3.5);
        let mesh = TriMesh { vertices: vec![P3::new(3.0, 0.0, 0.0), P3::new(-1.8, 2.4, 0.0)], ..TriMesh::default() };
        let d = displacement(&mesh, &large, 0.5, &ctx).unwrap();
        let want = [-0.7, 2.0_f64.hypot(2.4) - 3.5];
        for (got, want) in d.mm.iter().zip(want) {
            assert!((got - want).abs() < 1e-9, "{got} {want}");
        }
        assert_eq!(d.first_order, 0);
        let zero = displacement(&mesh, &small, 0.5, &ctx).unwrap();
        assert!(zero.rms_mm < 1e-9);
    }
}
