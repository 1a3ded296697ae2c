//! The fitted wall against the truth of simulated scans: mean and rms offset of f = 0, area bias per branch.
//!
//! `cargo run -p implicit --example accuracy -- tubes|demo|steps [seeds]`. Area bias is the mean relative radius error
//! over the branch times two; wall points nearer than 2.5 radii to the junction or 3 mm to the ends are left out.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use exec::Ctx;
use imaging::Contours;
use implicit::{Field, Settings, Variational, foot};
use phantom::{Kind, Scene, Truth};
use space::P3;

/// Points of f = 0: feet of contour points and of points half a plane distance before them.
fn wall(f: &Variational, contours: &Contours, ctx: &Ctx) -> Vec<P3> {
    let planes = &contours.planes;
    let half = (planes[1].origin - planes[0].origin) * 0.5;
    let starts: Vec<P3> = contours
        .curves
        .iter()
        .flat_map(|c| (0..48).map(move |k| (c, k)))
        .map(|(c, k)| c.at(&planes[c.plane], c.length_mm() * f64::from(k) / 48.0))
        .filter(|p| !p.on_border)
        .flat_map(|p| [p.position, p.position + half])
        .filter(|p| contours.cuts.iter().all(|c| (*p - c.point).dot(c.outward) < -3.0))
        .collect();
    ctx.map(&starts, |&p| foot(f, p, 1.5)).unwrap().into_iter().flatten().collect()
}

/// (role, mean offset, rms offset, area bias in percent) of every branch; offsets outward in mm.
fn branches(points: &[P3], truth: &Truth, scene: &Scene) -> Vec<(&'static str, f64, f64, f64)> {
    let near = |b: &phantom::BranchTruth, p: P3| {
        let s = (p - b.from).dot(b.direction);
        ((p - (b.from + b.direction * s)).length() - b.radius_mm).abs() < 0.8
            && s > if truth.junction.is_some() { 4.0 * b.radius_mm } else { 0.0 }
    };
    truth
        .branches
        .iter()
        .map(|b| {
            let offsets: Vec<f64> =
                points.iter().filter(|&&p| near(b, p)).map(|&p| -scene.vessel.distance(p)).collect();
            let n = offsets.len() as f64;
            let mean = offsets.iter().sum::<f64>() / n;
            let rms = (offsets.iter().map(|o| o * o).sum::<f64>() / n).sqrt();
            (b.role.name(), mean, rms, 100.0 * ((1.0 + mean / b.radius_mm).powi(2) - 1.0))
        })
        .collect()
}

fn row(label: &str, kind: Kind, scan: &phantom::Settings, known: (bool, Option<f64>), fit: &Settings, ctx: &Ctx) {
    let scene = Scene::new(kind, scan).unwrap();
    let mut stack = scene.image(ctx).unwrap();
    if !known.0 {
        stack.thickness_mm = None;
    }
    let settings = imaging::Settings { psf_sigma_px: known.1, ..imaging::Settings::default() };
    let (contours, report) = imaging::contours(&stack, &settings, ctx).unwrap();
    let start = std::time::Instant::now();
    let (f, fitted) = match implicit::fit(&contours, fit, ctx) {
        Ok(fit) => fit,
        Err(e) => return println!("{label}: {e}"),
    };
    let seconds = start.elapsed().as_secs_f64();
    let points = wall(&f, &contours, ctx);
    print!(
        "{label}: n {} it {} {seconds:.1} s psf {:.2}",
        fitted.constraints,
        fitted.iterations,
        report.psf_sigma_px.unwrap_or(f64::NAN)
    );
    for (role, mean, rms, area) in branches(&points, &scene.truth, &scene) {
        print!("  {role} {mean:+.4} rms {rms:.4} area {area:+.2} %");
    }
    println!("  level {:.1} of {:.1}", report.threshold, scene.truth.half_level);
    shifts(&contours, &f, &scene);
}

/// Means over contour points: offset of the contour from the truth, the planar shift in it along the true normal, the
/// shift in space by the fitted function and by the truth.
fn shifts(contours: &Contours, f: &Variational, scene: &Scene) {
    let Some(blur) = contours.blur else { return };
    let mut sums = [0.0; 5];
    for c in &contours.curves {
        let plane = &contours.planes[c.plane];
        for k in 0..32 {
            let p = c.at(plane, c.length_mm() * f64::from(k) / 32.0);
            if p.on_border || contours.cuts.iter().any(|c| (p.position - c.point).dot(c.outward) > -6.0) {
                continue;
            }
            let drawn = p.position + p.inward * blur.planar_shift_mm(plane, &p);
            let shift = |f: &dyn Fn(P3) -> (f64, space::V3, space::DMat3)| {
                let (value, gradient, _) = f(drawn);
                let level = blur.half_maximum_level(drawn, f).unwrap();
                ((value - level) / gradient.length(), gradient.normalised().unwrap())
            };
            let (ours, _) = shift(&|x| f.hessian(x));
            let (true_shift, n) = shift(&|x| scene.vessel.hessian(x));
            let planar = blur.planar_shift_mm(plane, &p) * p.inward.dot(n);
            let offset = -scene.vessel.distance(p.position);
            for (s, v) in sums.iter_mut().zip([1.0, offset, planar, ours, true_shift]) {
                *s += v;
            }
        }
    }
    let [n, offset, planar, ours, exact] = sums;
    println!(
        "    contours {:+.4}, planar shift {:.4}, spatial {:.4}, exact {:.4}",
        offset / n,
        planar / n,
        ours / n,
        exact / n
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let what = arguments.get(1).map_or("tubes", String::as_str);
    let seeds: u64 = arguments.get(2).and_then(|s| s.parse().ok()).unwrap_or(3);
    let ctx = Ctx::new(2).unwrap();
    let fit = Settings::default();
    match what {
        "tubes" => tubes(&fit, &ctx),
        "demo" => (1..=seeds).for_each(|seed| {
            let scan = phantom::Settings { seed, ..phantom::Settings::of(Kind::Anastomosis) };
            row(&format!("demo {seed}"), Kind::Anastomosis, &scan, (true, None), &fit, &ctx);
        }),
        _ => steps(seeds, &ctx),
    }
}

/// Noise-free tubes turned against the slices, thickness known.
fn tubes(fit: &Settings, ctx: &Ctx) {
    for thickness_mm in [3.0, 1.5, 0.0] {
        for tilt_deg in [45.0, 60.0, 30.0, 0.0] {
            let scan = phantom::Settings {
                thickness_mm,
                tilt_deg,
                columns: 120,
                rows: 120,
                slices: 36,
                slice_spacing_mm: 1.5,
                tube_radius_mm: 3.6,
                snr: None,
                bias: 0.0,
                texture: 0.0,
                distractors: 0,
                ..phantom::Settings::of(Kind::Tube)
            };
            row(&format!("{thickness_mm} mm {tilt_deg} deg"), Kind::Tube, &scan, (true, Some(0.6)), fit, ctx);
        }
    }
}

/// Error against the number of constraints.
fn steps(seeds: u64, ctx: &Ctx) {
    for seed in 1..=seeds {
        for step in [0.5, 0.7, 1.0, 1.5, 2.0, 3.0] {
            let fit = Settings { step, ..Settings::default() };
            let scan = phantom::Settings { seed, ..phantom::Settings::of(Kind::Anastomosis) };
            row(&format!("seed {seed} step {step}"), Kind::Anastomosis, &scan, (true, None), &fit, ctx);
        }
    }
}
