//! Sums over the cubic kernel |x - x_i|^3, with its gradient and Hessian.
//!
//! The sums are direct. Centres lie in structure-of-arrays form, padded to whole groups of [`LANES`], and every group
//! adds into as many independent accumulators: that vectorises without reassociation, so the result has the same bits
//! with and without AVX2. `pulp` picks the widest instruction set of the CPU at run time.

use pulp::Arch;

/// Accumulators per sum. 8 doubles fill two AVX2 registers, which hides the latency of the addition.
pub(crate) const LANES: usize = 8;

/// Centres and coefficients of a cubic radial sum.
#[derive(Clone, Debug, Default)]
pub(crate) struct Centres {
    x: Vec<[f64; LANES]>,
    y: Vec<[f64; LANES]>,
    z: Vec<[f64; LANES]>,
    c: Vec<[f64; LANES]>,
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
        Arch::new().dispatch(|| {
            for (o, t) in out.iter_mut().zip(targets) {
                *o = self.value(*t);
            }
        });
    }

    /// Value and gradient at one target.
    pub(crate) fn gradient(&self, target: [f64; 3]) -> (f64, [f64; 3]) {
        Arch::new().dispatch(|| self.value_gradient(target))
    }

    /// Value, gradient and second derivatives at one target.
    pub(crate) fn hessian(&self, target: [f64; 3]) -> Jet {
        Arch::new().dispatch(|| self.jet(target))
    }

    #[inline(always)]
    fn groups(&self) -> impl Iterator<Item = [&[f64; LANES]; 4]> {
        self.x.iter().zip(&self.y).zip(&self.z).zip(&self.c).map(|(((x, y), z), c)| [x, y, z, c])
    }

    #[inline(always)]
    fn value(&self, t: [f64; 3]) -> f64 {
        let mut acc = [0.0; LANES];
        for [x, y, z, c] in self.groups() {
            for l in 0..LANES {
                let d = [t[0] - x[l], t[1] - y[l], t[2] - z[l]];
                let r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                acc[l] += c[l] * (r2 * r2.sqrt());
            }
        }
        fold(acc)
    }

    #[inline(always)]
    fn value_gradient(&self, t: [f64; 3]) -> (f64, [f64; 3]) {
        let mut f = [0.0; LANES];
        let mut g = [[0.0; LANES]; 3];
        for [x, y, z, c] in self.groups() {
            for l in 0..LANES {
                let d = [t[0] - x[l], t[1] - y[l], t[2] - z[l]];
                let r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                let cr = c[l] * r2.sqrt();
                f[l] += cr * r2;
                for a in 0..3 {
                    g[a][l] += cr * d[a];
                }
            }
        }
        (fold(f), g.map(|a| 3.0 * fold(a)))
    }

    #[inline(always)]
    fn jet(&self, t: [f64; 3]) -> Jet {
        let mut f = [0.0; LANES];
        let mut g = [[0.0; LANES]; 3];
        let mut h = [[0.0; LANES]; 6];
        let mut trace = [0.0; LANES];
        for [x, y, z, c] in self.groups() {
            for l in 0..LANES {
                let d = [t[0] - x[l], t[1] - y[l], t[2] - z[l]];
                let r2 = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                let r = r2.sqrt();
                let cr = c[l] * r;
                // d d' / r tends to 0 with r
                let q = c[l] / r.max(1e-150);
                f[l] += cr * r2;
                trace[l] += cr;
                for a in 0..3 {
                    g[a][l] += cr * d[a];
                    h[a][l] += q * d[a] * d[a];
                }
                h[3][l] += q * d[0] * d[1];
                h[4][l] += q * d[0] * d[2];
                h[5][l] += q * d[1] * d[2];
            }
        }
        let tr = fold(trace);
        let mut second = h.map(|a| 3.0 * fold(a));
        for s in &mut second[..3] {
            *s += 3.0 * tr;
        }
        (fold(f), g.map(|a| 3.0 * fold(a)), second)
    }
}

/// The lanes' sum in a fixed order.
#[inline(always)]
pub(crate) fn fold(a: [f64; LANES]) -> f64 {
    ((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7]))
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
