//! surface.vtp, skeleton.vtp and contours.vtp: which arrays go with which geometry.
//!
//! skeleton.vtp follows vmtkbranchextractor: one polyline per tract, a tract being the stretch of a branch inside
//! (`Blanking` 1) or outside (`Blanking` 0) the junction. Point arrays: `MaximumInscribedSphereRadius`, `Abscissas`
//! (arc length from the branch's first node), `Curvature`, `Torsion` (of the helix fitted to the branch; only where a
//! branch has one), and our own `Area_mm2`, `AreaRadius_mm`, `Perimeter_mm`, interpolated between the cross-sections;
//! NaN where the section is open or was not measured. Cell arrays: `CenterlineIds` (branch number), `TractIds` (0, 1,
//! .. along the branch), `GroupIds` (branch number outside; number of branches + node inside, so that all tracts of a
//! junction are one group, as VMTK has it), `Blanking`, and `Role` (0 graft, 1 proximal, 2 distal, 3 host_a, 4 host_b,
//! 5 other).

use super::error::same_length;
use super::vtp::{Array, PolyData};
use super::{CONTOURS_VTP, Error, NamedBytes, SKELETON_VTP, SURFACE_VTP};
use crate::Reconstruction;
use crate::reconstruction::CapFacts;
use imaging::Contours;
use morphometry::{Branch, Role, Section};
use skeleton::Edge;
use space::{P3, V3};
use surface::{TriMesh, WALL};

/// Points per pixel of arc length on a contour polyline: the chord of a circle of 3 pixels radius then leaves the
/// curve by 0.003 pixels.
const CONTOUR_POINTS_PER_PIXEL: f64 = 4.0;
/// Fewest and most points of a contour polyline.
const CONTOUR_POINTS: [usize; 2] = [48, 8192];

/// Unit normals of the vertices, out of the lumen: the angle-weighted mean of the wall triangles there (of all
/// triangles where a vertex touches no wall). A vertex without area gets +z.
pub(crate) fn vertex_normals(mesh: &TriMesh) -> Vec<V3> {
    let mut wall = vec![V3::ZERO; mesh.vertices.len()];
    let mut all = wall.clone();
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let p = mesh.corners(t);
        let Some(normal) = mesh.area_vector(t).normalised() else { continue };
        for k in 0..3 {
            let angle = (p[(k + 1) % 3] - p[k]).angle_to(p[(k + 2) % 3] - p[k]);
            let v = corners[k] as usize;
            all[v] += normal * angle;
            if mesh.face_id.get(t) == Some(&WALL) {
                wall[v] += normal * angle;
            }
        }
    }
    wall.iter().zip(&all).map(|(w, a)| w.normalised().or(a.normalised()).unwrap_or(V3::Z)).collect()
}

/// A mesh whose indices and face ids fit together.
///
/// # Errors
/// [`Error::Mismatch`].
pub(crate) fn checked_mesh(artefact: &'static str, mesh: &TriMesh) -> Result<(), Error> {
    same_length(artefact, "face ids", mesh.triangles.len(), mesh.face_id.len())?;
    let n = mesh.vertices.len();
    match mesh.triangles.iter().flatten().find(|&&v| v as usize >= n) {
        Some(&v) => Err(Error::Mismatch { artefact, what: "vertex index", expected: n, found: v as usize }),
        None => Ok(()),
    }
}

