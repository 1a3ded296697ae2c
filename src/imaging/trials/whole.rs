use super::scan::{Capsule, Noise, Scan, distance, fork};
use crate::{Axis, Contours, Error, Region, Report, Settings, Stack, contours};
use exec::Ctx;
use space::{Faulty, P3};

pub(super) fn run(stack: &Stack, settings: &Settings) -> Result<(Contours, Report), Error> {
    contours(stack, settings, &Ctx::new(2).unwrap())
}
pub(super) fn auto(scan: &Scan) -> (Contours, Report) {
    run(&scan.stack(), &Settings::default()).unwrap()
}
/// Root mean square and mean distance of the wall points from the vessels' true wall, away from the junction, mm.
pub(super) fn error(c: &Contours, vessels: &[Capsule], junction: [f64; 3]) -> (f64, f64) {
    let (mut sum, mut mean, mut n) = (0.0, 0.0, 0.0);
    for curve in &c.curves {
        for i in 0..60 {
            let p = curve.at(&c.planes[curve.plane], curve.length_mm() * f64::from(i) / 60.0);
            let q = p.position.to_array();
            let near = (0..3).map(|a| (q[a] - junction[a]).powi(2)).sum::<f64>() < 100.0;
            if p.on_border || near {
                continue;
            }
            let d = vessels.iter().map(|v| distance(v, q)).fold(f64::MAX, f64::min);
            sum += d * d;
            mean += d;
            n += 1.0;
        }
    }
    ((sum / n).sqrt(), mean / n)
}
pub(super) fn codes(r: &Report) -> Vec<&'static str> {
    r.warnings.iter().map(|w| w.code).collect()
}
const JUNCTION: [f64; 3] = [28.5, 28.5, 12.0];
/// Expected lumens of the fork: one below z = 16, two above 22.
fn forked(r: &Report) {
    for &(k, n) in &r.lumens {
        let z = k as f64 * 1.5;
        let want = if z < 16.0 { 1 } else { 2 };
        assert!(n == want || (16.0..23.0).contains(&z), "plane {k}: {n} lumens");
    }
    assert_eq!(r.lumens.len(), 24);
}

#[test]
fn a_fork_is_found_whole() {
    let scan = Scan::new(fork());
    let (c, r) = auto(&scan);
    forked(&r);
    assert_eq!((r.axis, c.tips.len(), c.cuts.len()), (Axis::Slice, 0, 2));
    assert!(r.warnings.is_empty(), "{:?}", r.warnings);
    let (rms, mean) = error(&c, &fork(), JUNCTION);
    println!("fork: rms {rms:.4} mean {mean:+.4} mm, psf {:?}", r.psf_sigma_px);
    // the bars of a disc of 5 px at SNR 20: .06 px rms, .6 % of area
    assert!(rms < 0.036 && mean.abs() < 0.009, "{rms} {mean}");
    assert!((r.psf_sigma_px.unwrap() - 0.6).abs() < 0.06, "{:?}", r.psf_sigma_px);
    assert!((r.threshold - 60.0).abs() < 1.0, "{}", r.threshold);
}

#[test]
fn distractors_bias_and_bright_tissue_change_nothing() {
    for seed in 0..6 {
        let mut vessels = fork();
        vessels.push(([12.0, 14.0, -10.0], [12.0, 14.0, 50.0], 3.5));
        vessels.push(([10.0, 44.0, -10.0], [12.0, 44.0, 50.0], 2.5));
        let tissue = [5.0, 20.0, 40.0, 50.0, 60.0, 20.0][seed as usize];
        let noise = [3.5, 5.0, 8.0, 5.0, 4.0, 12.0][seed as usize];
        let scan = Scan { tissue, bias: 0.3, noise, body: 27.0, seed, ..Scan::new(vessels) };
        let (c, r) = auto(&scan);
        let (rms, mean) = error(&c, &fork(), JUNCTION);
        let snr = (100.0 - tissue) / noise;
        println!(
            "tissue {tissue} contrast/noise {snr:.1}: rms {rms:.4} mean {mean:+.4} {:?} {:?}",
            codes(&r),
            r.psf_sigma_px
        );
        forked(&r);
        // area bias 2 r mean: 2 % at SNR 10 (issue B), less above
        let most = if snr < 10.0 { 0.03 } else { 0.015 };
        assert!(rms < 0.6 * (0.03 + 1.2 / snr) && mean.abs() < most, "{seed}: {rms} {mean}");
        assert!(!codes(&r).contains(&"segmentation.leak"));
    }
}

