//! How good the mesh is: shapes of triangles, and their distance from f = 0.

use crate::fabric::angles;
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use implicit::Field;
use space::P3;

/// Shapes and distances of a mesh. Distances are first-order, |f| / |grad f|, over wall faces.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Quality {
    /// Smallest angle of any triangle, degrees.
    pub min_angle_deg: f64,
    /// Mean over triangles of their smallest angle, degrees.
    pub mean_min_angle_deg: f64,
    /// Largest angle of any triangle, degrees.
    pub max_angle_deg: f64,
    /// Largest aspect: longest edge over 2 sqrt(3) times the inscribed radius (1 for an equilateral triangle).
    pub max_aspect: f64,
    /// Mean aspect.
    pub mean_aspect: f64,
    /// Largest equiangular skew: how far the angles stray from 60 degrees, 0 equilateral to 1 flat,
    /// max((largest - 60) / 120, (60 - smallest) / 60).
    pub max_skew: f64,
    /// Mean skew.
    pub mean_skew: f64,
    /// Largest distance of a wall vertex from f = 0, mm.
    pub vertex_max_mm: f64,
    /// Largest distance of a point inside a wall face (centre or middle of an edge) from f = 0, mm.
    pub face_max_mm: f64,
    /// Root mean square over the wall's area (seven-point rule per face: centre, edge middles, corners), mm.
    pub face_rms_mm: f64,
    /// Triangle with the smallest angle, and its centre.
    pub worst: usize,
    /// Centre of the worst triangle.
    pub worst_at: P3,
    /// Place of the largest distance.
    pub farthest_at: P3,
}

/// The shape of one triangle: smallest and largest angle in radians, aspect.
fn shape(mesh: &TriMesh, t: usize) -> [f64; 3] {
    let p = mesh.corners(t).map(|p| p.raw());
    let a = angles(p);
    let e = [p[1].distance(p[2]), p[2].distance(p[0]), p[0].distance(p[1])];
    let longest = e[0].max(e[1]).max(e[2]);
    let inscribed = mesh.area_vector(t).length() / (e[0] + e[1] + e[2]);
    [a[0].min(a[1]).min(a[2]), a[0].max(a[1]).max(a[2]), longest / (12_f64.sqrt() * inscribed)]
}

/// Measure a mesh. Cost: one (f, grad f) per wall vertex and four per wall face, in parallel.
///
/// # Errors
/// [`Error::Cancelled`].
pub fn quality(mesh: &TriMesh, field: &dyn Field, ctx: &Ctx) -> Result<Quality, Error> {
    let mut q = Quality { min_angle_deg: 180.0, ..Quality::default() };
    let n = mesh.triangles.len();
    for t in 0..n {
        let [least, most, aspect] = shape(mesh, t);
        q.mean_min_angle_deg += least.to_degrees() / n as f64;
        q.mean_aspect += aspect / n as f64;
        q.max_angle_deg = q.max_angle_deg.max(most.to_degrees());
        q.max_aspect = q.max_aspect.max(aspect);
        let skew = ((most.to_degrees() - 60.0) / 120.0).max((60.0 - least.to_degrees()) / 60.0);
        q.max_skew = q.max_skew.max(skew);
        q.mean_skew += skew / n as f64;
        if least.to_degrees() < q.min_angle_deg {
            q.min_angle_deg = least.to_degrees();
            q.worst = t;
            q.worst_at = P3::centroid(&mesh.corners(t)).unwrap_or_default();
        }
    }
    distances(mesh, field, &mut q, ctx)?;
    ctx.progress(1.0);
    Ok(q)
}

fn distances(mesh: &TriMesh, field: &dyn Field, q: &mut Quality, ctx: &Ctx) -> Result<(), Error> {
    let off = |x: P3| {
        let (f, g) = field.gradient(x);
        f.abs() / g.length()
    };
    let wall: Vec<usize> = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL).collect();
    let mut used = vec![false; mesh.vertices.len()];
    wall.iter().flat_map(|&t| mesh.triangles[t]).for_each(|v| used[v as usize] = true);
    let vertex = ctx.map_range(used.len(), |v| if used[v] { off(mesh.vertices[v]) } else { 0.0 })?;
    q.vertex_max_mm = vertex.iter().copied().fold(0.0, f64::max);
    let inside = ctx.map(&wall, |&t| {
        let [a, b, c] = mesh.corners(t);
        let centre = a.lerp(b, 0.5).lerp(c, 1.0 / 3.0);
        [centre, a.lerp(b, 0.5), b.lerp(c, 0.5), c.lerp(a, 0.5)].map(|x| (off(x), x))
    })?;
    let (mut square, mut area) = (0.0, 0.0);
    for (&t, points) in wall.iter().zip(&inside) {
        let w = mesh.area_vector(t).length();
        // Degree-3 rule: 27/60 at the centre, 8/60 at the middles, 3/60 at the corners (which lie on the wall).
        let middles = points[1..].iter().fold(0.0, |s, p| s + p.0 * p.0);
        let corners = mesh.triangles[t].iter().fold(0.0, |s, &v| s + vertex[v as usize] * vertex[v as usize]);
        square += w * (27.0 * points[0].0 * points[0].0 + 8.0 * middles + 3.0 * corners) / 60.0;
        area += w;
        for &(d, x) in points {
            if d > q.face_max_mm {
                (q.face_max_mm, q.farthest_at) = (d, x);
            }
        }
    }
    q.face_rms_mm = if area > 0.0 { (square / area).sqrt() } else { 0.0 };
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fields;

    #[test]
    fn shapes_and_distances_have_their_closed_forms() {
        // An equilateral triangle and a right-angled one with its corners on a sphere of radius 1.
        let p = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]];
        let vertices = p.map(|[x, y, z]| P3::new(x, y, z)).to_vec();
        let mesh = TriMesh { vertices, triangles: vec![[0, 1, 2], [0, 1, 3]], face_id: vec![WALL; 2] };
        let q = quality(&mesh, &fields::sphere(P3::ORIGIN, 1.0), &Ctx::new(1).unwrap()).unwrap();
        assert!((q.max_angle_deg - 90.0).abs() < 1e-9 && (q.min_angle_deg - 45.0).abs() < 1e-9);
        assert!((q.mean_min_angle_deg - 52.5).abs() < 1e-9);
        assert!((q.max_skew - 0.25).abs() < 1e-9 && (q.mean_skew - 0.125).abs() < 1e-9, "{q:?}");
        // Longest edge over 2 sqrt(3) r: 2 / (sqrt(12) (sqrt(2) - 1)) and 1.
        let right = 2.0 / (12_f64.sqrt() * (2_f64.sqrt() - 1.0));
        assert!((q.max_aspect - right).abs() < 1e-9 && (q.mean_aspect - 0.5 * (1.0 + right)).abs() < 1e-9);
        assert!(q.vertex_max_mm < 1e-12 && q.worst == 1);
        // The middle of the long edge is the centre of the sphere.
        assert!((q.face_max_mm - 1.0).abs() < 1e-9 && q.farthest_at.distance(P3::ORIGIN) < 1e-9);
    }
}
