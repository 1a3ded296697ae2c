//! Discs and peanuts blurred by .6 px and area-sampled: error of the contour against the true wall.

use super::scan::Noise;
use crate::PeriodicSpline;
use crate::march::{Lattice, zero_lines};
use crate::smooth::{corrected, smoothed};

const N: usize = 40;

/// Area-sampled, blurred image of {d < 0}: 5 x 5 sub-samples and a sampled Gaussian of .6 px.
fn image(d: impl Fn(f64, f64) -> f64) -> Vec<f64> {
    let m = 8;
    let fine = N * m;
    let mut a: Vec<f64> = (0..fine * fine)
        .map(|k| {
            let p = |i: usize| (i as f64 + 0.5) / m as f64 - 0.5;
            (0.5 - d(p(k % fine), p(k / fine)) * m as f64).clamp(0.0, 1.0)
        })
        .collect();
    let r = 16;
    let w: Vec<f64> = (-r..=r).map(|i: i32| (-0.5 * (f64::from(i) / (0.6 * m as f64)).powi(2)).exp()).collect();
    let sum: f64 = w.iter().sum();
    for stride in [1, fine] {
        let src = a.clone();
        for (k, o) in a.iter_mut().enumerate() {
            let at = (k / stride % fine) as i32;
            let tap = |i: i32| {
                let q = (at + i).clamp(0, fine as i32 - 1);
                src[(k as i64 + i64::from(q - at) * stride as i64) as usize]
            };
            *o = (-r..=r).map(|i| w[(i + r) as usize] * tap(i)).sum::<f64>() / sum;
        }
    }
    (0..N * N)
        .map(|k| {
            let (x, y) = (k % N * m, k / N * m);
            (0..m * m).map(|q| a[(y + q / m) * fine + x + q % m]).sum::<f64>() / (m * m) as f64
        })
        .collect()
}

/// The corrected contour of one noisy image, level known.
fn contour(image: &[f64], snr: f64, seed: u64) -> (PeriodicSpline, f64) {
    let mut noise = Noise::new(seed);
    let values: Vec<f32> = image.iter().map(|v| (v + noise.gauss() / snr - 0.5) as f32).collect();
    let xs: Vec<f64> = (0..N).map(|i| i as f64).collect();
    let lines = zero_lines(&Lattice { xs: &xs, ys: &xs, values: &values });
    let line = lines.into_iter().max_by(|a, b| a.area().total_cmp(&b.area())).unwrap();
    let fit = smoothed(&line);
    let v = 0.36 + 1.0 / 12.0 + 1.0 / 18.0;
    (corrected(&fit.spline, [v, v]), fit.standard_error)
}

fn off(s: &PeriodicSpline, d: impl Fn(f64, f64) -> f64) -> f64 {
    let n = 400;
    let at = |i: usize| s.derivatives(s.length() * i as f64 / n as f64)[0];
    (0..n).map(|i| d(at(i)[0], at(i)[1]).powi(2)).sum::<f64>() / n as f64
}

#[test]
fn discs_are_as_exact_as_their_noise_allows() {
    let bars = [[0.138, 0.060, 0.045], [0.115, 0.052, 0.033], [0.105, 0.045, 0.036]];
    let mut worst: f64 = 0.0;
    let mut standardised = Vec::new();
    for (radius, bars) in [5.0, 7.5, 10.0].into_iter().zip(bars) {
        for (snr, bar) in [10.0, 20.0, 30.0].into_iter().zip(bars) {
            let (mut sum, mut area, mut se) = (0.0, 0.0, 0.0);
            for seed in 0..20 {
                let mut n = Noise::new(1000 + seed);
                let (cx, cy) = (19.5 + n.uniform(), 19.5 + n.uniform());
                let d = |x: f64, y: f64| (x - cx).hypot(y - cy) - radius;
                let (s, e) = contour(&image(d), snr, seed);
                sum += off(&s, d) / 20.0;
                se += e * e / 20.0;
                area += (s.area() / (std::f64::consts::PI * radius * radius) - 1.0) / 20.0;
            }
            println!(
                "r {radius} snr {snr}: rms {:.4} (bar {bar}) se {:.4} area {:+.3} %",
                sum.sqrt(),
                se.sqrt(),
                100.0 * area
            );
            worst = worst.max(sum.sqrt() / bar);
            standardised.push(sum / se);
        }
    }
    assert!(worst <= 1.0, "{worst}");
    // the stated standard error is the true one: squared errors over their stated variance are 1 on average
    let mean = standardised.iter().sum::<f64>() / standardised.len() as f64;
    println!("standardised variance: mean {mean:.3}, {standardised:.2?}");
    assert!((0.85..1.15).contains(&mean), "{mean}");
    assert!(standardised.iter().all(|v| (0.7..1.45).contains(v)), "{standardised:?}");
}

#[test]
fn the_small_disc_keeps_its_area() {
    let mut area = 0.0;
    for seed in 0..20 {
        let mut n = Noise::new(1000 + seed);
        let (cx, cy) = (19.5 + n.uniform(), 19.5 + n.uniform());
        let (s, _) = contour(&image(|x, y| (x - cx).hypot(y - cy) - 5.0), 20.0, seed);
        area += (s.area() / (std::f64::consts::PI * 25.0) - 1.0) / 20.0;
    }
    assert!(area.abs() <= 0.006, "{area}");
}

#[test]
fn peanuts_keep_their_waist() {
    let mut worst: f64 = 0.0;
    for (radius, bar) in [(5.0, 0.080), (7.5, 0.072), (10.0, 0.068)] {
        let (mut sum, mut se) = (0.0, 0.0);
        for seed in 0..20 {
            let mut n = Noise::new(2000 + seed);
            let (cx, cy, a) = (19.5 + n.uniform(), 19.5 + n.uniform(), std::f64::consts::TAU * n.uniform());
            // two discs of .6 radius, .5 radius from the middle, smoothly joined
            let d = |x: f64, y: f64| {
                let (x, y) = (x - cx, y - cy);
                let one =
                    |s: f64| (x - s * 0.5 * radius * a.cos()).hypot(y - s * 0.5 * radius * a.sin()) - 0.6 * radius;
                let (p, q, k) = (one(1.0), one(-1.0), 0.4 * radius);
                let h = (k - (p - q).abs()).max(0.0) / k;
                p.min(q) - k * h * h * h / 6.0
            };
            let (s, e) = contour(&image(d), 20.0, seed);
            sum += off(&s, d) / 20.0;
            se += e * e / 20.0;
        }
        println!("peanut {radius}: rms {:.4} (bar {bar}), standardised variance {:.2}", sum.sqrt(), sum / se);
        worst = worst.max(sum.sqrt() / bar);
    }
    assert!(worst <= 1.0, "{worst}");
}

#[test]
fn the_blur_of_a_disc_is_read_from_its_pixels() {
    let d = |x: f64, y: f64| (x - 20.2).hypot(y - 19.7) - 7.5;
    // distances are counted from the half-maximum contour, (.36 + 1/12) / (2 r) inside the wall
    let shift = (0.36 + 1.0 / 12.0) / 15.0;
    let profile = image(d)
        .iter()
        .enumerate()
        .map(|(k, v)| (-d((k % N) as f64, (k / N) as f64) - shift, *v))
        .filter(|(d, _)| d.abs() < 2.0)
        .collect();
    let s = crate::smooth::blur(&profile, 0.1, 3.0).unwrap();
    println!("blur {s:.4}, sigma {:.4}", (s * s - 1.0 / 12.0).sqrt());
    assert!((s * s - 0.36 - 1.0 / 12.0).abs() < 0.02, "{s}");
}
