//! The volume that the benches of thinning take.

use skeleton::BitVolume;

/// A Y of three tubes of radius n / 18, from the middle to three faces of the cube.
pub(crate) fn bifurcation(n: usize) -> BitVolume {
    let m = n as f64;
    let (middle, radius) = ([0.5 * m; 3], m / 18.0);
    let ends = [[0.5 * m, 0.5 * m, 0.02 * m], [0.8 * m, 0.55 * m, 0.98 * m], [0.25 * m, 0.4 * m, 0.98 * m]];
    let mut volume = BitVolume::new([n, n, n]);
    for v in (0..n * n * n).map(|i| [i % n, i / n % n, i / n / n]) {
        let x = v.map(|c| c as f64);
        if ends.iter().any(|&e| distance(x, middle, e) < radius) {
            volume.set(v);
        }
    }
    volume
}

fn distance(x: [f64; 3], a: [f64; 3], b: [f64; 3]) -> f64 {
    let (d, e): ([f64; 3], [f64; 3]) = (std::array::from_fn(|i| b[i] - a[i]), std::array::from_fn(|i| x[i] - a[i]));
    let dot = |p: [f64; 3], q: [f64; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let t = (dot(d, e) / dot(d, d)).clamp(0.0, 1.0);
    let r: [f64; 3] = std::array::from_fn(|i| e[i] - t * d[i]);
    dot(r, r).sqrt()
}
