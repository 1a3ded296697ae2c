//! Flow extensions: every opening is continued by a straight duct that carries the true section on.
//!
//! The duct's direction is the one to which the wall at the rim is most nearly parallel (least eigenvector of the normals'
//! second moment), so that it needs no medial line. From a rim point p the duct runs p + s d + g(s) (t - d) with t the
//! wall's own direction at p (in its tangent plane, t.d = 1) and g(s) = s (1 - s / l)^2: it leaves the wall in its tangent
//! plane (G1), and from s = l on it is the rim's section swept along d, whatever its shape. l is one diameter, or less
//! where the wall's taper would change the area by more than [`AREA_CHANGE`]. The duct ends in a plane normal to d, in a
//! cap meshed like the wall; rims are shared, not copied.
//!
//! Rejected: a circle of equal area at the far end (what VMTK's flow extensions blend into): it loses the section.

use crate::fabric::Fabric;
use crate::improve::{collapse_short, flip_to_valence, smooth, split_long};
use crate::land::Flat;
use crate::polish::polish;
use crate::ring::Ring;
use crate::sizing::Rule;
use crate::web::Web;
use crate::{Cap, Error, Sizing, TriMesh, WALL, self_intersections};
use exec::Ctx;
use glam::{DMat3, DVec3};
use implicit::Field;
use space::{P3, V3};

/// Where and how far to extend.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extension {
    /// Face id of the cap that is replaced.
    pub face_id: u32,
    /// Length from the old cap's centroid to the new one's, in diameters of the section (area-equivalent, normal to the
    /// duct).
    pub diameters: f64,
}

/// What was added at one end.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtensionReport {
    /// Face id, of the old cap and of the new one.
    pub face_id: u32,
    /// Unit vector along the duct, out of the lumen.
    pub direction: V3,
    /// Area-equivalent diameter of the section, mm.
    pub diameter_mm: f64,
    /// Distance between the two caps' centroids along the duct, mm.
    pub length_mm: f64,
    /// Length over which the wall's own direction fades, mm.
    pub blend_mm: f64,
    /// Largest change of the section's area along the blend, part of it.
    pub area_change: f64,
    /// The new cap.
    pub cap: Cap,
}

/// A surface with its extensions.
#[derive(Clone, Debug, PartialEq)]
pub struct Extended {
    /// Closed mesh; its first wall faces are those of the given one, in their order, and so are its first vertices but
    /// for those inside the old caps.
    pub mesh: TriMesh,
    /// Per end, in the order asked for.
    pub ends: Vec<ExtensionReport>,
    /// Wall faces from this number up to the first cap's belong to extensions.
    pub first_face: usize,
}

/// Largest change of area along the blend, part of the area; the bar is .01.
const AREA_CHANGE: f64 = 0.008;
/// Least cosine between a cut's normal and the duct: beyond 60 degrees the rim is twice as long as the section.
const OBLIQUE: f64 = 0.5;
/// Height of an equilateral triangle.
const ROW: f64 = 0.866_025_403_784;
/// Rounds of the cap's meshing; it is a plane polygon with a fixed rim.
const CAP_ROUNDS: usize = 6;
/// Smallest angle up to which cap triangles are mended, degrees.
const CAP_GOAL_DEG: f64 = 34.0;

