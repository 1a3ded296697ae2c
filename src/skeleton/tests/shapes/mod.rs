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
    (CutPlane::new(centroid, normal), CapHint { face_id, centroid, normal })
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

/// A field whose wall is rough: value noise of one lattice cell, standard deviation `sigma_mm` at the lattice points.
pub(crate) struct Rough<'a> {
    pub(crate) smooth: &'a dyn Field,
    pub(crate) sigma_mm: f64,
    pub(crate) cell_mm: f64,
    pub(crate) seed: u64,
}

impl Rough<'_> {
    fn at(&self, i: [i64; 3]) -> f64 {
        let mut h = self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        for c in i {
            h = (h ^ c as u64).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            h ^= h >> 29;
        }
        // the sum of four uniform numbers is near enough to normal
        (0..4).map(|k| (h >> (16 * k) & 0xffff) as f64 / 65536.0 - 0.5).sum::<f64>() * 3.0_f64.sqrt() * self.sigma_mm
    }

    fn noise(&self, x: P3) -> f64 {
        let p = x.to_array().map(|c| c / self.cell_mm);
        let (i, t) = (p.map(|c| c.floor() as i64), p.map(|c| c - c.floor()));
        (0..8)
            .map(|d: usize| {
                let side = |a: usize| (d >> a & 1) as i64;
                let weight: f64 = (0..3).map(|a| if side(a) == 1 { t[a] } else { 1.0 - t[a] }).product();
                weight * self.at([i[0] + side(0), i[1] + side(1), i[2] + side(2)])
            })
            .sum()
    }
}

impl Field for Rough<'_> {
    fn value(&self, x: P3) -> f64 {
        self.smooth.value(x) + self.noise(x)
    }
    fn gradient(&self, x: P3) -> (f64, V3) {
        let (f, g) = self.smooth.gradient(x);
        let h = 1e-4 * self.cell_mm;
        let d = |e: V3| (self.noise(x + e * h) - self.noise(x - e * h)) / (2.0 * h);
        (f + self.noise(x), g + V3::new(d(V3::X), d(V3::Y), d(V3::Z)))
    }
    fn hessian(&self, x: P3) -> (f64, V3, DMat3) {
        let (f, g) = self.gradient(x);
        (f, g, DMat3::ZERO)
    }
    fn bounds(&self) -> Aabb<Patient> {
        self.smooth.bounds()
    }
}

/// Uniform numbers from a seed.
pub(crate) struct Draw(pub(crate) u64);

impl Draw {
    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        low + (high - low) * ((z ^ z >> 31) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// An anastomosis as a stack of slices sees it: two planes across z end the data, so that the graft's cap is oblique.
/// Graft at 20 to 65 degrees, radii .5 to 1.15 of the host's 3 mm, the host bent by up to 20 degrees each way.
pub(crate) fn drawn_anastomosis(seed: u64) -> Star {
    let mut draw = Draw(seed);
    let turn = draw.between(0.0, std::f64::consts::TAU);
    let (host, ratio) = (3.0, draw.between(0.5, 1.15));
    let graft = host * ratio;
    let angle = draw.between(20.0, 65.0).to_radians();
    let bend = [draw.between(-20.0, 20.0), draw.between(-20.0, 20.0)].map(|x: f64| x.to_radians().tan());
    let direction = |x: f64, y: f64, z: f64| {
        V3::new(x * turn.cos() - y * turn.sin(), x * turn.sin() + y * turn.cos(), z).normalised().unwrap()
    };
    let directions =
        [direction(0.0, 0.0, 1.0), direction(bend[0], bend[1], -1.0), direction(angle.sin(), 0.0, angle.cos())];
    // the caps of host and graft lie in one plane, two radii apart
    let apart = graft / angle.cos() + 3.0 * host;
    let half = (apart / angle.tan()).max(4.0 * host);
    let centre = P3::new(draw.between(-1.0, 1.0), draw.between(-1.0, 1.0), draw.between(-1.0, 1.0));
    let radii = [host, host, graft];
    let lengths = directions.map(|d| half / d.z().abs());
    let branches: Vec<(V3, f64, f64)> = (0..3).map(|i| (directions[i], lengths[i], radii[i])).collect();
    let mut star = star(centre, &branches);
    for i in 0..3 {
        let (cut, cap) = opening(i as u32 + 1, centre + directions[i] * lengths[i], V3::Z * directions[i].z().signum());
        (star.cuts[i], star.caps[i]) = (cut, cap);
        // an oblique section reaches farther along the vessel than its axis
        let reach = 2.0 * radii[i] * (1.0 + directions[i].z().abs().acos().tan());
        star.vessel.tubes[i].1 = centre + directions[i] * (lengths[i] + reach);
    }
    star.vessel.bounds = Aabb::around(star.caps.iter().map(|c| c.centroid)).unwrap().grown(4.0 * host);
    star
}
