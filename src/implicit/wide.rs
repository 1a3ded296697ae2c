//! Groups of eight doubles, worked on by the widest instructions that the CPU has.
//!
//! Loops over eight accumulators were left to the compiler, inside closures given to `pulp::Arch::dispatch`. It compiled
//! them for two doubles at a time: a closure's body is not inlined into the function that carries the instruction set,
//! and where it is, its short loops are still packed by two (docs/adr/0026: half of the machine's rate of square roots for
//! f, a quarter for f with gradient). Here a kernel is a [`WithSimd`] and its arithmetic is written out on [`Wide`].
//!
//! No operation is fused or reassociated, and the eight accumulators are the same for every width, so that results have
//! the same bits on all CPUs.

use pulp::{Arch, Simd, WithSimd};
use std::ops::{Add, AddAssign, Div, Mul, Sub, SubAssign};

/// Accumulators per sum: the widest instruction set's doubles.
pub(crate) const LANES: usize = 8;

/// Doubles that are worked on together.
pub(crate) type Lanes = [f64; LANES];

/// Runs a kernel with the widest instructions of this CPU.
#[inline(always)]
pub(crate) fn widest<K: WithSimd>(kernel: K) -> K::Output {
    Arch::new().dispatch(kernel)
}

/// As many of a group's lanes as one instruction takes.
#[derive(Clone, Copy)]
pub(crate) struct Wide<S: Simd> {
    simd: S,
    lanes: S::f64s,
}

impl<S: Simd> Wide<S> {
    /// Parts that a group falls into. Kernels do one part after the other: all its sums then stay in registers.
    pub(crate) const PARTS: usize = LANES / S::F64_LANES;

    #[inline(always)]
    pub(crate) fn splat(simd: S, x: f64) -> Self {
        Self { simd, lanes: simd.splat_f64s(x) }
    }
    /// One part of a group, or of a longer list.
    #[inline(always)]
    pub(crate) fn of(simd: S, group: &[f64], part: usize) -> Self {
        Self { simd, lanes: S::as_simd_f64s(group).0[part] }
    }
    /// Stores into one part of a group, or of a longer list.
    #[inline(always)]
    pub(crate) fn put(self, group: &mut [f64], part: usize) {
        S::as_mut_simd_f64s(group).0[part] = self.lanes;
    }
    #[inline(always)]
    pub(crate) fn sqrt(self) -> Self {
        Self { lanes: self.simd.sqrt_f64s(self.lanes), ..self }
    }
    #[inline(always)]
    pub(crate) fn max(self, other: Self) -> Self {
        Self { lanes: self.simd.max_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Add for Wide<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { lanes: self.simd.add_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Sub for Wide<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { lanes: self.simd.sub_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Mul for Wide<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { lanes: self.simd.mul_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> Div for Wide<S> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Self { lanes: self.simd.div_f64s(self.lanes, other.lanes), ..self }
    }
}

impl<S: Simd> AddAssign for Wide<S> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl<S: Simd> SubAssign for Wide<S> {
    #[inline(always)]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

/// The difference of two points and its square, for one part of a group of points.
#[inline(always)]
pub(crate) fn apart<S: Simd>(t: [Wide<S>; 3], [x, y, z]: [&[f64]; 3], part: usize) -> ([Wide<S>; 3], Wide<S>) {
    let simd = t[0].simd;
    let d = [t[0] - Wide::of(simd, x, part), t[1] - Wide::of(simd, y, part), t[2] - Wide::of(simd, z, part)];
    (d, d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
}

/// The lanes' sum in a fixed order.
#[inline(always)]
pub(crate) fn fold(a: Lanes) -> f64 {
    ((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::Scalar;

    /// r^3 and the larger of r and 1, with whatever instructions.
    struct Cubes<'a>(&'a [Lanes; 3], [f64; 3]);

    impl WithSimd for Cubes<'_> {
        type Output = [Lanes; 2];
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> [Lanes; 2] {
            let t = self.1.map(|t| Wide::splat(simd, t));
            let mut out = [[0.0; LANES]; 2];
            for part in 0..Wide::<S>::PARTS {
                let (_, r2) = apart(t, [&self.0[0], &self.0[1], &self.0[2]], part);
                (r2 * r2.sqrt()).put(&mut out[0], part);
                r2.sqrt().max(Wide::splat(simd, 1.0)).put(&mut out[1], part);
            }
            out
        }
    }

    #[test]
    fn every_width_gives_the_bits_of_plain_arithmetic() {
        let group: [Lanes; 3] = [0.3, 1.7, 2.9].map(|a: f64| std::array::from_fn(|l| (a * (l as f64 + 1.0)).sin()));
        let t = [0.1, -0.7, 0.4];
        let plain: [Lanes; 2] = {
            let r2: Lanes = std::array::from_fn(|l| {
                let d = [0, 1, 2].map(|a| t[a] - group[a][l]);
                d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            });
            [r2.map(|r2| r2 * r2.sqrt()), r2.map(|r2| r2.sqrt().max(1.0))]
        };
        assert_eq!(widest(Cubes(&group, t)), plain);
        assert_eq!(Cubes(&group, t).with_simd(Scalar), plain);
    }
}
