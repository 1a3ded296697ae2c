//! Closing rim loops with planar triangles.
//!
//! A constrained Delaunay triangulation of the rim's vertices in the cap's plane (crate spade, exact predicates), of
//! which the triangles inside the loop are kept. No vertex is added, so rim edges are shared exactly.

use crate::cut::loops;
use crate::land::Flat;
use crate::web::{NONE, Web};
use crate::{Error, TriMesh, WALL};
use glam::DVec3;
use space::{P3, V3};
use spade::{ConstrainedDelaunayTriangulation, Point2, Triangulation};
use std::collections::BTreeMap;

/// A closed loop of rim vertices, counterclockwise about the plane's outward normal.
pub(crate) struct Rim {
    pub(crate) vertices: Vec<u32>,
    /// Number of the cut plane; the cap's id is one more.
    pub(crate) plane: usize,
}

/// A loop in its plane.
struct Outline {
    at: Vec<[f64; 2]>,
}

impl Outline {
    fn area(&self) -> f64 {
        let n = self.at.len();
        (0..n).fold(0.0, |s, i| {
            let (p, q) = (self.at[i], self.at[(i + 1) % n]);
            s + 0.5 * (p[0] * q[1] - q[0] * p[1])
        })
    }
    /// Even-odd rule.
    fn holds(&self, x: [f64; 2]) -> bool {
        let n = self.at.len();
        (0..n).fold(false, |inside, i| {
            let (p, q) = (self.at[i], self.at[(i + 1) % n]);
            let crosses = (p[1] > x[1]) != (q[1] > x[1]) && x[0] < (q[0] - p[0]) * (x[1] - p[1]) / (q[1] - p[1]) + p[0];
            inside != crosses
        })
    }
}

/// The mesh with every cap triangulated anew from its rim alone; vertices inside caps are dropped. The cap of plane k has
/// face id k + 1.
///
/// # Errors
/// [`Error::NestedRims`], [`Error::CrossedRim`].
pub(crate) fn recap(web: &Web, flats: &[Flat]) -> Result<TriMesh, Error> {
    let mut number = vec![NONE; web.at.len()];
    let mut mesh = TriMesh::default();
    let kept: Vec<usize> = (0..web.face_id.len()).filter(|&t| web.face_id[t] == WALL).collect();
    let edges: Vec<u32> =
        (0..web.origin.len() as u32).filter(|&h| web.lives(h) && web.id(h) != WALL && web.is_feature(h)).collect();
    let used = kept.iter().flat_map(|&t| web.corners(t)).chain(edges.iter().map(|&h| web.origin[h as usize]));
    for v in used {
        if number[v as usize] == NONE {
            number[v as usize] = mesh.vertices.len() as u32;
            mesh.vertices.push(P3::from_raw(web.at[v as usize]));
        }
    }
    for &t in &kept {
        mesh.triangles.push(web.corners(t).map(|v| number[v as usize]));
        mesh.face_id.push(WALL);
    }
    for (plane, flat) in flats.iter().enumerate() {
        let boundary: BTreeMap<u32, u32> = (edges.iter().filter(|&&h| web.id(h) as usize == plane + 1))
            .map(|&h| (number[web.origin[h as usize] as usize], number[web.target(h) as usize]))
            .collect();
        let rims: Vec<Rim> = loops(&boundary).into_iter().map(|vertices| Rim { vertices, plane }).collect();
        close(&mut mesh, &rims, flat)?;
    }
    Ok(mesh)
}

/// Close every rim of one plane.
pub(crate) fn close(mesh: &mut TriMesh, rims: &[Rim], plane: &Flat) -> Result<(), Error> {
    let (e, f) = plane.normal.any_orthonormal_pair();
    // (e, f, normal) right-handed, so that counterclockwise in the plane faces outward.
    let f = if e.cross(f).dot(plane.normal) < 0.0 { -f } else { f };
    let outlines: Vec<Outline> = rims
        .iter()
        .map(|r| {
            let flat = |&v: &u32| {
                let d = mesh.vertices[v as usize].raw() - plane.point;
                [d.dot(e), d.dot(f)]
            };
            Outline { at: r.vertices.iter().map(flat).collect() }
        })
        .collect();
    for (i, rim) in rims.iter().enumerate() {
        let at = mesh.vertices[rim.vertices[0] as usize];
        let nested = (0..rims.len()).any(|j| j != i && outlines[j].holds(outlines[i].at[0]));
        let area_mm2 = outlines[i].area();
        if nested || area_mm2 <= 0.0 {
            return Err(Error::NestedRims { plane: rim.plane, area_mm2: area_mm2.abs(), at });
        }
        let triangles = triangulate(&outlines[i]).ok_or(Error::CrossedRim { plane: rim.plane, at })?;
        for t in triangles {
            mesh.triangles.push(t.map(|k| rim.vertices[k]));
            mesh.face_id.push(rim.plane as u32 + 1);
        }
    }
    Ok(())
}