#[test]
fn a_fading_vessel_is_followed() {
    let scan = Scan { fade: 0.4, noise: 3.0, tissue: 10.0, ..Scan::new(fork()) };
    let (c, r) = auto(&scan);
    forked(&r);
    let (rms, mean) = error(&c, &fork(), JUNCTION);
    println!("fade: rms {rms:.4} mean {mean:+.4}");
    // SNR falls to 10: .138 px
    assert!(rms < 0.083 && mean.abs() < 0.02, "{rms} {mean}");
}

#[test]
fn noise_alone_is_refused() {
    for seed in 0..20 {
        for tissue in [0.0, 40.0] {
            let scan = Scan {
                tissue,
                body: 24.0,
                bias: 0.3,
                noise: 6.0,
                seed,
                ..Scan::new(vec![([-99.0; 3], [-98.0; 3], 1.0)])
            };
            let e = run(&scan.stack(), &Settings::default()).map(|(_, r)| r.lumens).unwrap_err();
            assert_eq!(e.code(), "segmentation.no_vessel", "{seed} {tissue}");
        }
    }
}

#[test]
fn black_images_are_refused() {
    let mut stack = Scan::new(fork()).stack();
    stack.pixels.fill(0.0);
    assert_eq!(run(&stack, &Settings::default()).unwrap_err().code(), "stack.uniform");
}

#[test]
fn a_gap_is_kept_and_said() {
    let stack = Scan::new(fork()).stack();
    let settings = Settings { exclude_slices: vec![5, 14], ..Settings::default() };
    let (c, r) = run(&stack, &settings).unwrap();
    // slice 14 is where the branches part
    assert_eq!(codes(&r), vec!["stack.gap", "stack.gap", "contours.junction_in_gap"]);
    assert_eq!((c.planes.len(), r.lumens.len(), c.tips.len()), (22, 22, 0));
    assert!((c.planes[5].origin.z() - 9.0).abs() < 1e-9);
    assert!(error(&c, &fork(), JUNCTION).0 < 0.036);
}

#[test]
fn a_branch_that_ends_inside_gives_a_tip() {
    let c0 = [28.5, 28.5, 10.0];
    let vessels = vec![([28.5, 28.5, -10.0], c0, 3.2), (c0, [26.0, 28.5, 50.0], 3.0), (c0, [42.5, 28.5, 24.0], 3.0)];
    let (c, r) = auto(&Scan::new(vessels.clone()));
    println!("{:?} {:?}", c.tips, r.lumens);
    assert!(!c.tips.is_empty());
    for t in &c.tips {
        let d = vessels.iter().map(|v| distance(v, t.position.to_array())).fold(f64::MAX, f64::min);
        // between two slices 1.5 mm apart
        assert!(d.abs() < 0.9 && t.outward.z() > 0.99, "{t:?} {d}");
    }
}

#[test]
fn a_lumen_at_the_image_border_is_closed_along_it() {
    let c0 = [28.5, 28.5, 16.0];
    let vessels = vec![([28.5, 28.5, -10.0], c0, 3.2), (c0, [28.5, 28.5, 50.0], 3.0), (c0, [80.0, 28.5, 21.0], 3.0)];
    let settings = Settings { axis: Some(Axis::Slice), ..Settings::default() };
    let (c, r) = run(&Scan::new(vessels.clone()).stack(), &settings).unwrap();
    assert_eq!(c.cuts.len(), 3, "{:?} {:?}", c.cuts, r.lumens);
    let side = c.cuts.iter().find(|k| k.outward.x() > 0.99).unwrap();
    assert!((side.point.x() - 57.0).abs() < 1e-9);
    let on: Vec<_> = c.curves.iter().filter(|k| !k.border.is_empty()).collect();
    assert!(on.len() >= 3);
    let (rms, _) = error(&c, &vessels, c0);
    println!("border: rms {rms:.4} tips {}", c.tips.len());
    assert!(rms < 0.35, "{rms}");
}

/// The fork with x and z exchanged on a nearly isotropic lattice.
fn lying() -> Scan {
    let turn = |p: [f64; 3]| [p[2], p[1] - 8.0, p[0] - 8.0];
    let vessels = fork().into_iter().map(|(a, b, r)| (turn(a), turn(b), r)).collect();
    Scan { n: [64, 64, 56], step: [0.6, 0.6, 0.8], ..Scan::new(vessels) }
}

#[test]
fn contours_are_drawn_across_the_axis_that_the_vessel_follows() {
    let scan = lying();
    let (c, r) = auto(&scan);
    assert_eq!(r.axis, Axis::Column);
    let (rms, mean) = error(&c, &scan.vessels, [12.0, 20.5, 20.5]);
    println!("lying: rms {rms:.4} mean {mean:+.4} {:?} {:?} cuts {}", codes(&r), r.psf_sigma_px, c.cuts.len());
    assert!(rms < 0.05 && mean.abs() < 0.02, "{rms} {mean}");
    for p in &c.planes {
        assert!((p.normal() - space::V3::X).length() < 1e-12);
    }
}

