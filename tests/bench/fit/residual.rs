//! The true residual of coefficients by a plain double sum that shares no code with either solver.

use crate::data::{Data, Outcome};

/// Most constraints at which all residuals are taken; beyond, every so many-th.
const ALL: usize = 20_000;
const SAMPLE: usize = 5_000;

/// Largest |y - (K + noise) c - P b|, with the b that fits best, and the largest |P'c| over sum |c|.
pub(crate) fn of(data: &Data, c: &[f64], noise: f64) -> Outcome<[f64; 2]> {
    let x: Vec<[f64; 3]> = data.points.iter().map(|p| p.to_array()).collect();
    if c.len() != x.len() {
        return Err(format!("{} coefficients of {} constraints", c.len(), x.len()).into());
    }
    let stride = if x.len() <= ALL { 1 } else { x.len() / SAMPLE };
    let mut rows: Vec<([f64; 4], f64)> = Vec::new();
    for i in (0..x.len()).step_by(stride) {
        let mut sum = noise * c[i];
        for (p, c) in x.iter().zip(c) {
            let r2 = (p[0] - x[i][0]).powi(2) + (p[1] - x[i][1]).powi(2) + (p[2] - x[i][2]).powi(2);
            sum += c * r2.powf(1.5);
        }
        rows.push(([1.0, x[i][0], x[i][1], x[i][2]], data.values[i] - sum));
    }
    // two passes: the second takes what rounding left of the first
    for _ in 0..2 {
        let b = polynomial(&rows);
        rows.iter_mut().for_each(|(p, r)| *r -= (0..4).map(|k| b[k] * p[k]).sum::<f64>());
    }
    let largest = rows.iter().fold(0.0_f64, |m, r| if r.1.is_nan() { f64::INFINITY } else { m.max(r.1.abs()) });
    let total: f64 = c.iter().map(|c| c.abs()).sum();
    let side = |a: usize| x.iter().zip(c).map(|(p, c)| c * if a == 0 { 1.0 } else { p[a - 1] }).sum::<f64>().abs();
    Ok([largest, (0..4).fold(0.0_f64, |m, a| m.max(side(a) / total))])
}

/// Least squares of the residuals by 1, x, y, z (normal equations, Gauss).
fn polynomial(rows: &[([f64; 4], f64)]) -> [f64; 4] {
    let mut a = [[0.0; 5]; 4];
    for (p, r) in rows {
        for i in 0..4 {
            (0..4).for_each(|j| a[i][j] += p[i] * p[j]);
            a[i][4] += p[i] * r;
        }
    }
    for k in 0..4 {
        for i in 0..4 {
            if i != k {
                let f = a[i][k] / a[k][k];
                (k..5).for_each(|j| a[i][j] -= f * a[k][j]);
            }
        }
    }
    [0, 1, 2, 3].map(|k| a[k][4] / a[k][k])
}
