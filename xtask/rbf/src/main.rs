//! The engine beside ferreus_rbf: cubic kernel, linear drift, no noise, fitted to 1e-6, same points, same flags.
//!
//! `rbf-peer ours|peer N [threads]` prints CPU seconds of the whole process, memory and the true residual. Each row is a
//! process of its own: `for n in 5000 10000 20000 50000; do for who in ours peer; do rbf-peer $who $n; done; done`.
//! Built with `cargo build --release --ignore-rust-version` in this folder (the peer asks for a newer compiler than it needs).

use exec::Ctx;
use ferreus_rbf::RBFInterpolator;
use ferreus_rbf::interpolant_config::{
    Drift, FittingAccuracy, FittingAccuracyType, InterpolantSettings, RBFKernelType,
};
use implicit::{Field, Method};
use space::P3;

const TOLERANCE: f64 = 1e-6;

/// Wall and interior points of a bent tube of varying section, as contours give them: f = 0 and f = 1 mm.
fn vessel(n: usize) -> (Vec<P3>, Vec<f64>) {
    let per_ring = ((n as f64 / 2.0).sqrt() * 0.9) as usize;
    let (mut points, mut values) = (Vec::with_capacity(n), Vec::with_capacity(n));
    for i in 0..n / 2 {
        let (ring, k) = (i / per_ring, i % per_ring);
        let t = ring as f64 * per_ring as f64 / (n as f64 / 2.0);
        let angle = (k as f64 + 0.618_033_988 * ring as f64) / per_ring as f64 * std::f64::consts::TAU;
        let radius = 3.0 + 0.5 * (7.0 * t).sin() + 0.2 * (3.0 * angle).sin();
        let (x0, z0) = (8.0 * (1.5 * t).sin(), 60.0 * t);
        for inside in [0.0, 1.0] {
            let r = radius - inside;
            points.push(P3::new(x0 + r * angle.cos(), r * angle.sin(), z0));
            values.push(inside);
        }
    }
    (points, values)
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let who = arguments.get(1).map_or("ours", String::as_str);
    let n: usize = arguments.get(2).and_then(|n| n.parse().ok()).unwrap_or(5000);
    let threads: usize = arguments.get(3).and_then(|n| n.parse().ok()).unwrap_or(1);
    let (points, values) = vessel(n);
    let ctx = Ctx::new(threads).expect("threads");
    let n = points.len();
    let start = std::time::Instant::now();
    let residual = match who {
        "ours" | "dense" => {
            let method = if who == "dense" { Method::Dense } else { Method::Iterative };
            let noise = vec![0.0; n];
            let (_, report) =
                implicit::interpolant(&points, (&values, &noise), TOLERANCE, method, &ctx).expect("fit");
            println!("{} iterations, condition {:.1e}", report.iterations, report.condition);
            report.residual_max
        }
        "oracle" => return oracle(&points, &values, &ctx),
        "sums" => return sums(&points, &values, &ctx),
        _ => peer(&points, &values),
    };
    println!("{who} n {n} residual {residual:.1e} wall {:.2} s {}", start.elapsed().as_secs_f64(), usage());
}

/// The peer's largest residual, by its own evaluator.
fn peer(points: &[P3], values: &[f64]) -> f64 {
    let n = points.len();
    let x = faer::Mat::from_fn(n, 3, |i, j| points[i].to_array()[j]);
    let y = faer::Mat::from_fn(n, 1, |i, _| values[i]);
    let settings = InterpolantSettings::builder(RBFKernelType::Cubic)
        .drift(Drift::Linear)
        .fitting_accuracy(FittingAccuracy { tolerance: TOLERANCE, tolerance_type: FittingAccuracyType::Absolute })
        .build();
    let mut fitted = RBFInterpolator::builder(x, y, settings).build();
    let at = fitted.evaluate_at_source(true);
    (0..n).fold(0.0_f64, |m, i| m.max((at[(i, 0)] - values[i]).abs()))
}

/// Coefficients against the dense oracle.
fn oracle(points: &[P3], values: &[f64], ctx: &Ctx) {
    let noise = vec![0.0; points.len()];
    let solve = |method, tolerance| {
        implicit::interpolant(points, (values, &noise), tolerance, method, ctx).expect("fit").1
    };
    let dense = solve(Method::Dense, 1.0);
    for tolerance in [1e-6, 1e-8, 1e-9] {
        let ours = solve(Method::Iterative, tolerance);
        let norm = dense.coefficients.iter().map(|c| c * c).sum::<f64>().sqrt();
        let off = dense.coefficients.iter().zip(&ours.coefficients).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        println!(
            "n {} tolerance {tolerance:e}: coefficients off by {:.1e} of their norm, {} iterations, conditions {:.2e} and {:.2e}",
            points.len(), off / norm, ours.iterations, ours.condition, dense.condition
        );
    }
}

/// Rates of the sums against the machine's square roots.
fn sums(points: &[P3], values: &[f64], ctx: &Ctx) {
    let noise = vec![1e-6; points.len()];
    let (f, _) = implicit::interpolant(points, (values, &noise), 1e-3, Method::Iterative, ctx).expect("fit");
    let roots = {
        let mut v = vec![1.5_f64; 1024];
        let start = std::time::Instant::now();
        let rounds = 200_000;
        pulp::Arch::new().dispatch(|| {
            for _ in 0..rounds {
                for x in &mut v {
                    *x = x.sqrt();
                }
                std::hint::black_box(&mut v);
            }
        });
        1024.0 * f64::from(rounds) / start.elapsed().as_secs_f64()
    };
    let targets: Vec<P3> = (0..4000).map(|i| P3::new(0.001 * i as f64, 0.3, 20.0)).collect();
    let pairs = (targets.len() * points.len()) as f64;
    let mut out = vec![0.0; targets.len()];
    let start = std::time::Instant::now();
    f.values(&targets, &mut out);
    let value = pairs / start.elapsed().as_secs_f64();
    let start = std::time::Instant::now();
    let sum = targets.iter().fold(0.0, |s, &t| s + f.gradient(t).0);
    let gradient = pairs / start.elapsed().as_secs_f64();
    println!(
        "roots {:.2} G/s, f {:.2} ({:.0} %), f and gradient {:.2} ({:.0} %) [{sum:.1}]",
        roots / 1e9, value / 1e9, 100.0 * value / roots, gradient / 1e9, 100.0 * gradient / roots
    );
}

/// CPU seconds and peak memory of this process.
fn usage() -> String {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let ticks: f64 = stat.split_whitespace().skip(13).take(2).filter_map(|t| t.parse::<f64>().ok()).sum();
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find(|l| l.starts_with("VmHWM")).unwrap_or_default().to_owned();
    format!("cpu {:.2} s {peak}", ticks / 100.0)
}
