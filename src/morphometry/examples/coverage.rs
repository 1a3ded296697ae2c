//! Scans simulated from many seeds, reconstructed without meshes: errors of angles and diameters against the exact truth,
//! and how often the truth lies in the 95 % band.
//!
//! `cargo run --release -p morphometry --example coverage -- FIRST COUNT [coarse] [clean]`: .5 x .5 x 1.5 mm at SNR 20, or with
//! `coarse` .7 x .7 x 3 mm at SNR 10; with `clean` no noise.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use exec::Ctx;
use implicit::{Sampled, Smoothing};
use morphometry::{Role, Roles, Settings, measure_with_bands};
use phantom::Kind;
use skeleton::{CapHint, medial_graph};
use std::collections::BTreeMap;
use surface::{Bounded, PolygoniseSettings};

const DRAWS: usize = 24;

/// Error and half width of the band by quantity, over the seeds.
type Table = BTreeMap<String, Vec<(f64, f64)>>;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |i: usize, default: u64| arguments.get(i).map_or(default, |a| a.parse().expect("a number"));
    let (first, count) = (number(0, 1), number(1, 20));
    let [coarse, clean] = ["coarse", "clean"].map(|word| arguments.iter().any(|a| a == word));
    let mut table = Table::new();
    let mut worst = Vec::new();
    for seed in first..first + count {
        match scan(seed, [coarse, clean], &mut table) {
            Ok(angle) => worst.push(angle),
            Err(e) => println!("seed {seed}: {e}"),
        }
    }
    worst.sort_by(f64::total_cmp);
    let at = |part: f64| worst.get(((worst.len() as f64 * part).ceil() as usize).saturating_sub(1));
    println!("worst of the three angles by seed: median {:?}, 95th percentile {:?} degrees", at(0.5), at(0.95));
    println!("quantity              n   rms error   bias      worst     half band   inside %");
    for (name, rows) in &table {
        let n = rows.len() as f64;
        let rms = (rows.iter().map(|r| r.0 * r.0).sum::<f64>() / n).sqrt();
        let bias = rows.iter().map(|r| r.0).sum::<f64>() / n;
        let worst = rows.iter().map(|r| r.0.abs()).fold(0.0, f64::max);
        let mut widths: Vec<f64> = rows.iter().map(|r| r.1).collect();
        widths.sort_by(f64::total_cmp);
        let inside = 100.0 * rows.iter().filter(|r| r.0.abs() <= r.1).count() as f64 / n;
        let half = widths[widths.len() / 2];
        println!("{name:<20} {n:3}   {rms:8.4}  {bias:8.4}  {worst:8.4}   {half:8.4}   {inside:6.1}");
    }
}