#[test]
fn seeds_and_regions_choose_the_vessel() {
    let mut vessels = fork();
    vessels.push(([12.0, 14.0, -10.0], [12.0, 14.0, 50.0], 3.5));
    let stack = Scan::new(vessels).stack();
    let near = |c: &Contours| c.curves[0].at(&c.planes[0], 0.0).position.distance(P3::new(12.0, 14.0, 0.0)) < 4.0;
    let seeds = Settings { seeds: vec![P3::new(12.0, 14.0, 15.0)], ..Settings::default() };
    let (c, r) = run(&stack, &seeds).unwrap();
    assert!(near(&c) && r.lumens.iter().all(|l| l.1 == 1));
    let region = Region { slice: 20, centre_px: [20.0, 23.3], radius_px: 8.0 };
    assert!(near(&run(&stack, &Settings { region: Some(region), ..Settings::default() }).unwrap().0));
    let outside = Settings { seeds: vec![P3::new(45.0, 10.0, 3.0)], ..Settings::default() };
    let e = run(&stack, &outside).unwrap_err();
    assert_eq!(e.code(), "segmentation.seed_outside");
    assert!(e.place().position.is_some());
}

#[test]
fn a_given_threshold_is_the_level_everywhere() {
    let settings = Settings { threshold: Some(50.0), ..Settings::default() };
    let (c, r) = run(&Scan::new(fork()).stack(), &settings).unwrap();
    assert_eq!(r.threshold, 50.0);
    assert!(c.curves.iter().all(|k| (k.level - 50.0).abs() < 1e-6));
    forked(&r);
}

#[test]
fn two_alike_vessels_are_said() {
    let vessels = vec![([15.0, 28.0, -9.0], [15.0, 28.0, 50.0], 3.0), ([42.0, 28.0, -9.0], [42.0, 28.0, 50.0], 3.0)];
    let (_, r) = auto(&Scan::new(vessels));
    assert!(codes(&r).contains(&"segmentation.ambiguous"));
    assert_eq!(r.candidates.len(), 2);
}

#[test]
fn curves_run_with_the_lumen_on_their_left() {
    let (c, _) = auto(&Scan::new(fork()));
    for k in &c.curves {
        assert!(k.spline.area() > 0.0 && !k.hole);
        for i in 0..40 {
            let d = k.spline.derivatives(k.length_mm() * f64::from(i) / 40.0)[1];
            assert!((d[0].hypot(d[1]) - 1.0).abs() < 0.01, "{} {:?} {}", k.plane, d, k.spline.knots());
        }
    }
}

#[test]
fn one_and_three_threads_give_the_same_bits() {
    let stack = Scan { seed: 7, bias: 0.2, ..Scan::new(fork()) }.stack();
    let bits = |threads| {
        let (c, r) = contours(&stack, &Settings::default(), &Ctx::new(threads).unwrap()).unwrap();
        let mut out: Vec<u64> = vec![r.threshold.to_bits(), r.psf_sigma_px.unwrap().to_bits()];
        for k in &c.curves {
            out.extend(k.spline.derivatives(1.0).iter().flatten().map(|x| x.to_bits()));
        }
        out
    };
    let one = bits(1);
    assert!(one == bits(2) && one == bits(3));
}

#[test]
fn cancelled_work_says_so() {
    let ctx = Ctx::new(2).unwrap();
    ctx.cancel();
    let e = contours(&Scan::new(fork()).stack(), &Settings::default(), &ctx).unwrap_err();
    assert_eq!(e.code(), "cancelled");
}

#[test]
fn random_values_without_structure_are_refused() {
    let mut n = Noise::new(5);
    let mut stack = Scan::new(fork()).stack();
    stack.pixels.iter_mut().for_each(|p| *p = (100.0 * n.uniform()) as f32);
    assert_eq!(run(&stack, &Settings::default()).unwrap_err().code(), "segmentation.no_vessel");
}

#[test]
fn the_point_spread_is_read_from_the_edges() {
    for noise in [0.3, 2.0, 5.0] {
        let tube = vec![([28.5, 28.5, -10.0], [30.0, 29.5, 50.0], 4.0)];
        let (c, r) = auto(&Scan { noise, ..Scan::new(tube.clone()) });
        let sigma = r.psf_sigma_px.unwrap();
        println!("noise {noise}: psf {sigma:.4} {:?} {:?}", error(&c, &tube, [0.0; 3]), r.threshold);
        assert!((sigma - 0.6).abs() < 0.06, "{noise} {sigma}");
    }
}