/// The triangles of a simple polygon by its vertex numbers; `None` when it crosses or touches itself.
fn triangulate(outline: &Outline) -> Option<Vec<[usize; 3]>> {
    let n = outline.at.len();
    let mut cdt = ConstrainedDelaunayTriangulation::<Point2<f64>>::new();
    let mut handles = Vec::with_capacity(n);
    for p in &outline.at {
        handles.push(cdt.insert(Point2::new(p[0], p[1])).ok()?);
    }
    if cdt.num_vertices() != n {
        return None;
    }
    for i in 0..n {
        let (a, b) = (handles[i], handles[(i + 1) % n]);
        if !cdt.can_add_constraint(a, b) {
            return None;
        }
        cdt.add_constraint(a, b);
    }
    let faces: Vec<[usize; 3]> = cdt.inner_faces().map(|face| face.vertices().map(|v| v.fix().index())).collect();
    let mut triangles = left_of_outline(&faces, n);
    triangles.iter_mut().for_each(|t| {
        let least = (0..3).min_by_key(|&k| t[k]).unwrap_or(0);
        t.rotate_left(least);
    });
    triangles.sort_unstable();
    (triangles.len() == n - 2).then_some(triangles)
}

/// The triangles left of the outline 0, 1, .. n - 1, by connection alone: a flat triangle along the outline has no
/// centre whose side could be told by coordinates.
fn left_of_outline(faces: &[[usize; 3]], n: usize) -> Vec<[usize; 3]> {
    let mut face_at = BTreeMap::new();
    for (f, t) in faces.iter().enumerate() {
        (0..3).for_each(|k| _ = face_at.insert((t[k], t[(k + 1) % 3]), f));
    }
    let mut inside = vec![false; faces.len()];
    let mut open: Vec<usize> = (0..n).filter_map(|i| face_at.get(&(i, (i + 1) % n)).copied()).collect();
    while let Some(f) = open.pop() {
        if std::mem::replace(&mut inside[f], true) {
            continue;
        }
        let t = faces[f];
        for (a, b) in (0..3).map(|k| (t[k], t[(k + 1) % 3])).filter(|&(a, b)| (a + 1) % n != b) {
            open.extend(face_at.get(&(b, a)).filter(|&&o| !inside[o]));
        }
    }
    faces.iter().zip(inside).filter(|(_, inside)| *inside).map(|(t, _)| *t).collect()
}

/// A field that closes itself a little outside some cut planes: min(f, `margin_mm` - distance outside).
///
/// Beyond the data a variational function may go anywhere. Polygonising this field instead keeps the surface within
/// `margin_mm` of the cut planes; within the planes, and up to the margin outside, it is f itself, so [`crate::cut`] by
/// the same planes gives the same result as without it. Past a plane what is out of the data's box counts as farther out by
/// its distance from the box: a vessel that leaves through the end slice at a few degrees runs far beyond its last
/// contour there, all of it past the plane. Not smooth at the margin: do not remesh on it.
pub struct Bounded<'a> {
    field: &'a dyn implicit::Field,
    flats: Vec<Flat>,
    margin_mm: f64,
}

/// Where the field is closed.
struct Room {
    /// Distance to there, mm; negative beyond.
    mm: f64,
    /// Its gradient.
    gradient: DVec3,
}

impl<'a> Bounded<'a> {
    /// Close `field` at `margin_mm` outside each plane.
    pub fn new(field: &'a dyn implicit::Field, cuts: &[imaging::CutPlane], margin_mm: f64) -> Self {
        Self { field, flats: cuts.iter().filter_map(Flat::of).collect(), margin_mm }
    }
    /// The plane that is nearest to being left.
    fn nearest(&self, x: P3) -> Option<Room> {
        let bounds = self.field.bounds();
        let x = x.raw();
        let out = x - x.clamp(bounds.min.raw(), bounds.max.raw());
        let room = self.flats.iter().map(|f| match f.beyond(x) {
            past if past > 0.0 => {
                let aside = out - f.normal * out.dot(f.normal);
                Room { mm: self.margin_mm - past - aside.length(), gradient: -f.normal - aside.normalize_or_zero() }
            }
            past => Room { mm: self.margin_mm - past, gradient: -f.normal },
        });
        room.min_by(|a, b| a.mm.total_cmp(&b.mm))
    }
}