/// surface.vtp: the triangles with point arrays `Normals`, `Displacement_mm`, `Displacement_px` (0 when nothing was
/// smoothed), `U` and `V`, and cell arrays `FaceId` (0 wall, k >= 1 the k-th cap) and `PatchId` (both patch arrays only
/// when patches were made). The field array `FaceNames` names each face id: `wall`, `inlet`, `outlet_1` and so on.
///
/// # Errors
/// [`Error::Mismatch`], [`Error::NotFinite`].
pub fn surface_vtp(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let s = &r.surface;
    checked_mesh(SURFACE_VTP, s.mesh)?;
    let displacement = |d: &[f64]| if d.is_empty() { vec![0.0; s.mesh.vertices.len()] } else { d.to_vec() };
    let mut point_arrays = vec![
        Array::triple("Normals", vertex_normals(s.mesh).into_iter().map(V3::to_array)),
        Array::real("Displacement_mm", displacement(s.displacement_mm)),
        Array::real("Displacement_px", displacement(s.displacement_px)),
    ];
    let mut cell_arrays = vec![Array::id("FaceId", s.mesh.face_id.iter().map(|&f| f as usize))];
    if let Some(p) = s.patches {
        point_arrays.push(Array::real("U", p.u.to_vec()));
        point_arrays.push(Array::real("V", p.v.to_vec()));
        cell_arrays.push(Array::id("PatchId", p.patch_id.iter().map(|&f| f as usize)));
    }
    let data = PolyData {
        points: s.mesh.vertices.clone(),
        polygons: s.mesh.triangles.clone(),
        words: vec![("FaceNames", face_names(&s.quality.caps))],
        point_arrays,
        cell_arrays,
        ..PolyData::default()
    };
    data.write(SURFACE_VTP)
}

/// The boundary's name of every face id.
fn face_names(caps: &[CapFacts]) -> Vec<String> {
    let most = caps.iter().map(|c| c.face_id as usize).max().unwrap_or(0);
    let mut names = vec![String::new(); most + 1];
    names[WALL as usize] = "wall".to_owned();
    caps.iter().for_each(|c| names[c.face_id as usize].clone_from(&c.boundary));
    names
}

/// A surface without measures (opened, or with flow extensions): `Normals`, and `FaceId` as in surface.vtp.
///
/// # Errors
/// [`Error::Mismatch`], [`Error::NotFinite`].
pub fn mesh_vtp(name: &'static str, mesh: &TriMesh) -> Result<NamedBytes, Error> {
    checked_mesh(name, mesh)?;
    let data = PolyData {
        points: mesh.vertices.clone(),
        polygons: mesh.triangles.clone(),
        point_arrays: vec![Array::triple("Normals", vertex_normals(mesh).into_iter().map(V3::to_array))],
        cell_arrays: vec![Array::id("FaceId", mesh.face_id.iter().map(|&f| f as usize))],
        ..PolyData::default()
    };
    Ok(NamedBytes { name: name.into(), bytes: data.write(name)? })
}

/// Abscissas of the points of a polyline, mm.
pub(crate) fn abscissas(points: &[P3]) -> Vec<f64> {
    let mut s = 0.0;
    let mut out = Vec::with_capacity(points.len());
    for (i, p) in points.iter().enumerate() {
        s += if i == 0 { 0.0 } else { p.distance(points[i - 1]) };
        out.push(s);
    }
    out
}

/// A graph edge travelled from the branch's first node, with everything known along it.
struct Line {
    points: Vec<P3>,
    abscissa: Vec<f64>,
    radius: Vec<f64>,
    inside: Vec<bool>,
    curvature: Vec<f64>,
    area: Vec<f64>,
    perimeter: Vec<f64>,
    torsion: f64,
}

