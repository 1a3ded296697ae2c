//! Sums of plane waves, a cos(k . t + phase), on whole vectors.
//!
//! The library's cosine was an eighth of a whole reconstruction: 24 draws of 256 waves at every sample of every section.
//! Here the argument is counted in turns, so that a whole number of them is taken off without error, and what is left of
//! the quarter turn goes into the Taylor series of the sine: off by less than 1e-11, the same bits on all CPUs.

use crate::wide::{LANES, Lanes, Wide, fold, widest};
use pulp::{Simd, WithSimd};
use std::f64::consts::TAU;

/// amplitude cos(k . t + phase), t scaled.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wave {
    /// Wave vector, radians per scaled length.
    pub(crate) k: [f64; 3],
    /// Radians.
    pub(crate) phase: f64,
    /// Of the sum's unit.
    pub(crate) amplitude: f64,
}

/// A sum of waves.
#[derive(Clone, Debug)]
pub(crate) struct Waves {
    /// By groups: wave vector and phase in turns, amplitude. Padding has amplitude 0.
    groups: Vec<[Lanes; 5]>,
}

/// Terms of sin(2 pi s) = s sum SERIES[n] s^(2 n), enough for |s| <= 1/4: the first left out is 6e-12.
const SERIES: [f64; 8] = {
    let (mut series, mut term, mut n) = ([TAU; 8], TAU, 1);
    while n < 8 {
        term *= -TAU * TAU / (2 * n * (2 * n + 1)) as f64;
        series[n] = term;
        n += 1;
    }
    series
};

/// Added to a number and taken off again it leaves the nearest whole one (below 2^51, when halves round to even).
const ROUND: f64 = 6_755_399_441_055_744.0;

impl FromIterator<Wave> for Waves {
    fn from_iter<I: IntoIterator<Item = Wave>>(waves: I) -> Self {
        let mut groups = Vec::new();
        for (i, wave) in waves.into_iter().enumerate() {
            if i % LANES == 0 {
                groups.push([[0.0; LANES]; 5]);
            }
            let numbers = [wave.k[0] / TAU, wave.k[1] / TAU, wave.k[2] / TAU, wave.phase / TAU, wave.amplitude];
            groups[i / LANES].iter_mut().zip(numbers).for_each(|(lanes, number)| lanes[i % LANES] = number);
        }
        Self { groups }
    }
}

impl Waves {
    /// The sum at one point.
    pub(crate) fn at(&self, t: [f64; 3]) -> f64 {
        widest(Sum { waves: self, t })
    }
}

struct Sum<'a> {
    waves: &'a Waves,
    t: [f64; 3],
}

impl WithSimd for Sum<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let t = self.t.map(|t| Wide::splat(simd, t));
        let [round, zero, quarter] = [ROUND, 0.0, 0.25].map(|x| Wide::splat(simd, x));
        let series = SERIES.map(|x| Wide::splat(simd, x));
        let mut out = [0.0; LANES];
        for part in 0..Wide::<S>::PARTS {
            let mut sum = zero;
            for group in &self.waves.groups {
                let [kx, ky, kz, phase, amplitude] = group.each_ref().map(|lanes| Wide::of(simd, lanes, part));
                let turns = kx * t[0] + ky * t[1] + kz * t[2] + phase;
                let rest = turns - ((turns + round) - round);
                // cos(2 pi r) = sin(2 pi (1/4 - |r|))
                let s = quarter - rest.max(zero - rest);
                let s2 = s * s;
                let mut power = series[7];
                for n in (0..7).rev() {
                    power = power * s2 + series[n];
                }
                sum += amplitude * (power * s);
            }
            sum.put(&mut out, part);
        }
        fold(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::Scalar;

    #[test]
    fn a_sum_is_that_of_the_library_s_cosines() {
        let wave = |i: usize| {
            let x = i as f64;
            let k = [0.7, 1.1, 1.9].map(|a: f64| (a * x).sin() * 0.5 * 1.1_f64.powf(x));
            Wave { k, phase: 7.0 * (1.3 * x).sin(), amplitude: 1.0 + (0.3 * x).cos() }
        };
        // up to some 1,000 radians; a whole number of groups and a broken one
        for count in [1, 8, 83] {
            let waves: Vec<Wave> = (0..count).map(wave).collect();
            let sum: Waves = waves.iter().copied().collect();
            for t in [[0.0; 3], [0.25, -0.5, 0.125], [0.9, 0.3, -0.8]] {
                let exact = waves.iter().fold(0.0, |s, w| {
                    s + w.amplitude * (w.k[0] * t[0] + w.k[1] * t[1] + w.k[2] * t[2] + w.phase).cos()
                });
                let found = sum.at(t);
                let most = 1e-11 * waves.iter().fold(0.0, |s, w| s + w.amplitude.abs());
                assert!((found - exact).abs() < most, "{count} waves at {t:?}: {found}, {exact}");
                assert_eq!(Sum { waves: &sum, t }.with_simd(Scalar).to_bits(), found.to_bits());
            }
        }
        // the ends of the series' range: quarter and half turns
        for quarters in 0..9_u8 {
            let phase = f64::from(quarters) * TAU / 4.0;
            let one: Waves = std::iter::once(Wave { k: [0.0; 3], phase, amplitude: 1.0 }).collect();
            assert!((one.at([0.0; 3]) - phase.cos()).abs() < 1e-11, "{quarters} quarters");
        }
    }
}
