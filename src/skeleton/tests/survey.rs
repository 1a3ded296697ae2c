//! Many drawn anastomoses as a stack of slices sees them, clean and with a rough wall: three ends, one junction.
//!
//! The full survey (512 voxels across, more draws) takes minutes:
//! `cargo test --release -p skeleton --test survey -- --ignored --nocapture`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod shapes;

use exec::Ctx;
use implicit::Field;
use shapes::*;
use skeleton::{NodeKind, Settings, medial_graph};

/// Standard deviation of the wall's noise, voxels.
const NOISE_VOXELS: f64 = 0.35;

/// (ends, junctions, cycles, pieces) of a drawn anastomosis with `across` voxels along the longest side; what is wrong
/// otherwise.
fn graph_of(seed: u64, across: usize, noise: f64) -> Result<usize, String> {
    let star = drawn_anastomosis(seed);
    let size = star.vessel.bounds.size();
    let h = size.x().max(size.y()).max(size.z()) / (across - 4) as f64;
    let rough = Rough { smooth: &star.vessel, sigma_mm: noise * h, cell_mm: h, seed };
    let field: &dyn Field = if noise > 0.0 { &rough } else { &star.vessel };
    let settings = Settings { spacing_mm: Some(h), ..Settings::default() };
    let ctx = Ctx::new(2).unwrap();
    let place = format!("seed {seed}, {across}^3, noise {noise}");
    let (graph, report) = medial_graph(field, &star.cuts, &star.caps, &star.seeds, &settings, &ctx)
        .map_err(|e| format!("{place}: {e}"))?;
    if counts(&graph) != (3, 1, 0, 1) || report.warnings.iter().any(|w| w.code != "skeleton.pinhole") {
        let lines = graph.edges.iter().map(|e| (e.nodes, e.length_mm() / h, e.radius_mm[e.points.len() / 2] / h));
        let lines: Vec<_> = lines.map(|(n, l, r)| format!("{n:?} length {l:.1}, radius {r:.1} voxels")).collect();
        return Err(format!("{place}: {:?}, {lines:?}, {:?}", counts(&graph), report.warnings));
    }
    let junction = graph.nodes.iter().find(|n| n.kind == NodeKind::Junction).unwrap();
    let off = junction.position.distance(star.centre);
    if off > 1.0 { Err(format!("{place}: the junction lies {off:.2} mm off")) } else { Ok(report.spurs) }
}

fn survey(seeds: std::ops::Range<u64>, sizes: &[usize]) {
    let mut faults = Vec::new();
    for &across in sizes {
        for noise in [0.0, NOISE_VOXELS] {
            let results: Vec<_> = seeds.clone().map(|seed| graph_of(seed, across, noise)).collect();
            let spurs: usize = results.iter().flatten().sum();
            let wrong: Vec<String> = results.into_iter().filter_map(Result::err).collect();
            println!("{across}^3, noise {noise}: {} of {} wrong, {spurs} spurs", wrong.len(), seeds.end - seeds.start);
            faults.extend(wrong);
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn drawn_anastomoses_have_three_ends_and_one_junction() {
    survey(0..16, &[128]);
    survey(0..3, &[256]);
}

#[test]
#[ignore]
fn dbg2() {
    use skeleton::*;
    let across = 128;
    let noise = 0.35;
    for seed in [8u64, 34, 27, 38, 0] {
        let star = drawn_anastomosis(seed);
        let size = star.vessel.bounds.size();
        let h = size.x().max(size.y()).max(size.z()) / (across - 4) as f64;
        let rough = Rough { smooth: &star.vessel, sigma_mm: noise * h, cell_mm: h, seed };
        let settings = Settings { spacing_mm: Some(h), ..Settings::default() };
        let ctx = Ctx::new(2).unwrap();
        let (volume, grid) = voxelise(&rough, &star.cuts, &star.seeds, &settings, &ctx).unwrap();
        let mut t = volume.clone();
        thin(&mut t, &ctx).unwrap();
        let lumen = Lumen::new(&rough, &star.cuts, &volume, &grid).unwrap();
        let show = |g: &MedialGraph, what: &str| {
            println!("{seed} {what} h {h:.3}");
            for (i, n) in g.nodes.iter().enumerate() {
                println!(
                    "  node {i} {:?} deg {} r {:.2} at {:.2?} cap {:?}",
                    n.kind,
                    g.degree(i),
                    n.radius_mm,
                    (n.position - star.centre).to_array(),
                    n.cap
                );
            }
            for e in &g.edges {
                println!(
                    "  edge {:?} len {:.2} min radius {:.2}",
                    e.nodes,
                    e.length_mm(),
                    e.radius_mm.iter().cloned().fold(1e9, f64::min)
                );
            }
        };
        let g = graph(&t, &grid);
        show(&g, "raw");
        let (mut g, _) = prune(g, &lumen, &star.caps, &settings, &ctx).unwrap();
        show(&g, "pruned");
        let w = extend_to_caps(&mut g, &lumen, &star.caps);
        show(&g, "extended");
        println!(
            "{w:?} caps {:.2?}",
            star.caps.iter().map(|c| (c.centroid - star.centre).to_array()).collect::<Vec<_>>()
        );
    }
}
#[test]
#[ignore]
fn dbg() {
    survey(0..60, &[128]);
    survey(0..20, &[256]);
}
#[test]
#[ignore = "minutes; run as the module says"]
fn drawn_anastomoses_at_every_resolution() {
    survey(0..100, &[128, 256]);
    survey(0..20, &[512]);
}