impl Line {
    fn new(edge: &Edge, branch: Option<&Branch>) -> Self {
        let (mut points, mut radius) = (edge.points.clone(), edge.radius_mm.clone());
        if branch.is_some_and(|b| b.from_node != edge.nodes[0]) {
            points.reverse();
            radius.reverse();
        }
        let abscissa = abscissas(&points);
        let sections = branch.map_or(&[][..], |b| &b.sections);
        let along = |value: &dyn Fn(&Section) -> Option<f64>| -> Vec<f64> {
            abscissa.iter().map(|&s| interpolated(sections, s, value).unwrap_or(f64::NAN)).collect()
        };
        Self {
            curvature: along(&|x| x.curvature_per_mm),
            area: along(&|x| x.area_mm2),
            perimeter: along(&|x| x.perimeter_mm),
            inside: abscissa.iter().map(|&s| nearest(sections, s).is_some_and(|x| x.in_junction)).collect(),
            torsion: branch.and_then(|b| b.helix).map_or(f64::NAN, |h| h.torsion_per_mm),
            points,
            abscissa,
            radius,
        }
    }
    /// Index ranges (both ends included) of equal blanking, with that blanking. Neighbours share a point.
    fn tracts(&self) -> Vec<(usize, usize, bool)> {
        let mut tracts = Vec::new();
        let mut start = 0;
        for i in 1..self.points.len() {
            let last = i + 1 == self.points.len();
            if last || self.inside[i] != self.inside[i - 1] {
                tracts.push((start, i, self.inside[i - 1]));
                start = i;
            }
        }
        tracts
    }
}

fn nearest(sections: &[Section], s: f64) -> Option<&Section> {
    sections.iter().min_by(|a, b| (a.abscissa_mm - s).abs().total_cmp(&(b.abscissa_mm - s).abs()))
}

/// A measure at abscissa `s`, linear between the two sections around it; `None` outside the measured sections and next
/// to one that could not be measured.
fn interpolated(sections: &[Section], s: f64, value: &dyn Fn(&Section) -> Option<f64>) -> Option<f64> {
    let after = sections.partition_point(|x| x.abscissa_mm < s);
    let b = sections.get(after)?;
    if b.abscissa_mm == s {
        return value(b);
    }
    let a = sections.get(after.checked_sub(1)?)?;
    let t = (s - a.abscissa_mm) / (b.abscissa_mm - a.abscissa_mm);
    Some(value(a)? * (1.0 - t) + value(b)? * t)
}

fn role_number(role: Option<Role>) -> usize {
    match role {
        Some(Role::Graft) => 0,
        Some(Role::Proximal) => 1,
        Some(Role::Distal) => 2,
        Some(Role::HostA) => 3,
        Some(Role::HostB) => 4,
        Some(Role::Other) | None => 5,
    }
}

/// skeleton.vtp: see the module's head.
///
/// # Errors
/// [`Error::Mismatch`], [`Error::NotFinite`].
pub fn skeleton_vtp(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let mut data = PolyData::default();
    let (mut radius, mut abscissa, mut curvature, mut torsion) = (vec![], vec![], vec![], vec![]);
    let (mut area, mut perimeter) = (vec![], vec![]);
    let (mut group, mut centreline, mut tract_id, mut blanking, mut role) = (vec![], vec![], vec![], vec![], vec![]);
    for (id, edge) in r.graph.edges.iter().enumerate() {
        same_length(SKELETON_VTP, "radii of an edge", edge.points.len(), edge.radius_mm.len())?;
        let branch = r.morphometry.branches.iter().find(|b| b.id == id);
        let line = Line::new(edge, branch);
        let from = branch.map_or(edge.nodes[0], |b| b.from_node);
        let to = if from == edge.nodes[0] { edge.nodes[1] } else { edge.nodes[0] };
        for (number, (a, b, inside)) in line.tracts().into_iter().enumerate() {
            let first = data.points.len();
            data.points.extend_from_slice(&line.points[a..=b]);
            data.lines.push((first..data.points.len()).collect());
            radius.extend_from_slice(&line.radius[a..=b]);
            abscissa.extend_from_slice(&line.abscissa[a..=b]);
            curvature.extend_from_slice(&line.curvature[a..=b]);
            area.extend_from_slice(&line.area[a..=b]);
            perimeter.extend_from_slice(&line.perimeter[a..=b]);
            torsion.extend((a..=b).map(|_| if inside { f64::NAN } else { line.torsion }));
            let junction = if a == 0 { from } else { to };
            group.push(if inside { r.graph.edges.len() + junction } else { id });
            centreline.push(id);
            tract_id.push(number);
            blanking.push(usize::from(inside));
            role.push(role_number(branch.map(|b| b.role)));
        }
    }
    data.point_arrays = vec![
        Array::real("MaximumInscribedSphereRadius", radius),
        Array::real("Abscissas", abscissa),
        Array::real_or_nan("Curvature", curvature),
        Array::real_or_nan("AreaRadius_mm", area.iter().map(|a| (a / std::f64::consts::PI).sqrt()).collect()),
        Array::real_or_nan("Area_mm2", area),
        Array::real_or_nan("Perimeter_mm", perimeter),
    ];
    if torsion.iter().any(|t| !t.is_nan()) {
        data.point_arrays.push(Array::real_or_nan("Torsion", torsion));
    }
    data.cell_arrays = vec![
        Array::id("GroupIds", group),
        Array::id("CenterlineIds", centreline),
        Array::id("TractIds", tract_id),
        Array::id("Blanking", blanking),
        Array::id("Role", role),
    ];
    data.write(SKELETON_VTP)
}

