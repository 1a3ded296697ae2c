//! A small synthetic reconstruction for the tests: a smooth union of three capsules in the shape of an end-to-side
//! anastomosis, polygonised by marching tetrahedra, with a medial graph and measures that fit it.

use crate::Reconstruction;
use crate::reconstruction::{
    Candidate, CapFacts, ImplicitFacts, InputFacts, Patches, Quadrilaterals, QualityFacts, Range, SegmentationFacts,
    SlicePicture, SurfaceData, SurfaceFacts,
};
use imaging::{Axis, Contours};
use morphometry::{
    Angle, Branch, ByDistance, CurveKind, Helix, Junction, Morphometry, Role, Section, SectionOutline, Stenosis,
    VmtkAngles,
};
use skeleton::{Edge, MedialGraph, Node, NodeKind};
use space::{P3, Place, V3, Warning};
use std::collections::BTreeMap;
use surface::TriMesh;

/// Owns what a [`Reconstruction`] borrows.
pub(crate) struct Fixture {
    pub mesh: TriMesh,
    pub area_and_volume: [f64; 2],
    pub graph: MedialGraph,
    pub morphometry: Morphometry,
    pub contours: Contours,
    pub warnings: Vec<Warning>,
    pub displacement: Vec<f64>,
    pub patch_id: Vec<u32>,
    pub uv: Vec<f64>,
}

const CENTRE: P3 = P3::new(120.0, -80.0, 40.0);
/// Axis end and radius of graft, proximal and distal vessel.
const ARMS: [([f64; 3], f64, Role); 3] = [
    ([17.0, 3.0, 17.0], 2.4, Role::Graft),
    ([0.0, 0.0, 24.0], 3.0, Role::Proximal),
    ([3.0, 6.0, -23.0], 2.8, Role::Distal),
];

fn distance(p: P3) -> f64 {
    let capsule = |(end, radius, _): ([f64; 3], f64, Role)| {
        let (d, end) = (p - CENTRE, V3::from(end));
        let t = (d.dot(end) / end.length_squared()).clamp(0.0, 1.0);
        (d - end * t).length() - radius
    };
    let k = 1.5;
    -ARMS.map(capsule).iter().map(|d| (-d * k).exp()).sum::<f64>().ln() / k
}

/// Marching tetrahedra; vertices are shared, so that the surface is closed.
fn polygonised(step: f64) -> TriMesh {
    let n = [32.0, 24.0, 62.0].map(|x| (x / step) as i32);
    let origin = CENTRE + V3::new(-7.0, -9.0, -31.0);
    let at = |g: [i32; 3]| origin + V3::new(f64::from(g[0]), f64::from(g[1]), f64::from(g[2])) * step;
    let mut mesh = TriMesh::default();
    let mut on_edge: BTreeMap<([i32; 3], [i32; 3]), u32> = BTreeMap::new();
    let corners: Vec<[i32; 3]> = (0..8).map(|c| [c & 1, c >> 1 & 1, c >> 2 & 1]).collect();
    let tetrahedra = [[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]];
    for cell in 0..n[0] * n[1] * n[2] {
        let base = [cell % n[0], cell / n[0] % n[1], cell / (n[0] * n[1])];
        for t in tetrahedra {
            let g = t.map(|c: usize| [0, 1, 2].map(|k| base[k] + corners[c][k]));
            let f = g.map(|q| distance(at(q)));
            let (inside, outside): (Vec<usize>, Vec<usize>) = (0..4).partition(|&i| f[i] < 0.0);
            let mut vertex = |i: usize, j: usize| {
                let key = if g[i] < g[j] { (g[i], g[j]) } else { (g[j], g[i]) };
                *on_edge.entry(key).or_insert_with(|| {
                    mesh.vertices.push(at(g[i]).lerp(at(g[j]), f[i] / (f[i] - f[j])));
                    (mesh.vertices.len() - 1) as u32
                })
            };
            let polygon: Vec<u32> = match (inside.as_slice(), outside.as_slice()) {
                ([a], [b, c, d]) | ([b, c, d], [a]) => vec![vertex(*a, *b), vertex(*a, *c), vertex(*a, *d)],
                ([a, b], [c, d]) => vec![vertex(*a, *c), vertex(*a, *d), vertex(*b, *d), vertex(*b, *c)],
                _ => continue,
            };
            let middle = P3::centroid(&inside.iter().map(|&i| at(g[i])).collect::<Vec<_>>()).unwrap();
            for k in 1..polygon.len() - 1 {
                let mut triangle = [polygon[0], polygon[k], polygon[k + 1]];
                let p = triangle.map(|v| mesh.vertices[v as usize]);
                if (p[1] - p[0]).cross(p[2] - p[0]).dot(p[0] - middle) < 0.0 {
                    triangle.swap(1, 2);
                }
                mesh.triangles.push(triangle);
            }
        }
    }
    mesh.face_id = (0..mesh.triangles.len()).map(|t| face(P3::centroid(&mesh.corners(t)).unwrap())).collect();
    mesh
}

