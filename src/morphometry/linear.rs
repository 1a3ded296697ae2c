//! Small dense linear algebra: systems of up to eight unknowns, eigenvectors of symmetric 3 x 3 matrices, medians.

use space::{DMat3, DVec3};

/// The solution of a x = b by elimination with partial pivoting; `None` when singular to working precision.
pub(crate) fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    let scale = a.iter().flatten().fold(0.0f64, |m, x| m.max(x.abs()));
    for c in 0..N {
        let p = (c..N).max_by(|&i, &j| a[i][c].abs().total_cmp(&a[j][c].abs()))?;
        if !positive(a[p][c].abs() - 1e-14 * scale) {
            return None;
        }
        a.swap(c, p);
        b.swap(c, p);
        for r in c + 1..N {
            let m = a[r][c] / a[c][c];
            let pivot = a[c];
            for (x, y) in a[r].iter_mut().zip(pivot).skip(c) {
                *x -= m * y;
            }
            b[r] -= m * b[c];
        }
    }
    let mut x = [0.0; N];
    for c in (0..N).rev() {
        let known: f64 = (c + 1..N).map(|k| a[c][k] * x[k]).sum();
        x[c] = (b[c] - known) / a[c][c];
    }
    x.iter().all(|v| v.is_finite()).then_some(x)
}

/// Eigenvalues, ascending, and unit eigenvectors of a symmetric matrix, by Jacobi's rotations.
pub(crate) fn eigen3(m: DMat3) -> [(f64, DVec3); 3] {
    const SWEEPS: usize = 30; // converges quadratically: 6 sweeps reach 1e-30, the rest costs nothing once at rest
    let mut a = m.to_cols_array_2d();
    let mut v = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..SWEEPS {
        if a[0][1].abs() + a[0][2].abs() + a[1][2].abs() <= f64::MIN_POSITIVE {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let c = 1.0 / t.hypot(1.0);
            let s = t * c;
            for row in &mut a {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            for k in 0..3 {
                (a[p][k], a[q][k]) = (c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]);
                (v[p][k], v[q][k]) = (c * v[p][k] - s * v[q][k], s * v[p][k] + c * v[q][k]);
            }
        }
    }
    let mut out = [0, 1, 2].map(|i| (a[i][i], DVec3::from_array(v[i])));
    out.sort_by(|x, y| x.0.total_cmp(&y.0));
    out
}

/// Whether a number is greater than 0, and a number at all.
pub(crate) fn positive(x: f64) -> bool {
    x > 0.0
}

/// The middle value (mean of the two middle ones); `None` of nothing.
pub(crate) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => None,
        _ if n % 2 == 1 => Some(values[n / 2]),
        _ => Some(0.5 * (values[n / 2 - 1] + values[n / 2])),
    }
}

/// Sum of w v v^T.
pub(crate) fn outer(v: DVec3, w: f64) -> DMat3 {
    DMat3::from_cols(v * (v.x * w), v * (v.y * w), v * (v.z * w))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn eigenvectors_rebuild_the_matrix() {
        let m = outer(DVec3::new(1.0, 2.0, -1.0), 3.0) + outer(DVec3::new(0.3, -0.2, 5.0), 0.5);
        let e = eigen3(m);
        let back = e.iter().fold(DMat3::ZERO, |s, &(l, v)| s + outer(v, l));
        assert!((back - m).to_cols_array().iter().all(|x| x.abs() < 1e-12));
        assert!(e[0].0 <= e[1].0 && e[1].0 <= e[2].0);
        assert!(e[0].1.dot(e[1].1).abs() < 1e-14 && e[1].1.dot(e[2].1).abs() < 1e-14);
    }

    #[test]
    fn a_singular_system_has_no_solution() {
        assert!(solve([[1.0, 2.0], [2.0, 4.0]], [1.0, 2.0]).is_none());
        let x = solve([[0.0, 2.0], [3.0, 4.0]], [2.0, 10.0]).unwrap();
        assert!((x[0] - 2.0).abs() < 1e-14 && (x[1] - 1.0).abs() < 1e-14);
    }
}
