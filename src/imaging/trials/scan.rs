//! A small simulator: capsules as distance functions, blurred within the slices, with bias, fading and Rician noise.

use crate::Stack;
use space::{P3, V3};

/// xorshift64*, seeded; enough for tests.
pub(super) struct Noise(u64);

impl Noise {
    pub(super) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0x1234_5678_9ABC_DEF1)
    }
    pub(super) fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11) as f64 / (1u64 << 53) as f64
    }
    pub(super) fn gauss(&mut self) -> f64 {
        let (u, v) = (self.uniform().max(1e-300), self.uniform());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }
}

/// A straight vessel piece: from, to, radius (mm, scan coordinates).
pub(super) type Capsule = ([f64; 3], [f64; 3], f64);

pub(super) fn distance(c: &Capsule, p: [f64; 3]) -> f64 {
    let (a, b, r) = c;
    let sub = |x: [f64; 3], y: [f64; 3]| [x[0] - y[0], x[1] - y[1], x[2] - y[2]];
    let dot = |x: [f64; 3], y: [f64; 3]| x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
    let (ab, ap) = (sub(*b, *a), sub(p, *a));
    let t = (dot(ab, ap) / dot(ab, ab)).clamp(0.0, 1.0);
    let q = sub(ap, [ab[0] * t, ab[1] * t, ab[2] * t]);
    dot(q, q).sqrt() - r
}

/// What a scan looks like.
#[derive(Clone)]
pub(super) struct Scan {
    pub(super) n: [usize; 3],
    pub(super) step: [f64; 3],
    pub(super) vessels: Vec<Capsule>,
    pub(super) vessel: f64,
    pub(super) tissue: f64,
    /// Radius of the body about the middle in plane, mm; air outside.
    pub(super) body: f64,
    pub(super) noise: f64,
    /// Multiplicative bias amplitude.
    pub(super) bias: f64,
    /// Brightness of the vessels along z (1 = none): factor at the far end.
    pub(super) fade: f64,
    pub(super) seed: u64,
}

impl Scan {
    /// 96 x 96 x 24, .6 x .6 x 1.5 mm, SNR 20, dark tissue.
    pub(super) fn new(vessels: Vec<Capsule>) -> Self {
        Self {
            n: [96, 96, 24],
            step: [0.6, 0.6, 1.5],
            vessels,
            vessel: 100.0,
            tissue: 20.0,
            body: 1e9,
            noise: 5.0,
            bias: 0.0,
            fade: 1.0,
            seed: 1,
        }
    }
    /// Share of lumen in every pixel: quarter-pixel samples under the point spread of .6 px and the pixel's own square.
    fn shares(&self) -> Vec<f64> {
        let [w, h, d] = self.n;
        let reach = 10i32; // quarter pixels
        let weight: Vec<f64> = (-reach..=reach)
            .map(|k| {
                (0..8)
                    .map(|q| (f64::from(k) / 4.0 + (f64::from(q) - 3.5) / 8.0) / 0.6)
                    .map(|x| (-0.5 * x * x).exp())
                    .sum()
            })
            .collect();
        let total: f64 = weight.iter().sum();
        (0..w * h * d)
            .map(|i| {
                let at = |dx: f64, dy: f64| {
                    let p = [(i % w) as f64 + dx, (i / w % h) as f64 + dy, (i / w / h) as f64];
                    let p = [p[0] * self.step[0], p[1] * self.step[1], p[2] * self.step[2]];
                    self.vessels.iter().map(|c| distance(c, p)).fold(f64::MAX, f64::min)
                };
                let middle = at(0.0, 0.0);
                if middle.abs() > 3.6 * self.step[0] {
                    return f64::from(u8::from(middle < 0.0));
                }
                let mut sum = 0.0;
                for (wy, ky) in weight.iter().zip(-reach..) {
                    for (wx, kx) in weight.iter().zip(-reach..) {
                        let d = at(f64::from(kx) / 4.0, f64::from(ky) / 4.0) / (self.step[0] / 4.0);
                        sum += wx * wy * (0.5 - d).clamp(0.0, 1.0);
                    }
                }
                sum / (total * total)
            })
            .collect()
    }
    pub(super) fn stack(&self) -> Stack {
        let n = self.n;
        let mut noise = Noise::new(self.seed);
        let middle = [0, 1, 2].map(|a| 0.5 * (n[a] - 1) as f64 * self.step[a]);
        let share = self.shares();
        let mut pixels = Vec::with_capacity(n[0] * n[1] * n[2]);
        for (i, share) in share.into_iter().enumerate() {
            let z = i / n[0] / n[1];
            let p = [(i % n[0]) as f64 * self.step[0], (i / n[0] % n[1]) as f64 * self.step[1]];
            let body = (p[0] - middle[0]).hypot(p[1] - middle[1]) < self.body;
            let fade = 1.0 + (self.fade - 1.0) * z as f64 / (n[2] - 1) as f64;
            let ground = if body { self.tissue } else { 0.0 };
            let wave = (p[0] / middle[0] * 1.3 + 0.4).sin() * (p[1] / middle[1] * 1.1 - 0.3).cos();
            let clean = (ground + (self.vessel * fade - ground) * share) * (1.0 + self.bias * wave);
            let (a, b) = (self.noise * noise.gauss(), self.noise * noise.gauss());
            pixels.push((clean + a).hypot(b) as f32);
        }
        Stack {
            columns: n[0],
            rows: n[1],
            pixels,
            pixel_spacing_mm: [self.step[1], self.step[0]],
            row_direction: V3::X,
            column_direction: V3::Y,
            origins: (0..n[2]).map(|z| P3::new(0.0, 0.0, z as f64 * self.step[2])).collect(),
            thickness_mm: Some(self.step[2]),
        }
        .validated()
        .unwrap()
    }
}

/// A fork in the middle of the default scan: host along z with a graft at 45 degrees.
pub(super) fn fork() -> Vec<Capsule> {
    let c = [28.5, 28.5, 12.0];
    vec![([28.5, 28.5, -10.0], c, 3.2), (c, [31.0, 28.5, 50.0], 3.0), (c, [48.5, 28.5, 32.0], 3.0)]
}