/// The rounded ends stand for the caps.
fn face(p: P3) -> u32 {
    let beyond = |(end, _, _): &([f64; 3], f64, Role)| {
        let end = V3::from(*end);
        (p - CENTRE).dot(end) > end.length_squared()
    };
    ARMS.iter().position(beyond).map_or(0, |k| k as u32 + 1)
}

fn branch(id: usize) -> (Edge, Branch) {
    let (end, radius, role) = ARMS[id];
    let end = V3::from(end);
    let n = 41;
    let at = |i: usize| CENTRE + end * (i as f64 / (n - 1) as f64);
    let points: Vec<P3> = (0..n).map(at).collect();
    let r = |i: usize| radius + if i < 8 { 0.1 * (8 - i) as f64 } else { 0.05 * (i as f64 * 0.4).sin() };
    let section = |i: usize| Section {
        abscissa_mm: end.length() * i as f64 / (n - 1) as f64,
        position: at(i),
        tangent: end.normalised().unwrap(),
        radius_inscribed_mm: r(i),
        area_mm2: (i >= 4).then(|| std::f64::consts::PI * (r(i) + 0.06).powi(2)),
        perimeter_mm: (i >= 4).then(|| std::f64::consts::TAU * (r(i) + 0.07)),
        curvature_per_mm: Some(0.01),
        shape: (i >= 4).then_some(0.98),
        area_error_mm2: (i >= 4).then_some(0.2),
        curvature_error_per_mm: Some(0.002),
        outline: (i >= 4).then(|| SectionOutline {
            centre: at(i),
            first: end.normalised().unwrap().any_orthonormal(),
            radii_mm: vec![r(i) + 0.06; 16],
        }),
        in_junction: i < 10,
        open: i + 1 == n,
    };
    let helix = Helix {
        radius_mm: 2.0,
        pitch_mm: 60.0,
        curvature_per_mm: 0.02,
        torsion_per_mm: 0.09,
        rms_mm: 0.02,
        enough: CurveKind::Helix,
        curvature_band95: Some([0.018, 0.022]),
        torsion_band95: Some([0.08, 0.1]),
    };
    let b = Branch {
        id,
        role,
        from_node: 0,
        to_node: id + 1,
        length_mm: end.length(),
        tortuosity: 1.0,
        direction: end.normalised(),
        diameter_mm: Some(2.0 * radius),
        diameter_band95_mm: Some([1.96 * radius, 2.04 * radius]),
        stenosis: Some(Stenosis { area_ratio: 0.97, abscissa_mm: 0.6 * end.length() }),
        sections: (0..n).map(section).collect(),
        helix: (role == Role::Distal).then_some(helix),
    };
    // The distal edge is stored end first, to try the writers' orientation.
    let mut edge = Edge { nodes: [0, id + 1], radius_mm: (0..n).map(r).collect(), points };
    if role == Role::Distal {
        edge.nodes.reverse();
        edge.points.reverse();
        edge.radius_mm.reverse();
    }
    (edge, b)
}

fn angles() -> Vec<Angle> {
    let names = ["graft_proximal", "graft_distal_planar", "distal_normal", "proximal_distal", "graft_distal"];
    let values = [45.4, 121.25, 74.9, 163.0, 128.7];
    let angle = |(k, (name, value)): (usize, (&&str, f64))| {
        let size = 2.0 - k as f64;
        let diameters: Vec<f64> = (0..25).map(|i| 1.6 + 0.1 * f64::from(i)).collect();
        let value_deg =
            diameters.iter().map(|d| (*d > 1.75).then(|| value + size * (-(d - 1.6) * 1.5).exp())).collect();
        Angle {
            name: (*name).to_owned(),
            value_deg: Some(value),
            band95_deg: Some([value - 0.6, value + 0.6]),
            window_diameters: Some([1.6, 4.0]),
            by_distance: Some(ByDistance { residual_mm: vec![Some(0.02); diameters.len()], diameters, value_deg }),
        }
    };
    let mut all: Vec<Angle> = names.iter().zip(values).enumerate().map(angle).collect();
    all[4] = Angle {
        name: "graft_distal".to_owned(),
        value_deg: None,
        band95_deg: None,
        window_diameters: None,
        by_distance: None,
    };
    all
}

pub(crate) fn slice_picture(k: usize) -> SlicePicture {
    let (columns, rows) = (128, 128);
    let (cx, cy) = (50.0 + 6.0 * k as f64, 64.0);
    let value = |i: usize| {
        let (x, y) = ((i % columns) as f64, (i / columns) as f64);
        let d = (x - cx).hypot(y - cy);
        (40.0 + 160.0 / (1.0 + (d - 9.0).exp()) + ((i * 7919) % 23) as f64) as u8
    };
    let circle = |i: usize| {
        let a = std::f64::consts::TAU * i as f64 / 90.0;
        [cx + 9.0 * a.cos(), cy + 9.0 * a.sin()]
    };
    SlicePicture {
        title: format!("slice {}, z = {:.1} mm", 7 + 7 * k, 20.0 + 14.0 * k as f64),
        columns,
        rows,
        pixel_aspect: 1.0,
        pixels: (0..columns * rows).map(value).collect(),
        polylines: vec![(0..90).map(circle).collect()],
    }
}