impl implicit::Field for Bounded<'_> {
    fn value(&self, x: P3) -> f64 {
        match self.nearest(x) {
            // Outside the margin the sign is known: f is not needed, nor trusted.
            Some(room) if room.mm <= 0.0 => room.mm,
            Some(room) => room.mm.min(self.field.value(x)),
            None => self.field.value(x),
        }
    }
    fn gradient(&self, x: P3) -> (f64, space::V3) {
        let (f, g) = self.field.gradient(x);
        match self.nearest(x) {
            Some(room) if room.mm < f => (room.mm, space::V3::from_raw(room.gradient)),
            _ => (f, g),
        }
    }
    fn hessian(&self, x: P3) -> (f64, space::V3, space::DMat3) {
        let (f, g, h) = self.field.hessian(x);
        match self.nearest(x) {
            Some(room) if room.mm < f => (room.mm, space::V3::from_raw(room.gradient), space::DMat3::ZERO),
            _ => (f, g, h),
        }
    }
    fn values(&self, xs: &[P3], out: &mut [f64]) {
        self.field.values(xs, out);
        for (o, &x) in out.iter_mut().zip(xs) {
            match self.nearest(x) {
                Some(room) if room.mm <= 0.0 => *o = room.mm,
                Some(room) => *o = o.min(room.mm),
                None => {}
            }
        }
    }
    fn bounds(&self) -> space::Aabb<space::Patient> {
        self.field.bounds()
    }
}

/// How far points inside a cap may lie off its plane, mm; caps are planar to 1e-9 mm.
const ROUGH_MM: f64 = 1e-10;

/// Move the points inside caps (face id, normal) off their planes by up to [`ROUGH_MM`]: hundreds of points in one plane to the
/// last bit are what VTK's Delaunay tetrahedra fail on, and with them the centrelines of VMTK.
pub(crate) fn roughen(mesh: &mut TriMesh, caps: &[(u32, V3)]) {
    /// Of a vertex that belongs to faces of several ids.
    const MIXED: u32 = u32::MAX;
    let mut of: Vec<Option<u32>> = vec![None; mesh.vertices.len()];
    for (t, &id) in mesh.triangles.iter().zip(&mesh.face_id) {
        for &v in t {
            let known = &mut of[v as usize];
            *known = Some(if known.is_none_or(|other| other == id) { id } else { MIXED });
        }
    }
    for &(id, normal) in caps {
        let inner = mesh.vertices.iter_mut().zip(&of).filter(|(_, of)| **of == Some(id));
        for (k, (x, _)) in inner.enumerate() {
            // steps of an irrational number: no two points alike
            *x += normal * (ROUGH_MM * (2.0 * (k as f64 * 0.618_034).fract() - 1.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::Analytic;
    use implicit::Field as _;
    use space::{Aabb, V3};

    #[test]
    fn past_a_plane_the_box_of_the_data_ends_the_field_too() {
        let bounds = Aabb { min: P3::ORIGIN, max: P3::new(10.0, 10.0, 10.0) };
        let everywhere = Analytic { f: Box::new(|_| (1.0, V3::Z)), bounds };
        let end = [imaging::CutPlane::new(P3::new(5.0, 5.0, 10.0), V3::Z)];
        let bounded = Bounded::new(&everywhere, &end, 2.0);
        let of = |x: f64, z: f64| bounded.value(P3::new(x, 5.0, z));
        assert_eq!([of(5.0, 9.0), of(5.0, 10.5), of(5.0, 12.5)], [1.0, 1.0, -0.5]);
        // beside the box: as it is on the inner side, closed on the outer
        assert_eq!([of(-1.5, 9.0), of(-1.5, 11.0)], [1.0, -0.5]);
        let (f, gradient) = bounded.gradient(P3::new(-1.5, 5.0, 11.0));
        assert_eq!((f, gradient.to_array()), (-0.5, [1.0, 0.0, -1.0]));
        let mut all = [0.0; 2];
        bounded.values(&[P3::new(-1.5, 5.0, 9.0), P3::new(-1.5, 5.0, 11.0)], &mut all);
        assert_eq!(all, [1.0, -0.5]);
    }

    #[test]
    fn only_points_inside_a_cap_leave_its_plane_and_by_less_than_its_tolerance() {
        let ring = (0..6).map(|k| f64::from(k).to_radians() * 60.0).map(|a| P3::new(a.cos(), a.sin(), 0.0));
        let mut mesh =
            TriMesh { vertices: ring.chain([P3::ORIGIN, P3::new(0.0, 0.0, -1.0)]).collect(), ..TriMesh::default() };
        for k in 0..6 {
            let (a, b) = (k, (k + 1) % 6);
            mesh.triangles.extend([[a, b, 6], [b, a, 7]]);
            mesh.face_id.extend([1, WALL]);
        }
        let before = mesh.clone();
        roughen(&mut mesh, &[(1, V3::Z)]);
        let off = mesh.vertices[6].z().abs();
        assert!(off > 0.0 && off <= ROUGH_MM, "{off}");
        assert!((0..8).filter(|&v| v != 6).all(|v| mesh.vertices[v] == before.vertices[v]));
    }
}