/// Puts one scan into the table; the largest error of its three angles, degrees.
fn scan(seed: u64, [coarse, clean]: [bool; 2], table: &mut Table) -> Result<f64, String> {
    let kind = Kind::Anastomosis;
    let mut settings = phantom::Settings { seed, ..phantom::Settings::of(kind) };
    if coarse {
        (settings.pixel_mm, settings.snr, settings.slices) = (0.7, Some(10.0), 22);
        (settings.slice_spacing_mm, settings.thickness_mm) = (3.0, 3.0);
    }
    if clean {
        settings.snr = None;
    }
    let ctx = Ctx::new(2).unwrap();
    let words = |e: &dyn std::error::Error| e.to_string();
    let (stack, truth) = phantom::scan(kind, &settings, &ctx).map_err(|e| words(&e))?;
    let of = |role: phantom::Role| truth.branches.iter().find(|b| b.role == role).expect("a branch");
    let branches = [of(phantom::Role::Graft), of(phantom::Role::Proximal), of(phantom::Role::Distal)];
    let points = branches.map(|b| b.axis.point(0.6 * b.length_mm));
    let imaging = imaging::Settings { seeds: vec![points[1]], ..imaging::Settings::default() };
    let (contours, _) = imaging::contours(&stack, &imaging, &ctx).map_err(|e| words(&e))?;
    let (f, _, ensemble) =
        implicit::fit_with_ensemble(&contours, &implicit::Settings::default(), DRAWS, &ctx).map_err(|e| words(&e))?;
    let bounded = Bounded::new(&f, &contours.cuts, 4.0 * contours.pixel_mm);
    let cells = PolygoniseSettings { cell_mm: contours.pixel_mm, ..PolygoniseSettings::default() };
    let (raw, _) = surface::polygonise(&bounded, f.wall(), &cells, &ctx).map_err(|e| words(&e))?;
    let smoothing = Smoothing::new(contours.pixel_mm);
    let sampled = Sampled::new(&f, &raw.vertices, &smoothing.sampling(), &ctx).map_err(|e| words(&e))?;
    let caps: Vec<CapHint> =
        branches.iter().enumerate().filter_map(|(i, b)| cap(i as u32 + 1, b, &contours.cuts)).collect();
    let inside = |p: &space::P3| contours.cuts.iter().all(|c| !c.excludes(*p));
    let seeds: Vec<space::P3> = f.inner().iter().copied().filter(inside).collect();
    let (graph, _) = medial_graph(&sampled, &contours.cuts, &caps, &seeds, &skeleton::Settings::default(), &ctx)
        .map_err(|e| words(&e))?;
    let roles = Roles { graft: Some(points[0]), proximal: Some(points[1]), distal: Some(points[2]), flow_from: None };
    let settings = Settings { roles, ..Settings::default() };
    let m = measure_with_bands(&graph, &sampled, &contours.cuts, Some(&ensemble), &settings, &ctx)
        .map_err(|e| words(&e))?;
    let exact = truth.junction.expect("a junction").angles;
    let exact = [
        ("graft_proximal", exact.graft_proximal),
        ("graft_distal_planar", exact.graft_distal_planar),
        ("distal_normal", exact.distal_normal),
    ];
    let mut push = |name: &str, value: f64, exact: f64, band: [f64; 2]| {
        table.entry(name.to_owned()).or_default().push((value - exact, 0.5 * (band[1] - band[0])));
    };
    let mut worst = 0.0;
    for (name, exact) in exact {
        let angle = m.junctions.iter().flat_map(|j| &j.angles).find(|a| a.name == name).ok_or("no such angle")?;
        let value = angle.value_deg.ok_or("no value")?;
        worst = f64::max(worst, (value - exact).abs());
        push(name, value, exact, angle.band95_deg.ok_or("no band")?);
    }
    for (role, exact) in [Role::Graft, Role::Proximal, Role::Distal].into_iter().zip(branches) {
        let b = m.branches.iter().find(|b| b.role == role).ok_or("no such branch")?;
        let name = format!("diameter {}", role.name());
        push(&name, b.diameter_mm.ok_or("no diameter")?, 2.0 * exact.radius_mm, b.diameter_band95_mm.ok_or("no band")?);
        let clear = b.sections.iter().filter(|s| !s.open && !s.in_junction);
        for s in clear.step_by(8) {
            // where the branches blend into each other the truth is no circle
            let truth = exact.area_at((s.position - exact.from).dot(exact.direction));
            if let (Some(area), Some(error), Some(truth)) = (s.area_mm2, s.area_error_mm2, truth) {
                push("area % (sections)", 100.0 * (area / truth - 1.0), 0.0, [0.0, 2.0 * 196.0 * error / truth]);
            }
        }
    }
    Ok(worst)
}

/// The cap of a branch where its axis leaves the data.
fn cap(face_id: u32, branch: &phantom::BranchTruth, cuts: &[imaging::CutPlane]) -> Option<CapHint> {
    let d = branch.direction;
    let reach = |c: &imaging::CutPlane| {
        let speed = d.dot(c.outward);
        (speed > 1e-6).then(|| ((c.point - branch.from).dot(c.outward) / speed, c.outward))
    };
    let (t, normal) = cuts.iter().filter_map(reach).min_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(CapHint { face_id, centroid: branch.from + d * t, normal })
}
