//! Sums over the cubic kernel |x - x_i|^3, with its gradient and Hessian.
//!
//! The sums are direct. Centres lie in structure-of-arrays form, padded to whole groups of [`LANES`], and every group
//! adds into as many independent accumulators ([`crate::wide`]). They run at nine tenths of the rate at which the machine
//! takes square roots.

use crate::wide::{LANES, Lanes, Wide, apart, fold, widest};
use pulp::{Simd, WithSimd};

/// Centres and coefficients of a cubic radial sum.
#[derive(Clone, Debug, Default)]
pub(crate) struct Centres {
    x: Vec<Lanes>,
    y: Vec<Lanes>,
    z: Vec<Lanes>,
    c: Vec<Lanes>,
    len: usize,
}

/// Value, gradient and second derivatives (xx, yy, zz, xy, xz, yz) of a sum.
pub(crate) type Jet = (f64, [f64; 3], [f64; 6]);

impl Centres {
    /// From points and their coefficients (equal lengths). Padding has coefficient 0.
    pub(crate) fn new(points: &[[f64; 3]], coefficients: &[f64]) -> Self {
        let groups = points.len().div_ceil(LANES);
        let mut s = Self {
            x: vec![[0.0; LANES]; groups],
            y: vec![[0.0; LANES]; groups],
            z: vec![[0.0; LANES]; groups],
            c: vec![[0.0; LANES]; groups],
            len: points.len(),
        };
        for (i, (p, &c)) in points.iter().zip(coefficients).enumerate() {
            let (g, l) = (i / LANES, i % LANES);
            (s.x[g][l], s.y[g][l], s.z[g][l], s.c[g][l]) = (p[0], p[1], p[2], c);
        }
        s
    }

    /// Positions and coefficients as one list.
    pub(crate) fn numbers(&self) -> Vec<f64> {
        [&self.x, &self.y, &self.z, &self.c].into_iter().flatten().flatten().copied().collect()
    }

    /// Number of centres.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Position and coefficient of a centre.
    pub(crate) fn source(&self, i: usize) -> ([f64; 3], f64) {
        let (g, l) = (i / LANES, i % LANES);
        ([self.x[g][l], self.y[g][l], self.z[g][l]], self.c[g][l])
    }

    /// Some of the centres, in the order given.
    pub(crate) fn some(&self, which: &[u32]) -> Self {
        let (points, coefficients): (Vec<_>, Vec<_>) = which.iter().map(|&i| self.source(i as usize)).unzip();
        Self::new(&points, &coefficients)
    }

    /// sum c_i r^3 at each target.
    pub(crate) fn values(&self, targets: &[[f64; 3]], out: &mut [f64]) {
        widest(Values { centres: self, targets, out });
    }

    /// Value and gradient at one target.
    pub(crate) fn gradient(&self, target: [f64; 3]) -> (f64, [f64; 3]) {
        widest(Gradient { centres: self, target })
    }

    /// Value, gradient and second derivatives at one target.
    pub(crate) fn hessian(&self, target: [f64; 3]) -> Jet {
        widest(Hessian { centres: self, target })
    }

    /// Positions and coefficients by groups.
    #[inline(always)]
    fn groups(&self) -> impl Iterator<Item = ([&[f64]; 3], &Lanes)> {
        self.x.iter().zip(&self.y).zip(&self.z).zip(&self.c).map(|(((x, y), z), c)| ([&x[..], y, z], c))
    }
}

struct Values<'a> {
    centres: &'a Centres,
    targets: &'a [[f64; 3]],
    out: &'a mut [f64],
}

impl WithSimd for Values<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (o, target) in self.out.iter_mut().zip(self.targets) {
            let t = target.map(|t| Wide::splat(simd, t));
            let mut out = [0.0; LANES];
            for part in 0..Wide::<S>::PARTS {
                let mut f = Wide::splat(simd, 0.0);
                for (x, c) in self.centres.groups() {
                    let (_, r2) = apart(t, x, part);
                    f += Wide::of(simd, c, part) * (r2 * r2.sqrt());
                }
                f.put(&mut out, part);
            }
            *o = fold(out);
        }
    }
}

struct Gradient<'a> {
    centres: &'a Centres,
    target: [f64; 3],
}