/// Replace caps of a closed, remeshed wall by ducts that end in caps of the same face ids.
///
/// `field` gives the wall's direction at the rims. The wall itself is untouched, bit for bit. Lengths are exact (1e-9 of
/// themselves); the section is that of the rim seen along the duct, to the fourth order in the rim's edge.
///
/// # Errors
/// [`Error::ObliqueEnd`], [`Error::ExtensionMeets`] when a duct runs into the wall or another duct, [`Error::ShortEnd`]
/// when it is shorter than the cut is oblique, [`Error::Settings`], [`Error::Defect`], [`Error::Cancelled`].
pub fn extend(mesh: &TriMesh, field: &dyn Field, wanted: &[Extension], ctx: &Ctx) -> Result<Extended, Error> {
    let web = Web::weave(mesh)?;
    let most = mesh.face_id.iter().copied().max().unwrap_or(WALL);
    let replaced = |id: u32| wanted.iter().any(|w| w.face_id == id);
    let (mut out, number) = without(mesh, replaced);
    let first_face = out.triangles.len();
    let mut ducts = Vec::with_capacity(wanted.len());
    for w in wanted {
        ctx.check()?;
        if !(w.diameters.is_finite() && w.diameters > 0.0) || w.face_id == WALL || w.face_id > most {
            let need = "positive, for the face id of a cap";
            return Err(Error::Settings { field: "extension_diameters", value: w.diameters, need });
        }
        let duct = Duct::new(&web, field, *w, &number)?;
        ducts.push(duct.build(&mut out));
    }
    let built = out.triangles.len();
    for (t, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != WALL && !replaced(**id)) {
        out.triangles.push(t.map(|v| number[v as usize]));
        out.face_id.push(id);
    }
    let mesh = capped(&out, field, &ducts, ctx)?;
    clear(&mesh, first_face, built, &ducts, ctx)?;
    let ends = ducts.iter().map(|d| d.report(&mesh)).collect();
    Ok(Extended { mesh, ends, first_face })
}

/// The wall faces of a mesh alone, with the vertices that they use: the open variant for programs that cap themselves.
pub fn open(mesh: &TriMesh) -> TriMesh {
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    let mut out = TriMesh::default();
    for (t, _) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id == WALL) {
        out.triangles.push(t.map(|v| {
            if number[v as usize] == u32::MAX {
                number[v as usize] = out.vertices.len() as u32;
                out.vertices.push(mesh.vertices[v as usize]);
            }
            number[v as usize]
        }));
        out.face_id.push(WALL);
    }
    out
}

/// A duct before it is meshed.
struct Duct {
    wanted: Extension,
    rim: Vec<u32>,
    /// Rim points, and t - d at them.
    curve: Ring,
    slope: Ring,
    centre: DVec3,
    direction: DVec3,
    diameter: f64,
    length: f64,
    blend: f64,
    area_change: f64,
}

/// A duct in the mesh.
struct Built {
    duct: Duct,
    plane: Flat,
    /// Its wall faces.
    faces: std::ops::Range<usize>,
    /// Rim of the new cap.
    last: Vec<u32>,
}

impl Duct {
    fn new(web: &Web, field: &dyn Field, wanted: Extension, number: &[u32]) -> Result<Self, Error> {
        let rim = rim_of(web, wanted.face_id)?;
        let n = rim.len();
        let points: Vec<DVec3> = rim.iter().map(|&v| web.at[v as usize]).collect();
        let normals: Vec<DVec3> =
            points.iter().map(|&p| -field.gradient(P3::from_raw(p)).1.raw().normalize_or_zero()).collect();
        let weight = |i: usize| 0.5 * points[(i + n - 1) % n].distance(points[(i + 1) % n]);
        // Twice the rim's area vector, seen from outside, and its centroid.
        let middle = points.iter().fold(DVec3::ZERO, |s, &p| s + p) / n as f64;
        let wedge = |i: usize| (points[i] - middle).cross(points[(i + 1) % n] - middle);
        let area = (0..n).fold(DVec3::ZERO, |s, i| s + 0.5 * wedge(i));
        let outward = area.normalize_or_zero();
        let third = |i: usize| (points[i] + points[(i + 1) % n] + middle) / 3.0;
        let centre = (0..n).fold(DVec3::ZERO, |s, i| s + third(i) * (0.5 * wedge(i).dot(outward))) / area.length();
        let direction = least_crossed(&normals, weight, outward);
        let cosine = direction.dot(outward);
        let at = P3::from_raw(centre);
        if cosine.is_nan() || cosine < OBLIQUE {
            return Err(Error::ObliqueEnd { face_id: wanted.face_id, angle_deg: cosine.acos().to_degrees(), at });
        }
        let section = area.dot(direction);
        let diameter = 2.0 * (section / std::f64::consts::PI).sqrt();
        let slopes = normals.iter().map(|&m| {
            let along = m.dot(direction);
            (direction - m * along) / (1.0 - along * along) - direction
        });
        let slope = Ring::through(&points, &slopes.collect::<Vec<_>>());
        let length = wanted.diameters * diameter;
        let mut duct = Self {
            wanted,
            rim: rim.iter().map(|&v| number[v as usize]).collect(),
            curve: Ring::through(&points, &points),
            slope,
            centre,
            direction,
            diameter,
            length,
            blend: diameter.min(length),
            area_change: 0.0,
        };
        duct.fit_blend(section, at)?;
        Ok(duct)
    }

