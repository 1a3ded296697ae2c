//! Polygonise and remesh the benchmark anastomosis-45.
#![allow(missing_docs, clippy::unwrap_used)]

#[allow(dead_code)]
#[path = "../fields.rs"]
mod fields;

use criterion::{Criterion, criterion_group, criterion_main};
use exec::Ctx;
use surface::{PolygoniseSettings, RemeshSettings, Sizing, polygonise, remesh};

fn anastomosis(c: &mut Criterion) {
    let ctx = Ctx::new(0).unwrap();
    let field = fields::anastomosis();
    let settings = PolygoniseSettings::default();
    let seeds = fields::tips();
    let mut group = c.benchmark_group("anastomosis-45");
    group.sample_size(10);
    group.bench_function("polygonise .5 mm", |b| b.iter(|| polygonise(&field, &seeds, &settings, &ctx).unwrap()));
    let (mesh, _) = polygonise(&field, &seeds, &settings, &ctx).unwrap();
    for (name, sizing) in [("uniform .5 mm", Sizing::Uniform(0.5)), ("curvature .02 mm", Sizing::Curvature)] {
        let settings = RemeshSettings { sizing, ..RemeshSettings::default() };
        group.bench_function(format!("remesh {name}"), |b| {
            b.iter(|| remesh(&mesh, &field, &[], &settings, &ctx).unwrap());
        });
    }
    group.finish();
}

criterion_group!(benches, anastomosis);
criterion_main!(benches);
