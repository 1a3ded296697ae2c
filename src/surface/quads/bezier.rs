//! Lagrange quadrilaterals: values, slopes, and a proof that the Jacobian is positive.
//!
//! With one fixed direction n the number J = (x_xi x x_eta).n is a polynomial of degree 2 p - 1 in each parameter; it is
//! positive everywhere if its Bernstein coefficients are, on the square or on each part of a subdivision of it.

use glam::DVec3;

/// A patch of order p over the unit square: nodes row by row, xi fastest.
pub(crate) struct Patch<'a> {
    pub(crate) basis: &'a Basis,
    pub(crate) nodes: Vec<DVec3>,
}

/// Lagrange polynomials on p + 1 equal steps.
pub(crate) struct Basis {
    pub(crate) order: usize,
    weights: Vec<f64>,
    /// Values at 2 p equal steps to Bernstein coefficients of degree 2 p - 1.
    to_bernstein: Vec<Vec<f64>>,
}

/// Subdivisions until the coefficients must tell.
const DEPTH: usize = 5;

impl Basis {
    pub(crate) fn new(order: usize) -> Self {
        let weights = (0..=order)
            .map(|i| (0..=order).filter(|&j| j != i).map(|j| 1.0 / (i as f64 - j as f64)).product())
            .collect();
        Self { order, weights, to_bernstein: bernstein_inverse(2 * order - 1) }
    }

    /// Values and slopes of all polynomials at a parameter in [0, 1].
    pub(crate) fn at(&self, x: f64) -> Vec<[f64; 2]> {
        let (n, s) = (self.order, x * self.order as f64);
        let product =
            |skip: [usize; 2]| -> f64 { (0..=n).filter(|j| !skip.contains(j)).map(|j| s - j as f64).product() };
        let slope = |i: usize| -> f64 { (0..=n).filter(|&j| j != i).map(|j| product([i, j])).sum() };
        (0..=n).map(|i| [product([i, i]) * self.weights[i], slope(i) * self.weights[i] * n as f64]).collect()
    }
}

/// The inverse of the matrix of Bernstein polynomials at equal steps, by elimination with pivots.
fn bernstein_inverse(degree: usize) -> Vec<Vec<f64>> {
    let n = degree + 1;
    let binomial = |k: usize| (0..k).fold(1.0, |b, i| b * (degree - i) as f64 / (i + 1) as f64);
    let value = |i: usize, k: usize| {
        let x = i as f64 / degree as f64;
        binomial(k) * x.powi(k as i32) * (1.0 - x).powi((degree - k) as i32)
    };
    let mut m: Vec<Vec<f64>> = (0..n)
        .map(|i| (0..2 * n).map(|k| if k < n { value(i, k) } else { f64::from(u8::from(k - n == i)) }).collect())
        .collect();
    for c in 0..n {
        let pivot = (c..n).max_by(|&a, &b| m[a][c].abs().total_cmp(&m[b][c].abs())).unwrap_or(c);
        m.swap(c, pivot);
        let row = m[c].clone();
        for (r, other) in m.iter_mut().enumerate() {
            let factor = if r == c { 1.0 - 1.0 / row[c] } else { other[c] / row[c] };
            other.iter_mut().zip(&row).for_each(|(o, p)| *o -= factor * p);
        }
    }
    m.into_iter().map(|row| row[n..].to_vec()).collect()
}

impl Patch<'_> {
    /// Position and both slopes.
    pub(crate) fn at(&self, xi: f64, eta: f64) -> [DVec3; 3] {
        let (a, b) = (self.basis.at(xi), self.basis.at(eta));
        let mut out = [DVec3::ZERO; 3];
        for (k, &x) in self.nodes.iter().enumerate() {
            let (a, b) = (a[k % a.len()], b[k / a.len()]);
            out[0] += x * (a[0] * b[0]);
            out[1] += x * (a[1] * b[0]);
            out[2] += x * (a[0] * b[1]);
        }
        out
    }

    /// The direction against which the Jacobian is taken: the mean of the normals at a grid of points.
    pub(crate) fn direction(&self) -> DVec3 {
        let n = self.basis.order;
        let at = |k: usize| (k as f64 + 0.5) / n as f64;
        (0..n * n)
            .fold(DVec3::ZERO, |s, k| s + self.cross(at(k % n), at(k / n)).normalize_or_zero())
            .normalize_or_zero()
    }

    fn cross(&self, xi: f64, eta: f64) -> DVec3 {
        let [_, a, b] = self.at(xi, eta);
        a.cross(b)
    }

    /// Least Bernstein coefficient of the Jacobian over the parts of a subdivision, mm2 per unit square: a proof that it
    /// is nowhere smaller. Not positive where the proof fails.
    pub(crate) fn least_jacobian(&self) -> f64 {
        let degree = 2 * self.basis.order - 1;
        let n = self.direction();
        let at = |k: usize| k as f64 / degree as f64;
        let values: Vec<Vec<f64>> =
            (0..=degree).map(|j| (0..=degree).map(|i| self.cross(at(i), at(j)).dot(n)).collect()).collect();
        let m = &self.basis.to_bernstein;
        let along = |row: &Vec<f64>| -> Vec<f64> { m.iter().map(|w| dot(w, row)).collect() };
        let rows: Vec<Vec<f64>> = values.iter().map(along).collect();
        least(&transposed(&transposed(&rows).iter().map(along).collect::<Vec<_>>()), DEPTH)
    }

    /// Least sine between the two slopes at a grid of points: 1 where parameter lines cross at right angles.
    pub(crate) fn least_sine(&self) -> f64 {
        let n = 2 * self.basis.order;
        let sine = |k: usize| {
            let [_, a, b] = self.at((k % (n + 1)) as f64 / n as f64, (k / (n + 1)) as f64 / n as f64);
            a.cross(b).length() / (a.length() * b.length())
        };
        (0..(n + 1) * (n + 1)).map(sine).fold(1.0, f64::min)
    }

    /// How much the highest polynomial takes part, along xi and along eta, mm: which way to split.
    pub(crate) fn roughness(&self) -> [f64; 2] {
        let n = self.basis.order;
        let sign = |k: usize| if k.is_multiple_of(2) { 1.0 } else { -1.0 };
        let binomial = |k: usize| (0..k).fold(1.0, |b, i| b * (n - i) as f64 / (i + 1) as f64);
        let across = |index: &dyn Fn(usize, usize) -> usize| {
            (0..=n)
                .map(|line| (0..=n).fold(DVec3::ZERO, |s, k| s + self.nodes[index(line, k)] * (sign(k) * binomial(k))))
                .map(DVec3::length)
                .fold(0.0, f64::max)
        };
        [across(&|line, k| line * (n + 1) + k), across(&|line, k| k * (n + 1) + line)]
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0, |s, (a, b)| s + a * b)
}