    /// Shorten the blend until the section's area stays within its bound: the change is proportional to the length.
    fn fit_blend(&mut self, section: f64, at: P3) -> Result<(), Error> {
        let n = self.rim.len();
        let area = |g: f64| {
            let p = |i: usize| {
                let u = self.curve.knots[i % n];
                self.curve.at(u) + self.slope.at(u) * g - self.centre
            };
            (0..n).fold(0.0, |s, i| s + 0.5 * p(i).cross(p(i + 1)).dot(self.direction))
        };
        // g is largest at l / 3: 4 l / 27.
        let change = |l: f64| (area(4.0 * l / 27.0) / section - 1.0).abs();
        let (mut l, mut c) = (self.blend, change(self.blend));
        for _ in 0..8 {
            if c <= AREA_CHANGE {
                break;
            }
            l *= 0.95 * AREA_CHANGE / c;
            c = change(l);
        }
        let reach = self.curve.places.iter().fold(0.0_f64, |r, p| r.max((*p - self.centre).dot(self.direction)));
        let least = reach + l.min(0.5 * self.diameter);
        if self.length < least {
            let need_diameters = least / self.diameter;
            return Err(Error::ShortEnd { face_id: self.wanted.face_id, need_diameters, at });
        }
        (self.blend, self.area_change) = (l, c);
        Ok(())
    }

    /// The duct's point at rim parameter `u`, a fraction `part` of the way to the end plane.
    fn at(&self, u: f64, part: f64) -> DVec3 {
        let p = self.curve.at(u);
        let s = part * (self.length - (p - self.centre).dot(self.direction));
        let g = if s < self.blend { s * (1.0 - s / self.blend).powi(2) } else { 0.0 };
        p + self.direction * s + self.slope.at(u) * g
    }

    /// Rows of vertices, each shifted by half an edge against the one before, and the triangles between them.
    fn build(self, out: &mut TriMesh) -> Built {
        let n = self.rim.len();
        let edge = self.curve.length() / n as f64;
        // An even number: the last row then has the rim's own points, and its section to the bit.
        let rows = 2 * ((0.5 * self.length / (ROW * edge)).round() as usize).max(1);
        let from = out.triangles.len();
        let mut row: Vec<u32> = self.rim.clone();
        for k in 1..=rows {
            let part = k as f64 / rows as f64;
            let half = if k % 2 == 1 { 0.5 } else { 0.0 };
            let next: Vec<u32> = (0..n)
                .map(|i| {
                    let u = self.curve.between(i, half);
                    let mut x = self.at(u, part);
                    if k == rows {
                        x -= self.direction * ((x - self.centre).dot(self.direction) - self.length);
                    }
                    out.vertices.push(P3::from_raw(x));
                    out.vertices.len() as u32 - 1
                })
                .collect();
            for i in 0..n {
                let j = (i + 1) % n;
                let pair = if k % 2 == 1 {
                    [[row[i], row[j], next[i]], [row[j], next[j], next[i]]]
                } else {
                    [[row[i], row[j], next[j]], [row[i], next[j], next[i]]]
                };
                out.triangles.extend(pair);
                out.face_id.extend([WALL; 2]);
            }
            row = next;
        }
        let plane =
            Flat { point: self.centre + self.direction * self.length, normal: self.direction, reach: f64::INFINITY };
        Built { plane, faces: from..out.triangles.len(), last: row, duct: self }
    }
}

