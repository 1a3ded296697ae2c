//! Thinning a bifurcation that fills some 1-2 % of 128^3, 256^3 and 512^3 voxels, one and two threads.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use exec::Ctx;
use skeleton::{BitVolume, thin};

/// A Y of three tubes of radius n / 18, from the middle to three faces of the cube.
fn bifurcation(n: usize) -> BitVolume {
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

fn thinning(c: &mut Criterion) {
    let mut group = c.benchmark_group("thin");
    group.sample_size(10);
    for n in [128, 256, 512] {
        let volume = bifurcation(n);
        for threads in [1, 2] {
            let ctx = Ctx::new(threads).unwrap();
            group.bench_function(format!("{n}^3, {threads} threads, {} voxels", volume.count()), |b| {
                b.iter_batched_ref(|| volume.clone(), |v| thin(v, &ctx).unwrap(), BatchSize::PerIteration);
            });
        }
    }
    group.finish();
}

criterion_group!(benches, thinning);
criterion_main!(benches);