/// A contour as a closed polyline.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ContourLine {
    pub plane: usize,
    pub lumen: usize,
    pub hole: bool,
    pub level: f64,
    pub standard_error_mm: f64,
    pub points: Vec<P3>,
    pub on_border: Vec<bool>,
}

/// All contours sampled densely at equal arc length.
///
/// # Errors
/// [`Error::Mismatch`] for a curve of a plane that does not exist.
pub(crate) fn contour_lines(c: &Contours) -> Result<Vec<ContourLine>, Error> {
    let step = c.pixel_mm / CONTOUR_POINTS_PER_PIXEL;
    let line = |curve: &imaging::Curve| {
        let plane = c.planes.get(curve.plane).ok_or(Error::Mismatch {
            artefact: CONTOURS_VTP,
            what: "plane of a contour",
            expected: c.planes.len(),
            found: curve.plane,
        })?;
        let length = curve.length_mm();
        // A float to integer cast saturates, so that a step of 0 gives the most points.
        let n = ((length / step).ceil() as usize).clamp(CONTOUR_POINTS[0], CONTOUR_POINTS[1]);
        let samples: Vec<_> = (0..n).map(|i| curve.at(plane, length * i as f64 / n as f64)).collect();
        Ok(ContourLine {
            plane: plane.index,
            lumen: curve.lumen,
            hole: curve.hole,
            level: curve.level,
            standard_error_mm: curve.standard_error_mm,
            points: samples.iter().map(|p| p.position).collect(),
            on_border: samples.iter().map(|p| p.on_border).collect(),
        })
    };
    c.curves.iter().map(line).collect()
}

/// contours.vtp: closed polylines (the first point is named again at the end of each cell) with cell arrays `Plane`
/// (slice, row or column number), `Lumen`, `Hole` (1 where tissue lies inside), `Level` (grey), `StandardError_mm`, and
/// the point array `OnBorder` (1 where the line follows the image border and not the wall).
///
/// # Errors
/// [`Error::NotFinite`].
pub(crate) fn contours_vtp(lines: &[ContourLine]) -> Result<Vec<u8>, Error> {
    let mut data = PolyData::default();
    let mut on_border = Vec::new();
    for line in lines {
        let first = data.points.len();
        data.points.extend_from_slice(&line.points);
        data.lines.push((first..data.points.len()).chain([first]).collect());
        on_border.extend(line.on_border.iter().map(|&b| usize::from(b)));
    }
    data.point_arrays = vec![Array::id("OnBorder", on_border)];
    data.cell_arrays = vec![
        Array::id("Plane", lines.iter().map(|l| l.plane)),
        Array::id("Lumen", lines.iter().map(|l| l.lumen)),
        Array::id("Hole", lines.iter().map(|l| usize::from(l.hole))),
        Array::real("Level", lines.iter().map(|l| l.level).collect()),
        Array::real("StandardError_mm", lines.iter().map(|l| l.standard_error_mm).collect()),
    ];
    data.write(CONTOURS_VTP)
}