fn transposed(m: &[Vec<f64>]) -> Vec<Vec<f64>> {
    (0..m.len()).map(|j| m.iter().map(|row| row[j]).collect()).collect()
}

/// Least coefficient, after halving in turn until it is positive or the depth is spent.
fn least(m: &[Vec<f64>], depth: usize) -> f64 {
    let low = m.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let corner = [m[0][0], m[0][m.len() - 1], m[m.len() - 1][0], m[m.len() - 1][m.len() - 1]];
    if low > 0.0 || depth == 0 || corner.iter().any(|&c| c <= 0.0) {
        return low;
    }
    let mut out = f64::INFINITY;
    let halves: Vec<[Vec<f64>; 2]> = m.iter().map(|row| halved(row)).collect();
    for side in 0..2 {
        let half: Vec<Vec<f64>> = halves.iter().map(|h| h[side].clone()).collect();
        let turned: Vec<[Vec<f64>; 2]> = transposed(&half).iter().map(|row| halved(row)).collect();
        for part in 0..2 {
            out = out.min(least(&turned.iter().map(|h| h[part].clone()).collect::<Vec<_>>(), depth - 1));
        }
    }
    out
}

/// De Casteljau's subdivision in the middle.
fn halved(row: &[f64]) -> [Vec<f64>; 2] {
    let mut now = row.to_vec();
    let (mut first, mut second) = (vec![now[0]], vec![now[now.len() - 1]]);
    while now.len() > 1 {
        now = now.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect();
        first.push(now[0]);
        second.push(now[now.len() - 1]);
    }
    second.reverse();
    [first, second]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patch(basis: &Basis, map: impl Fn(f64, f64) -> DVec3) -> Patch<'_> {
        let n = basis.order;
        let at = |k: usize| k as f64 / n as f64;
        let nodes = (0..(n + 1) * (n + 1)).map(|k| map(at(k % (n + 1)), at(k / (n + 1)))).collect();
        Patch { basis, nodes }
    }

    #[test]
    fn a_polynomial_of_the_order_is_met_with_its_slopes() {
        let basis = Basis::new(4);
        let p = patch(&basis, |x, y| DVec3::new(x, y, x.powi(4) * y.powi(3)));
        let [at, a, b] = p.at(0.37, 0.81);
        assert!((at.z - 0.37_f64.powi(4) * 0.81_f64.powi(3)).abs() < 1e-12);
        assert!((a.z - 4.0 * 0.37_f64.powi(3) * 0.81_f64.powi(3)).abs() < 1e-11);
        assert!((b.z - 3.0 * 0.37_f64.powi(4) * 0.81_f64.powi(2)).abs() < 1e-11);
    }

    #[test]
    fn the_proof_holds_for_sound_patches_and_fails_for_folded_ones() {
        let basis = Basis::new(4);
        let flat = patch(&basis, |x, y| DVec3::new(2.0 * x, 3.0 * y, 0.0)).least_jacobian();
        assert!((flat - 6.0).abs() < 1e-9, "{flat}");
        // d/dx (x - a x (1 - x)) = 1 - a (1 - 2 x): positive for a < 1.
        let squeezed = |a: f64| patch(&basis, move |x, y| DVec3::new(x - a * x * (1.0 - x), y, 0.0)).least_jacobian();
        assert!((squeezed(0.9) - 0.1).abs() < 1e-9, "{}", squeezed(0.9));
        assert!(squeezed(1.05) < 0.0);
        // Folded in the middle alone: corners do not tell.
        let inner = patch(&basis, |x, y| DVec3::new(x + 0.3 * (std::f64::consts::TAU * x).sin(), y, 0.0));
        assert!(inner.least_jacobian() <= 0.0);
    }
}