impl Built {
    fn report(&self, mesh: &TriMesh) -> ExtensionReport {
        let d = &self.duct;
        let id = d.wanted.face_id;
        let (mut area, mut sum) = (0.0, DVec3::ZERO);
        for t in (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == id) {
            let a = 0.5 * mesh.area_vector(t).length();
            area += a;
            sum += mesh.corners(t).iter().fold(DVec3::ZERO, |s, p| s + p.raw()) * (a / 3.0);
        }
        let n = self.last.len();
        let rim = |i: usize| mesh.vertices[self.last[i % n] as usize];
        let cap = Cap {
            face_id: id,
            plane: self.plane.cut(),
            cut: id as usize - 1,
            centroid: P3::from_raw(sum / area),
            area_mm2: area,
            perimeter_mm: (0..n).fold(0.0, |s, i| s + rim(i).distance(rim(i + 1))),
        };
        ExtensionReport {
            face_id: id,
            direction: V3::from_raw(d.direction),
            diameter_mm: d.diameter,
            length_mm: (sum / area - d.centre).dot(d.direction),
            blend_mm: d.blend,
            area_change: d.area_change,
            cap,
        }
    }
}

/// The rim of a cap, counterclockwise seen from outside.
fn rim_of(web: &Web, id: u32) -> Result<Vec<u32>, Error> {
    let edges = (0..web.origin.len() as u32)
        .filter(|&h| web.id(h) == id && web.is_feature(h))
        .map(|h| (web.origin[h as usize], web.target(h)))
        .collect();
    let mut rings = crate::cut::loops(&edges);
    match (rings.pop(), rings.first()) {
        (Some(ring), None) => Ok(ring),
        (Some(ring), Some(_)) => {
            let at = P3::from_raw(web.at[ring[0] as usize]);
            Err(Error::NestedRims { plane: id as usize - 1, area_mm2: 0.0, at })
        }
        _ => Err(Error::Settings { field: "extension_diameters", value: f64::from(id), need: "the face id of a cap" }),
    }
}

/// The unit vector that the normals cross least: least eigenvector of sum w n n^T, by inverse iteration.
fn least_crossed(normals: &[DVec3], weight: impl Fn(usize) -> f64, towards: DVec3) -> DVec3 {
    let mut m = DMat3::ZERO;
    let mut trace = 0.0;
    for (i, &n) in normals.iter().enumerate() {
        let w = weight(i);
        m += DMat3::from_cols(n * n.x, n * n.y, n * n.z) * w;
        trace += w;
    }
    let inverse = (m + DMat3::IDENTITY * (1e-9 * trace)).inverse();
    let d = (0..60).fold(towards, |d, _| (inverse * d).normalize_or_zero());
    if d.dot(towards) < 0.0 { -d } else { d }
}

/// Close the ducts with planar caps meshed at the size of their rims; everything else stays.
fn capped(open: &TriMesh, field: &dyn Field, ducts: &[Built], ctx: &Ctx) -> Result<TriMesh, Error> {
    let mut mesh = open.clone();
    for b in ducts {
        let rim = crate::cap::Rim { vertices: b.last.clone(), plane: b.duct.wanted.face_id as usize - 1 };
        crate::cap::close(&mut mesh, &[rim], &b.plane)?;
    }
    if ducts.is_empty() {
        return Ok(mesh);
    }
    let most = mesh.face_id.iter().copied().max().unwrap_or(WALL) as usize;
    let mut planes = vec![Flat { point: DVec3::ZERO, normal: DVec3::Z, reach: f64::INFINITY }; most];
    for b in ducts {
        planes[b.duct.wanted.face_id as usize - 1] = b.plane;
    }
    let fresh: Vec<bool> = (0..=most as u32).map(|id| ducts.iter().any(|b| b.duct.wanted.face_id == id)).collect();
    let mut fabric = Fabric::new(&mesh, field, planes)?;
    fabric.freeze(&fresh);
    for b in ducts {
        let edge = b.duct.curve.length() / b.last.len() as f64;
        for h in (0..fabric.web.origin.len()).filter(|&h| fabric.web.face_id[h / 3] == b.duct.wanted.face_id) {
            fabric.size[fabric.web.origin[h] as usize] = edge;
        }
    }
    let rule = Rule { sizing: Sizing::Uniform(1.0), edge_mm: [1.0, 1.0], max_error_mm: 1.0 };
    for _ in 0..CAP_ROUNDS {
        split_long(&mut fabric, &rule, usize::MAX, ctx)?;
        collapse_short(&mut fabric, ctx)?;
        flip_to_valence(&mut fabric, ctx)?;
        smooth(&mut fabric, 1.0, ctx)?;
    }
    polish(&mut fabric, CAP_GOAL_DEG, CAP_ROUNDS, ctx)?;
    let mut mesh = fabric.web.mesh();
    let caps: Vec<(u32, V3)> = ducts.iter().map(|b| (b.duct.wanted.face_id, V3::from_raw(b.plane.normal))).collect();
    crate::cap::roughen(&mut mesh, &caps);
    Ok(mesh)
}

