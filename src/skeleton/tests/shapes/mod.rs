//! Analytic lumens with gradients by hand, and their cut planes and caps.
#![allow(dead_code)]

use imaging::CutPlane;
use implicit::Field;
use skeleton::{CapHint, Edge, MedialGraph};
use space::{Aabb, DMat3, P3, Patient, V3};

/// Tubes joined by a sharp smooth maximum: f = ln(sum exp(k f_i)) / k, f_i = radius - distance to the segment.
pub(crate) struct Vessel {
    pub(crate) tubes: Vec<(P3, P3, f64)>,
    pub(crate) sharpness: f64,
    /// Amplitude and wavelength of the wall's ripple, mm.
    pub(crate) ripple: [f64; 2],
    pub(crate) bounds: Aabb<Patient>,
}

impl Vessel {
    pub(crate) fn new(tubes: &[(P3, P3, f64)]) -> Self {
        let ends = tubes.iter().flat_map(|t| [t.0, t.1]);
        let r = tubes.iter().map(|t| t.2).fold(0.0, f64::max);
        let bounds = Aabb::around(ends).unwrap().grown(1.2 * r);
        Self { tubes: tubes.to_vec(), sharpness: 12.0, ripple: [0.0, 1.0], bounds }
    }
    fn parts(&self, x: P3) -> Vec<(f64, V3)> {
        let part = |&(a, b, r): &(P3, P3, f64)| {
            let d = b - a;
            let t = ((x - a).dot(d) / d.length_squared()).clamp(0.0, 1.0);
            let away = x - (a + d * t);
            (r - away.length(), away.normalised().unwrap_or(V3::ZERO) * -1.0)
        };
        self.tubes.iter().map(part).collect()
    }
}

const WAVES: [[f64; 3]; 4] = [[1.0, 0.31, 0.17], [-0.23, 0.93, 0.41], [0.37, -0.29, 1.03], [0.71, 0.67, -0.53]];

impl Field for Vessel {
    fn value(&self, x: P3) -> f64 {
        self.gradient(x).0
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let parts = self.parts(x);
        let top = parts.iter().map(|p| p.0).fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = parts.iter().map(|p| (self.sharpness * (p.0 - top)).exp()).collect();
        let sum: f64 = weights.iter().sum();
        let mut f = top + sum.ln() / self.sharpness;
        let mut g = parts.iter().zip(&weights).fold(V3::ZERO, |g, (p, w)| g + p.1 * (w / sum));
        let [amplitude, wavelength] = self.ripple;
        if amplitude > 0.0 {
            for (i, w) in WAVES.iter().enumerate() {
                let k = V3::from(*w) * (std::f64::consts::TAU / wavelength);
                let phase = k.dot(x - P3::ORIGIN) + i as f64;
                f += 0.5 * amplitude * phase.sin();
                g += k * (0.5 * amplitude * phase.cos());
            }
        }
        (f, g)
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let h = 1e-4;
        let column = |e: V3| ((self.gradient(x + e * h).1 - self.gradient(x - e * h).1) / (2.0 * h)).raw();
        let (f, g) = self.gradient(x);
        (f, g, DMat3::from_cols(column(V3::X), column(V3::Y), column(V3::Z)))
    }
    fn bounds(&self) -> Aabb<Patient> {
        self.bounds
    }
}

/// A solid torus about z.
pub(crate) struct Torus {
    pub(crate) centre: P3,
    pub(crate) big: f64,
    pub(crate) small: f64,
}

impl Field for Torus {
    fn value(&self, x: P3) -> f64 {
        self.gradient(x).0
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let d = x - self.centre;
        let flat = V3::new(d.x(), d.y(), 0.0);
        let away = d - flat.normalised().unwrap_or(V3::X) * self.big;
        (self.small - away.length(), away.normalised().unwrap_or(V3::ZERO) * -1.0)
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        (f, g, DMat3::ZERO)
    }
    fn bounds(&self) -> Aabb<Patient> {
        Aabb { min: self.centre, max: self.centre }.grown(self.big + 1.5 * self.small)
    }
}

/// A cut plane and a cap at `centroid`, `outward` need not be of unit length.
pub(crate) fn opening(face_id: u32, centroid: P3, outward: V3) -> (CutPlane, CapHint) {
    let normal = outward.normalised().unwrap();
    (CutPlane { point: centroid, outward: normal }, CapHint { face_id, centroid, normal })
}

/// Straight branches from `centre`: (direction, length, radius). Each is cut at a right angle at its length (the tube
/// goes on behind it).
pub(crate) struct Star {
    pub(crate) vessel: Vessel,
    pub(crate) cuts: Vec<CutPlane>,
    pub(crate) caps: Vec<CapHint>,
    pub(crate) seeds: Vec<P3>,
    pub(crate) centre: P3,
    pub(crate) directions: Vec<V3>,
}

pub(crate) fn star(centre: P3, branches: &[(V3, f64, f64)]) -> Star {
    let directions: Vec<V3> = branches.iter().map(|b| b.0.normalised().unwrap()).collect();
    let tubes: Vec<_> =
        branches.iter().zip(&directions).map(|(b, d)| (centre, centre + *d * (b.1 + 2.0 * b.2), b.2)).collect();
    let mut vessel = Vessel::new(&tubes);
    vessel.sharpness = 40.0 / branches.iter().map(|b| b.2).fold(f64::INFINITY, f64::min);
    let ends = || branches.iter().zip(&directions).enumerate();
    let (cuts, caps) = ends().map(|(i, (b, d))| opening(i as u32 + 1, centre + *d * b.1, *d)).unzip();
    let seeds = ends()
        .flat_map(|(_, (b, d))| {
            let out = d.any_orthonormal();
            [0.3, 0.5, 0.7].map(|t| centre + *d * (t * b.1) + out * b.2)
        })
        .collect();
    Star { vessel, cuts, caps, seeds, centre, directions }
}

/// The edge that ends at a cap, from the cap inwards.
pub(crate) fn from_cap(graph: &MedialGraph, face_id: u32) -> Edge {
    let node = graph.nodes.iter().position(|n| n.cap == Some(face_id)).unwrap();
    let mut edge = graph.edges.iter().find(|e| e.nodes.contains(&node)).unwrap().clone();
    if edge.nodes[0] != node {
        edge.nodes.reverse();
        edge.points.reverse();
        edge.radius_mm.reverse();
    }
    edge
}

/// Distance of a point from a line.
pub(crate) fn off_axis(x: P3, through: P3, direction: V3) -> f64 {
    let d = direction.normalised().unwrap();
    (x - through).cross(d).length()
}

/// (ends, junctions, cycles, components)
pub(crate) fn counts(graph: &MedialGraph) -> (usize, usize, usize, usize) {
    let ends = graph.nodes.iter().filter(|n| n.kind == skeleton::NodeKind::End).count();
    (ends, graph.nodes.len() - ends, graph.cycles(), graph.components())
}
