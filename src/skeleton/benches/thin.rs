//! Thinning a bifurcation that fills some 1-2 % of 128^3, 256^3 and 512^3 voxels, one and two threads.
#![allow(missing_docs, clippy::unwrap_used)]

#[path = "../examples/bifurcation/mod.rs"]
mod bifurcation;

use bifurcation::bifurcation;
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use exec::Ctx;
use skeleton::thin;

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