impl WithSimd for Gradient<'_> {
    type Output = (f64, [f64; 3]);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let t = self.target.map(|t| Wide::splat(simd, t));
        let (mut f, mut g) = ([0.0; LANES], [[0.0; LANES]; 3]);
        for part in 0..Wide::<S>::PARTS {
            let mut sum = [Wide::splat(simd, 0.0); 4];
            for (x, c) in self.centres.groups() {
                let (d, r2) = apart(t, x, part);
                let cr = Wide::of(simd, c, part) * r2.sqrt();
                sum[0] += cr * r2;
                sum[1] += cr * d[0];
                sum[2] += cr * d[1];
                sum[3] += cr * d[2];
            }
            sum[0].put(&mut f, part);
            (0..3).for_each(|a| sum[a + 1].put(&mut g[a], part));
        }
        (fold(f), g.map(|a| 3.0 * fold(a)))
    }
}

struct Hessian<'a> {
    centres: &'a Centres,
    target: [f64; 3],
}

impl WithSimd for Hessian<'_> {
    type Output = Jet;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Jet {
        let t = self.target.map(|t| Wide::splat(simd, t));
        // d d' / r tends to 0 with r
        let least = Wide::splat(simd, 1e-150);
        let mut lanes = [[0.0; LANES]; 11];
        for part in 0..Wide::<S>::PARTS {
            let mut sum = [Wide::splat(simd, 0.0); 11];
            let [f, gx, gy, gz, xx, yy, zz, xy, xz, yz, trace] = &mut sum;
            for (x, c) in self.centres.groups() {
                let (d, r2) = apart(t, x, part);
                let c = Wide::of(simd, c, part);
                let r = r2.sqrt();
                let cr = c * r;
                let q = c / r.max(least);
                *f += cr * r2;
                *trace += cr;
                *gx += cr * d[0];
                *gy += cr * d[1];
                *gz += cr * d[2];
                let [qx, qy, qz] = d.map(|d| q * d);
                *xx += qx * d[0];
                *yy += qy * d[1];
                *zz += qz * d[2];
                *xy += qx * d[1];
                *xz += qx * d[2];
                *yz += qy * d[2];
            }
            sum.iter().zip(&mut lanes).for_each(|(sum, lanes)| sum.put(lanes, part));
        }
        let [f, gx, gy, gz, xx, yy, zz, xy, xz, yz, trace] = lanes.map(fold);
        let [xx, yy, zz] = [xx, yy, zz].map(|h| 3.0 * h + 3.0 * trace);
        (f, [gx, gy, gz].map(|g| 3.0 * g), [xx, yy, zz, 3.0 * xy, 3.0 * xz, 3.0 * yz])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_agree_with_differences() {
        let points: Vec<[f64; 3]> =
            (0..13).map(|i| [(i as f64 * 0.7).sin(), (i as f64 * 1.3).cos(), (i as f64 * 2.1).sin()]).collect();
        let c: Vec<f64> = (0..13).map(|i| (i as f64 * 0.37).cos()).collect();
        let s = Centres::new(&points, &c);
        let t = [0.3, -0.2, 0.45];
        let (f, g, h) = s.hessian(t);
        assert!((s.gradient(t).0 - f).abs() < 1e-12);
        let e = 1e-5;
        for a in 0..3 {
            let mut p = [t, t];
            p[0][a] += e;
            p[1][a] -= e;
            let mut v = [0.0; 2];
            s.values(&p, &mut v);
            assert!(((v[0] - v[1]) / (2.0 * e) - g[a]).abs() < 1e-7);
            let (gp, gm) = (s.gradient(p[0]).1, s.gradient(p[1]).1);
            let d: Vec<f64> = (0..3).map(|b| (gp[b] - gm[b]) / (2.0 * e)).collect();
            assert!((d[a] - h[a]).abs() < 1e-6);
        }
    }

    #[test]
    fn a_centre_on_the_target_is_finite() {
        let s = Centres::new(&[[1.0, 2.0, 3.0]], &[5.0]);
        assert_eq!(s.hessian([1.0, 2.0, 3.0]), (0.0, [0.0; 3], [0.0; 6]));
    }
}