/// The vertices that are left when the caps of some ids go, the wall's faces, and the new number of each vertex.
fn without(mesh: &TriMesh, gone: impl Fn(u32) -> bool) -> (TriMesh, Vec<u32>) {
    let mut used = vec![false; mesh.vertices.len()];
    let faces = mesh.triangles.iter().zip(&mesh.face_id);
    faces.clone().filter(|(_, id)| !gone(**id)).flat_map(|(t, _)| t).for_each(|&v| used[v as usize] = true);
    let mut number = vec![u32::MAX; used.len()];
    let mut out = TriMesh::default();
    for (v, _) in used.iter().enumerate().filter(|(_, u)| **u) {
        number[v] = out.vertices.len() as u32;
        out.vertices.push(mesh.vertices[v]);
    }
    for (t, _) in faces.filter(|(_, id)| **id == WALL) {
        out.triangles.push(t.map(|v| number[v as usize]));
        out.face_id.push(WALL);
    }
    (out, number)
}

/// No duct may pass through the wall, a cap or another duct.
fn clear(mesh: &TriMesh, first: usize, built: usize, ducts: &[Built], ctx: &Ctx) -> Result<(), Error> {
    let pairs = self_intersections(mesh, ctx)?;
    let of_ducts = pairs.iter().flatten().filter(|&&t| t >= first && (t < built || mesh.face_id[t] != WALL));
    let nearest = of_ducts
        .filter_map(|&t| {
            let b = ducts.iter().find(|b| b.faces.contains(&t) || b.duct.wanted.face_id == mesh.face_id[t])?;
            let at = P3::centroid(&mesh.corners(t))?;
            Some((((at.raw() - b.duct.centre).dot(b.duct.direction) / b.duct.diameter), b.duct.wanted.face_id, at))
        })
        .min_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    match nearest {
        Some((after_diameters, face_id, at)) => Err(Error::ExtensionMeets { face_id, after_diameters, at }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fields::{self, Analytic};
    use crate::{PolygoniseSettings, RemeshSettings, check, cut, polygonise, quality, remesh};
    use imaging::CutPlane;
    use space::{Aabb, Faulty};

    fn meshed(field: &Analytic, seed: P3, cuts: &[CutPlane], sizing: Sizing, ctx: &Ctx) -> TriMesh {
        let bounded = crate::Bounded::new(field, cuts, 2.0);
        let (raw, _) = polygonise(&bounded, &[seed], &PolygoniseSettings::default(), ctx).unwrap();
        let (mesh, _) = cut(&raw, field, cuts, ctx).unwrap();
        let s = RemeshSettings { sizing, ..RemeshSettings::default() };
        remesh(&mesh, field, cuts, &s, ctx).unwrap().0
    }

    fn plane(z: f64, n: V3) -> CutPlane {
        CutPlane::new(P3::new(0.0, 0.0, z), n)
    }

    fn all(mesh: &TriMesh, diameters: f64) -> Vec<Extension> {
        let most = mesh.face_id.iter().copied().max().unwrap();
        (1..=most).map(|face_id| Extension { face_id, diameters }).collect()
    }

    /// A tube along `axis` whose section is an ellipse with a bump: r = 2 + .5 cos 2 a + .2 cos 3 a, in mm, and whose
    /// radius grows by `taper` per mm.
    fn odd_tube(axis: V3, taper: f64) -> Analytic {
        let axis = axis.normalised().unwrap();
        let (e, g) = axis.raw().any_orthonormal_pair();
        let value = move |x: P3| {
            let d = x.raw();
            let (p, q) = (d.dot(e), d.dot(g));
            let (r, a) = (p.hypot(q), q.atan2(p));
            (2.0 + 0.5 * (2.0 * a).cos() + 0.2 * (3.0 * a).cos()) * (1.0 + taper * d.dot(axis.raw())) - r
        };
        let f = move |x: P3| {
            let h = 1e-6;
            let slope = |d: V3| (value(x + d * h) - value(x - d * h)) / (2.0 * h);
            (value(x), V3::new(slope(V3::X), slope(V3::Y), slope(V3::Z)))
        };
        let bounds = Aabb { min: P3::new(-30.0, -30.0, -30.0), max: P3::new(30.0, 30.0, 30.0) };
        Analytic { f: Box::new(f), bounds }
    }

    /// Area of the section of a mesh's wall by a plane.
    fn section_area(mesh: &TriMesh, at: P3, n: V3) -> f64 {
        let mut area = 0.0;
        for t in (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL) {
            let c = mesh.corners(t);
            let h = c.map(|p| (p - at).dot(n));
            let cross: Vec<V3> = (0..3)
                .filter(|&k| (h[k] < 0.0) != (h[(k + 1) % 3] < 0.0))
                .map(|k| c[k].lerp(c[(k + 1) % 3], h[k] / (h[k] - h[(k + 1) % 3])) - at)
                .collect();
            if let [p, q] = cross[..] {
                let twice = p.cross(q).dot(n);
                // Oriented with the wall's outward normal on the right of the way around.
                let way = (q - p).cross(n).dot(mesh.area_vector(t));
                area += 0.5 * if way > 0.0 { twice } else { -twice };
            }
        }
        area
    }

    #[test]
    fn an_odd_section_is_carried_on_with_its_area_and_the_length_is_exact() {
        let ctx = Ctx::new(2).unwrap();
        let axis = V3::new(0.5, 0.0, 0.866_025_403_784).normalised().unwrap();
        for (taper, sizing) in [(0.0, Sizing::Uniform(0.4)), (0.01, Sizing::Curvature)] {
            let field = odd_tube(axis, taper);
            let cuts = [plane(6.0, V3::Z), plane(-6.0, -V3::Z)];
            let mesh = meshed(&field, P3::new(0.0, 2.0, 0.0), &cuts, sizing, &ctx);
            let ext = extend(&mesh, &field, &all(&mesh, 3.0), &ctx).unwrap();
            assert_eq!(check(&ext.mesh).unwrap().euler, 2);
            assert!(self_intersections(&ext.mesh, &ctx).unwrap().is_empty());
            assert_eq!(ext.ends.len(), 2);
            for e in &ext.ends {
                assert!((e.length_mm / (3.0 * e.diameter_mm) - 1.0).abs() < 1e-3, "{e:?}");
                assert!(e.direction.dot(axis).abs() > 0.9995, "{e:?}");
                assert!(e.area_change <= 0.01, "{e:?}");
                let area = std::f64::consts::PI * e.diameter_mm * e.diameter_mm / 4.0;
                // The cap is the true section, and every section on the way is within a hundredth.
                assert!((e.cap.area_mm2 / area - 1.0).abs() < 5e-3, "{e:?}");
                for s in [1.3, 1.7, 2.2, 3.0, 6.0, 9.0] {
                    let at = e.cap.centroid - e.direction * (e.length_mm - s);
                    let here = section_area(&ext.mesh, at, e.direction);
                    assert!((here / area - 1.0).abs() < 1e-2, "{s} mm: {here} {area}");
                }
                for t in (0..ext.mesh.triangles.len()).filter(|&t| ext.mesh.face_id[t] == e.face_id) {
                    let off = ext.mesh.corners(t).map(|p| (p - e.cap.centroid).dot(e.direction).abs());
                    assert!(off.iter().all(|o| *o <= 1e-9), "{off:?}");
                }
            }
            let q = quality(&ext.mesh, &field, &ctx).unwrap();
            assert!(q.min_angle_deg >= 25.0, "{q:?}");
            // The wall before is untouched.
            for t in 0..ext.first_face {
                let old = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL).nth(t).unwrap();
                assert_eq!(ext.mesh.corners(t), mesh.corners(old));
            }
        }
    }

    #[test]
    fn the_wall_goes_on_in_its_tangent_plane() {
        let ctx = Ctx::new(2).unwrap();
        let field = odd_tube(V3::Z, 0.02);
        let mesh = meshed(
            &field,
            P3::new(0.0, 1.5, 0.0),
            &[plane(6.0, V3::Z), plane(-6.0, -V3::Z)],
            Sizing::Uniform(0.3),
            &ctx,
        );
        let ext = extend(&mesh, &field, &all(&mesh, 2.0), &ctx).unwrap();
        let web = Web::weave(&ext.mesh).unwrap();
        let normal = |t: usize| ext.mesh.area_vector(t).normalised().unwrap();
        // Across the old rim the mesh bends no more than elsewhere around the same section.
        let bend = |h: usize| normal(h / 3).dot(normal(web.twin[h] as usize / 3)).clamp(-1.0, 1.0).acos();
        let wall = (0..web.origin.len()).filter(|&h| web.face_id[h / 3] == WALL && !web.is_feature(h as u32));
        let (mut rim, mut inner) = (0.0_f64, 0.0_f64);
        for h in wall {
            let old = h / 3 < ext.first_face;
            let across = (web.twin[h] as usize / 3 < ext.first_face) != old;
            if across {
                rim = rim.max(bend(h))
            } else if old {
                inner = inner.max(bend(h))
            }
        }
        assert!(rim <= inner, "{} {} degrees", rim.to_degrees(), inner.to_degrees());
    }

    #[test]
    fn extensions_that_meet_the_vessel_are_refused_with_their_place() {
        let ctx = Ctx::new(2).unwrap();
        // A quarter of a torus is cut away: the two ducts cross.
        let field = fields::torus(6.0, 1.5);
        let cuts = [CutPlane::new(P3::new(0.0, 3.0, 0.0), V3::new(-0.6, 0.8, 0.0))];
        let mesh = meshed(&field, P3::new(0.0, -7.5, 0.0), &cuts, Sizing::Uniform(0.4), &ctx);
        let wanted = all(&mesh, 6.0);
        assert_eq!(wanted.len(), 2);
        let e = extend(&mesh, &field, &wanted, &ctx).unwrap_err();
        assert_eq!(e.code(), "surface.extension_meets");
        assert!(e.to_string().contains("diameters") && e.place().position.is_some(), "{e}");
        let short = extend(&mesh, &field, &all(&mesh, 0.05), &ctx).unwrap_err();
        assert_eq!(short.code(), "surface.short_end");
        let none = extend(&mesh, &field, &[Extension { face_id: 9, diameters: 1.0 }], &ctx).unwrap_err();
        assert_eq!(none.code(), "surface.settings");
    }

    #[test]
    fn the_open_variant_is_the_wall_alone() {
        let ctx = Ctx::new(1).unwrap();
        let field = odd_tube(V3::Z, 0.0);
        let mesh = meshed(
            &field,
            P3::new(0.0, 1.5, 0.0),
            &[plane(6.0, V3::Z), plane(-6.0, -V3::Z)],
            Sizing::Uniform(0.6),
            &ctx,
        );
        let o = open(&mesh);
        assert!(o.face_id.iter().all(|&id| id == WALL) && o.triangles.len() < mesh.triangles.len());
        assert!(check(&o).is_err());
    }
}
