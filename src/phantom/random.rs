//! Seeded random numbers by counter: the number of a voxel depends on the seed and the voxel's index alone, so that no
//! thread order, missing slice or crop changes it. The mixer is SplitMix64's finaliser (Steele, Lea, Flood 2014).

use std::f64::consts::TAU;

/// 2^64 over the golden ratio, the increment of SplitMix64.
const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// SplitMix64's finaliser, a bijection of 64 bits.
fn mixed(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// One independent stream of random numbers, addressed by index.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stream(u64);

impl Stream {
    /// The stream of a seed and a purpose (noise, texture, placement, ...).
    pub(crate) fn new(seed: u64, purpose: u64) -> Self {
        Self(mixed(mixed(seed.wrapping_add(GOLDEN)) ^ purpose.wrapping_mul(GOLDEN)))
    }
    /// 64 bits for an index.
    pub(crate) fn bits(self, index: u64) -> u64 {
        mixed(self.0.wrapping_add(index.wrapping_add(1).wrapping_mul(GOLDEN)))
    }
    /// Uniform in [0, 1), 53 bits.
    pub(crate) fn uniform(self, index: u64) -> f64 {
        (self.bits(index) >> 11) as f64 / (1u64 << 53) as f64
    }
    /// Uniform in [low, high).
    pub(crate) fn between(self, index: u64, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform(index)
    }
    /// Two independent standard normal numbers (Box and Muller 1958).
    pub(crate) fn normal_pair(self, index: u64) -> [f64; 2] {
        let u = 1.0 - self.uniform(2 * index);
        let (sin, cos) = (TAU * self.uniform(2 * index + 1)).sin_cos();
        let r = (-2.0 * u.ln()).sqrt();
        [r * cos, r * sin]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_distribution() {
        let s = Stream::new(7, 1);
        let n = 200_000;
        let x: Vec<f64> = (0..n / 2).flat_map(|i| s.normal_pair(i)).collect();
        let moment = |p: i32| x.iter().map(|v| v.powi(p)).sum::<f64>() / n as f64;
        assert!(moment(1).abs() < 0.01, "mean {}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.015, "variance {}", moment(2));
        assert!(moment(3).abs() < 0.03, "skewness {}", moment(3));
        assert!((moment(4) - 3.0).abs() < 0.1, "fourth moment {}", moment(4));
        let product = x.chunks(2).map(|p| p[0] * p[1]).sum::<f64>() / (n / 2) as f64;
        assert!(product.abs() < 0.01, "pairs are correlated by {product}");
    }

    #[test]
    fn streams_differ_by_seed_and_by_purpose() {
        assert_ne!(Stream::new(1, 1).bits(0), Stream::new(2, 1).bits(0));
        assert_ne!(Stream::new(1, 1).bits(0), Stream::new(1, 2).bits(0));
        assert_ne!(Stream::new(0, 0).bits(0), Stream::new(0, 0).bits(1));
    }
}
