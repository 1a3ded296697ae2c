//! What surrounds the vessels: a body in air, a rim of fat, smooth texture, the coil's smooth sensitivity.

use crate::frame::Frame;
use crate::random::Stream;
use crate::{Body, Settings};
use space::{DVec3, V3};
use std::f64::consts::TAU;

/// Half axes of the body's ellipse as fractions of the image's width and height.
const BODY: [f64; 2] = [0.46, 0.42];
/// Thickness of the fat below the skin, mm.
const RIM_MM: f64 = 5.0;
/// Lattice steps of the texture's two octaves in mm, with their weights (squares sum to 1): muscle bundles and finer
/// streaks, both wider than a pixel so that the texture is anatomy and not noise.
const OCTAVES: [(f64, f64); 2] = [(9.0, 0.8), (3.5, 0.6)];
/// Interpolation between lattice values shrinks their variance to .744 per axis (the mean of w^2 + (1 - w)^2 for the
/// cubic step w); this gives it back.
const TEXTURE_GAIN: f64 = 1.559;

/// The body's ellipse; `None` fills the image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outline(Option<[f64; 2]>);

impl Outline {
    /// The outline for vessels whose axes within the stack run through `points` (local coordinates) with these radii.
    pub(crate) fn of(settings: &Settings, points: &[(DVec3, f64)]) -> Self {
        let size = [settings.columns, settings.rows].map(|n| n as f64 * settings.pixel_mm);
        let ellipse = Self(Some([BODY[0] * size[0], BODY[1] * size[1]]));
        match settings.body {
            Body::Auto if points.iter().all(|&(p, r)| ellipse.holds(p, r)) => ellipse,
            Body::Auto | Body::FillsImage => Self(None),
        }
    }
    /// About the distance below the skin, mm.
    fn depth(self, local: DVec3) -> f64 {
        let Some([a, b]) = self.0 else { return f64::INFINITY };
        let q = (local.x / a).hypot(local.y / b);
        let slope = (local.x / (a * a)).hypot(local.y / (b * b)) / q.max(1e-12);
        (1.0 - q) / slope.max(1e-12)
    }
    /// Whether a vessel of this radius at a point lies wholly below the fat.
    pub(crate) fn holds(self, local: DVec3, radius_mm: f64) -> bool {
        self.depth(local) > RIM_MM + radius_mm
    }
}

/// Smooth random values on the lattice of one octave, ready for one slice.
struct Plane {
    step: f64,
    columns: usize,
    values: Vec<f64>,
}

impl Plane {
    fn new(stream: Stream, octave: usize, frame: Frame, w: f64) -> Self {
        let step = OCTAVES[octave].0;
        let count = |half: f64| (2.0 * half / step).floor() as usize + 2;
        let (columns, rows) = (count(frame.half.x), count(frame.half.y));
        let level = (w + frame.half.z) / step;
        let (layer, t) = (level.floor() as u64, smooth_step(level.fract()));
        let node = |i: usize, j: usize, k: u64| {
            let index = (i as u64) | (j as u64) << 20 | k << 40 | (octave as u64) << 60;
            stream.between(index, -3.0_f64.sqrt(), 3.0_f64.sqrt())
        };
        let value = |n: usize| {
            let (i, j) = (n % columns, n / columns);
            node(i, j, layer) * (1.0 - t) + node(i, j, layer + 1) * t
        };
        Self { step, columns, values: (0..columns * rows).map(value).collect() }
    }
    fn at(&self, u: f64, v: f64) -> f64 {
        let (x, y) = (u / self.step, v / self.step);
        let (i, j) = (x.floor() as usize, y.floor() as usize);
        let (s, t) = (smooth_step(x.fract()), smooth_step(y.fract()));
        let n = j * self.columns + i;
        let row = |n: usize| self.values[n] * (1.0 - s) + self.values[n + 1] * s;
        row(n) * (1.0 - t) + row(n + self.columns) * t
    }
}

fn smooth_step(x: f64) -> f64 {
    x * x * (3.0 - 2.0 * x)
}

/// The surroundings in one slice.
pub(crate) struct Tissue<'a> {
    settings: &'a Settings,
    outline: Outline,
    half: DVec3,
    planes: Vec<Plane>,
}

impl<'a> Tissue<'a> {
    /// At height `w` mm from the stack's centre along the normal.
    pub(crate) fn slice(settings: &'a Settings, outline: Outline, frame: Frame, w: f64) -> Self {
        let stream = Stream::new(settings.seed, 0x7e87);
        let planes = (0..OCTAVES.len()).map(|o| Plane::new(stream, o, frame, w)).collect();
        Self { settings, outline, half: frame.half, planes }
    }
    /// The grey level at a point of the slice (local coordinates) where there is no vessel, and the fraction of the
    /// pixel that lies in the body.
    pub(crate) fn level(&self, local: DVec3) -> (f64, f64) {
        let l = &self.settings.levels;
        let depth = self.outline.depth(local);
        let inside = (0.5 + depth / self.settings.pixel_mm).clamp(0.0, 1.0);
        let muscle = smooth_step((depth / RIM_MM - 0.5).clamp(0.0, 1.0));
        let (u, v) = (local.x + self.half.x, local.y + self.half.y);
        let texture: f64 = self.planes.iter().zip(OCTAVES).map(|(p, (_, weight))| weight * p.at(u, v)).sum();
        let factor = (1.0 + self.settings.texture * TEXTURE_GAIN * texture).max(0.0);
        (factor * (l.tissue * muscle + l.fat * (1.0 - muscle)), inside)
    }
}

/// The coil's sensitivity: 1 + bias (.6 sin(k1.x + p1) + .4 sin(k2.x + p2)), waves of 1.7 times the stack's longest
/// edge, so that it changes little over a vessel's width and by up to +-bias over the stack.
pub(crate) struct Sensitivity {
    bias: f64,
    waves: [(DVec3, f64); 2],
}

impl Sensitivity {
    pub(crate) fn new(settings: &Settings, frame: Frame) -> Self {
        let draw = Stream::new(settings.seed, 0xb1a5);
        let k = TAU / (1.7 * 2.0 * frame.half.max_element().max(1.0));
        let wave = |i: u64| {
            let d = |j: u64| draw.normal_pair(2 * i + j);
            let [x, y] = d(0);
            let direction = V3::new(x, y, d(1)[0]).normalised().unwrap_or(V3::X);
            (direction.raw() * k, TAU * draw.uniform(100 + i))
        };
        Self { bias: settings.bias, waves: [wave(0), wave(1)] }
    }
    pub(crate) fn at(&self, local: DVec3) -> f64 {
        let sine = |(k, phase): (DVec3, f64)| (k.dot(local) + phase).sin();
        1.0 + self.bias * (0.6 * sine(self.waves[0]) + 0.4 * sine(self.waves[1]))
    }
}