impl Fixture {
    pub(crate) fn new() -> Self {
        let mesh = polygonised(0.8);
        let (edges, branches): (Vec<Edge>, Vec<Branch>) = (0..3).map(branch).unzip();
        let node = |kind, position, radius_mm, cap| Node { kind, position, radius_mm, cap };
        let mut nodes = vec![node(NodeKind::Junction, CENTRE, 3.8, None)];
        let end = |k: usize| CENTRE + V3::from(ARMS[k].0);
        nodes.extend((0..3).map(|k| node(NodeKind::End, end(k), ARMS[k].1, Some(k as u32 + 1))));
        let junction = Junction {
            node: 0,
            medial_point: CENTRE,
            axes_point: Some(CENTRE + V3::new(0.1, 0.0, -0.1)),
            plane_normal: V3::Z.cross(V3::from(ARMS[0].0)).normalised(),
            crotch_mm: Some(7.2),
            branches: vec![0, 1, 2],
            angles: angles(),
            vmtk: Some(VmtkAngles {
                inlet: 0,
                in_plane_deg: vec![135.0, 0.0, 17.0],
                out_of_plane_deg: vec![1.0, 0.0, 15.0],
            }),
        };
        let warn = |code, text: &str, place| Warning::new(code, text, place);
        Self {
            displacement: mesh.vertices.iter().map(|p| 0.1 * (p.z() * 0.7).sin()).collect(),
            patch_id: mesh.triangles.iter().map(|t| t[0] % 12).collect(),
            uv: mesh.vertices.iter().map(|p| p.x() / 100.0).collect(),
            area_and_volume: [mesh.area(), mesh.volume()],
            mesh,
            graph: MedialGraph { nodes, edges },
            morphometry: Morphometry {
                branches,
                junctions: vec![junction],
                warnings: vec![warn(
                    "angle.missing",
                    "graft_distal could not be measured: the distal branch leaves the scan",
                    Place::element(0),
                )],
            },
            contours: Contours {
                axis: Axis::Slice,
                planes: vec![],
                curves: vec![],
                cuts: vec![],
                tips: vec![],
                pixel_mm: 0.5,
                thickness_mm: Some(1.5),
                blur: None,
            },
            warnings: vec![warn(
                "stack.gap",
                "slice 7 is missing; the wall is interpolated over 3.0 mm & <more>",
                Place::slice(7),
            )],
        }
    }

    pub(crate) fn reconstruction(&self) -> Reconstruction<'_> {
        let cap = |k: usize| CapFacts {
            face_id: k as u32 + 1,
            name: format!("end_{}", ARMS[k].2.name()),
            boundary: ["inlet_1", "inlet_2", "outlet_1"][k].to_owned(),
            centroid: CENTRE + V3::from(ARMS[k].0),
            normal: V3::from(ARMS[k].0).normalised().unwrap(),
            area_mm2: 20.0,
            oblique_deg: Some(0.5),
            set_back_mm: Some(0.0),
        };
        let range = |s: f64| Range { min: -0.1 * s, max: 0.1 * s, rms: 0.07 * s };
        Reconstruction {
            input: InputFacts {
                slices: 29,
                missing_slices: vec![7],
                spacing_mm: [0.5, 0.5, 1.5],
                digest: format!("sha256:{}", "0123456789abcdef".repeat(4)),
            },
            segmentation: SegmentationFacts {
                threshold: Some(118.0),
                psf_sigma_px: None,
                contours: 58,
                lumens: vec![[0, 2], [1, 1]],
                axis: "slice".to_owned(),
                candidates: vec![Candidate { score: 0.9, chosen: true }, Candidate { score: 0.1, chosen: false }],
            },
            contours: &self.contours,
            implicit: ImplicitFacts {
                constraints: 4012,
                smoothing: 3.1e-4,
                residual_max_mm: 0.04,
                residual_rms_mm: 0.02,
                condition: Some(1.0e9),
                offset_mm: [0.6, 1.0],
            },
            surface: SurfaceData {
                mesh: &self.mesh,
                quality: SurfaceFacts {
                    min_angle_deg: 31.0,
                    max_angle_deg: 110.0,
                    watertight: true,
                    euler: 2,
                    components: 1,
                    max_error_mm: 0.018,
                    area_mm2: self.area_and_volume[0],
                    volume_mm3: self.area_and_volume[1],
                    displacement_px: range(2.0),
                    displacement_mm: range(1.0),
                    report: QualityFacts { hausdorff_mm: 0.2, volume_change: -0.004, ..QualityFacts::default() },
                    caps: (0..3).map(cap).collect(),
                },
                displacement_mm: &self.displacement,
                displacement_px: &self.displacement,
                patches: Some(Patches { patch_id: &self.patch_id, u: &self.uv, v: &self.uv }),
                quads: Quadrilaterals::Unasked,
            },
            graph: &self.graph,
            morphometry: &self.morphometry,
            warnings: &self.warnings,
            pictures: (0..3).map(slice_picture).collect(),
            variant: None,
            atlas: None,
        }
    }
}
