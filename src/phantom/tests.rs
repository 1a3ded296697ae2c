//! Tests of whole scans: volumes, noise, truth, determinism.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use crate::{Axis, Body, Error, Kind, Levels, Role, Scene, Settings, scan};
use exec::Ctx;
use imaging::Stack;
use space::{FaultKind, Faulty, P3, V3};
use std::f64::consts::PI;

fn ctx() -> Ctx {
    Ctx::new(2).unwrap()
}

/// No noise, bias, texture or unrelated vessels; tissue up to the border.
fn plain(kind: Kind) -> Settings {
    Settings {
        snr: None,
        bias: 0.0,
        texture: 0.0,
        distractors: 0,
        body: Body::FillsImage,
        levels: Levels { lumen: 4000.0, tissue: 100.0, ..Levels::default() },
        ..Settings::of(kind)
    }
}

fn small(kind: Kind) -> Settings {
    let base = Settings::of(kind);
    Settings { columns: 128, rows: 128, pixel_mm: 1.0, slices: 22, slice_spacing_mm: 3.0, thickness_mm: 3.0, ..base }
}

fn bits(stack: &Stack) -> Vec<u32> {
    stack.pixels.iter().map(|v| v.to_bits()).collect()
}

fn mean_and_sd(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt())
}

/// Sum of the lumen fractions times the voxel's volume, mm3.
fn lumen_volume(stack: &Stack, s: &Settings) -> f64 {
    let l = &s.levels;
    let sum: f64 = stack.pixels.iter().map(|&v| (f64::from(v) - l.tissue) / (l.lumen - l.tissue)).sum();
    sum * s.pixel_mm * s.pixel_mm * s.thickness_mm
}

#[test]
fn the_volume_of_a_tube_is_exact_at_any_tilt() {
    for tilt_deg in [0.0, 30.0, 45.0, 60.0, 75.0] {
        let s = Settings { columns: 320, rows: 128, slices: 20, tilt_deg, spin_deg: 0.0, ..plain(Kind::Tube) };
        let (stack, _) = scan(Kind::Tube, &s, &ctx()).unwrap();
        let height = s.slices as f64 * s.slice_spacing_mm;
        let exact = PI * s.tube_radius_mm.powi(2) * height / tilt_deg.to_radians().cos();
        let ratio = lumen_volume(&stack, &s) / exact;
        eprintln!("tube tilted by {tilt_deg}: {ratio}");
        assert!((ratio - 1.0).abs() < 1e-3, "tilt {tilt_deg}: volume ratio {ratio}");
    }
}

#[test]
fn a_tube_within_the_slices_has_its_exact_area_in_every_image_column() {
    let s = Settings { columns: 96, rows: 64, slices: 10, tilt_deg: 90.0, spin_deg: 0.0, ..plain(Kind::Tube) };
    let (stack, truth) = scan(Kind::Tube, &s, &ctx()).unwrap();
    let ratio = lumen_volume(&stack, &s) / (PI * s.tube_radius_mm.powi(2) * 96.0 * s.pixel_mm);
    assert!((ratio - 1.0).abs() < 1e-3, "volume ratio {ratio}");
    assert!((truth.branches[0].length_mm - 95.0 * s.pixel_mm).abs() < 1e-6);
}

#[test]
fn the_volumes_of_sphere_and_helix_are_exact() {
    let s = Settings { columns: 48, rows: 48, slices: 12, ..plain(Kind::Sphere) };
    let (stack, _) = scan(Kind::Sphere, &s, &ctx()).unwrap();
    let ratio = lumen_volume(&stack, &s) / (4.0 / 3.0 * PI * 27.0);
    assert!((ratio - 1.0).abs() < 1e-3, "sphere: {ratio}");
    // Pappus: the slab cuts the same volume from every turn's rise, area x arc length = pi r^2 h c / b.
    let s = Settings { columns: 160, rows: 160, slices: 20, ..plain(Kind::Helix) };
    let (stack, truth) = scan(Kind::Helix, &s, &ctx()).unwrap();
    let h = truth.helix.unwrap();
    let b = h.pitch_mm / (2.0 * PI);
    let exact = PI * 9.0 * 30.0 * h.radius_mm.hypot(b) / b;
    let ratio = lumen_volume(&stack, &s) / exact;
    assert!((ratio - 1.0).abs() < 1e-3, "helix: {ratio}");
    assert!((h.radius_mm / (h.radius_mm.powi(2) + b * b) - 0.049).abs() < 1e-12);
    assert!((b / (h.radius_mm.powi(2) + b * b) - 0.033).abs() < 1e-12);
}

#[test]
fn signal_to_noise_is_what_was_asked_for() {
    for snr in [10.0, 20.0] {
        let s = Settings {
            snr: Some(snr),
            tube_radius_mm: 8.0,
            bias: 0.0,
            texture: 0.0,
            distractors: 0,
            body: Body::FillsImage,
            slices: 12,
            ..Settings::of(Kind::Tube)
        };
        let scene = Scene::new(Kind::Tube, &s).unwrap();
        let stack = scene.image(&ctx()).unwrap();
        let (mut lumen, mut tissue) = (Vec::new(), Vec::new());
        for (n, &v) in stack.pixels.iter().enumerate() {
            let (k, rest) = (n / (256 * 256), n % (256 * 256));
            let f = scene.vessel.distance(stack.position(k, (rest / 256) as f64, (rest % 256) as f64));
            if f > 2.5 {
                lumen.push(f64::from(v));
            } else if f < -2.5 {
                tissue.push(f64::from(v));
            }
        }
        let ((a, sd), (b, _)) = (mean_and_sd(&lumen), mean_and_sd(&tissue));
        let measured = (a - b) / sd;
        assert!((measured / snr - 1.0).abs() < 0.03, "SNR {measured} for {snr}");
    }
}

#[test]
fn air_has_the_mean_and_spread_of_a_rayleigh_distribution() {
    let s = Settings { slices: 4, distractors: 0, shift_mm: [0.0; 3], ..Settings::of(Kind::Tube) };
    let (stack, truth) = scan(Kind::Tube, &s, &ctx()).unwrap();
    // The image's corners, well outside the ellipse.
    let corner = (0..stack.slices()).flat_map(|k| (0..20).map(move |r| (k, r)));
    let air: Vec<f64> =
        corner.flat_map(|(k, r)| stack.slice(k)[r * 256..r * 256 + 40].iter().map(|&v| f64::from(v))).collect();
    let (mean, sd) = mean_and_sd(&air);
    let sigma = truth.noise_sigma;
    assert!((sigma - (1000.0 - 230.0) / 20.0).abs() < 1e-12);
    // Sheppard's correction for rounding is below .1 % at this sigma.
    assert!((mean / (sigma * (PI / 2.0).sqrt()) - 1.0).abs() < 0.03, "mean {mean}");
    assert!((sd / (sigma * (2.0 - PI / 2.0).sqrt()) - 1.0).abs() < 0.05, "sd {sd}");
}

#[test]
fn the_bytes_do_not_depend_on_threads_and_do_on_the_seed() {
    let s = small(Kind::Anastomosis);
    let one = scan(Kind::Anastomosis, &s, &Ctx::new(1).unwrap()).unwrap();
    for threads in [2, 3] {
        let other = scan(Kind::Anastomosis, &s, &Ctx::new(threads).unwrap()).unwrap();
        assert!(bits(&one.0) == bits(&other.0) && one.1 == other.1);
    }
    let other = scan(Kind::Anastomosis, &Settings { seed: 2, ..s }, &ctx()).unwrap();
    let equal = bits(&one.0).iter().zip(bits(&other.0)).filter(|(a, b)| **a == *b).count();
    assert!(equal < one.0.pixels.len() / 20, "{equal} pixels equal");
}

#[test]
fn pixels_are_whole_numbers_of_twelve_bits() {
    let s = Settings { levels: Levels { lumen: 4095.0, ..Levels::default() }, ..small(Kind::Anastomosis) };
    let (stack, _) = scan(Kind::Anastomosis, &s, &ctx()).unwrap();
    assert!(stack.pixels.iter().all(|&v| v == v.round() && (0.0..=4095.0).contains(&v)));
    assert!(stack.pixels.contains(&4095.0));
}

#[test]
fn missing_slices_leave_the_others_where_and_what_they_were() {
    let whole = small(Kind::Anastomosis);
    let gap = Settings { missing_slices: vec![8, 9, 9], ..whole.clone() };
    let (a, _) = scan(Kind::Anastomosis, &whole, &ctx()).unwrap();
    let (b, truth) = scan(Kind::Anastomosis, &gap, &ctx()).unwrap();
    assert_eq!(truth.missing_slices, vec![8, 9]);
    assert_eq!(b.slices(), a.slices() - 2);
    assert!((b.offset_mm(8) - b.offset_mm(7) - 9.0).abs() < 1e-9);
    for k in 0..b.slices() {
        let original = if k < 8 { k } else { k + 2 };
        assert_eq!(b.origins[k], a.origins[original]);
        assert!(b.slice(k) == a.slice(original));
    }
}

#[test]
fn truth_lies_in_the_patient_where_the_image_is_bright() {
    for oblique_deg in [[0.0; 3], [20.0, -10.0, 5.0]] {
        let s = Settings { oblique_deg, snr: None, bias: 0.0, ..Settings::of(Kind::Anastomosis) };
        let (stack, truth) = scan(Kind::Anastomosis, &s, &ctx()).unwrap();
        let j = truth.junction.clone().unwrap();
        let mut points = vec![j.axes_point, j.graft_point, j.proximal_point, j.distal_point];
        points.extend(truth.branches.iter().map(|b| b.to));
        points.extend(truth.distractors.iter().flat_map(|d| d.ends));
        for p in points {
            let slice = (0..stack.slices())
                .min_by(|&a, &b| {
                    let off = |k: usize| (p - stack.origins[k]).dot(stack.normal()).abs();
                    off(a).total_cmp(&off(b))
                })
                .unwrap();
            let d = p - stack.origins[slice];
            let column = (d.dot(stack.row_direction) / 0.5).round() as usize;
            let row = (d.dot(stack.column_direction) / 0.5).round() as usize;
            let grey = stack.slice(slice)[row * stack.columns + column];
            assert!(grey > 900.0, "{p:?} holds {grey}");
        }
        let length = (stack.row_direction.length(), stack.row_direction.dot(stack.column_direction));
        assert!((length.0 - 1.0).abs() < 1e-12 && length.1.abs() < 1e-12);
    }
}

#[test]
fn angles_agree_with_the_branches_end_points_by_another_way() {
    for kind in (0..40).map(Kind::Random).chain([Kind::Anastomosis, Kind::Trifurcation]) {
        let s = Settings { distractors: 0, oblique_deg: [11.0, 23.0, -31.0], ..Settings::of(kind) };
        let truth = Scene::new(kind, &s).unwrap().truth;
        let j = truth.junction.clone().unwrap();
        let to = |role| truth.branch(role).unwrap().to - j.axes_point;
        let (g, p, d) = (to(Role::Graft), to(Role::Proximal), to(Role::Distal));
        let cosine = |a: V3, b: V3| (a.dot(b) / (a.length() * b.length())).acos().to_degrees();
        // Planar part by coordinates: x along the graft, y at a right angle in the plane, z the normal.
        let x = g / g.length();
        let y = p - x * p.dot(x);
        let y = y / y.length();
        let z = p.cross(g) / p.cross(g).length();
        let planar = d.dot(y).abs().atan2(d.dot(x)).to_degrees();
        let want =
            [cosine(g, p), planar, 90.0 - (d.dot(z) / d.length()).asin().to_degrees(), cosine(p, d), cosine(g, d)];
        for ((name, value), want) in j.angles.named().into_iter().zip(want) {
            assert!((value - want).abs() < 1e-6, "{} {name}: {value} against {want}", truth.kind);
        }
        // The turned shape keeps the angles that it was asked for.
        let b = s.bifurcation;
        assert!((j.angles.graft_proximal - b.graft_deg).abs() < 1e-9);
        assert!((j.angles.distal_normal - (90.0 - b.distal_out_deg)).abs() < 1e-9);
        let asked = if b.distal_planar_deg > 180.0 { 360.0 - b.distal_planar_deg } else { b.distal_planar_deg };
        assert!((j.angles.graft_distal_planar - asked).abs() < 1e-9);
    }
}

#[test]
fn the_demo_has_room_for_the_angle_windows() {
    let scene = Scene::new(Kind::Anastomosis, &Settings::default()).unwrap();
    let diameter = 5.0;
    for b in &scene.truth.branches {
        assert!(b.length_mm > 4.5 * diameter, "{:?} {}", b.role, b.length_mm);
        let from = b.circular_from_mm.unwrap();
        eprintln!("{:?}: length {:.1}, circular from {from:.2}", b.role, b.length_mm);
        assert!(from < 2.8 * diameter);
        assert_eq!(b.area_at(from - 0.1), None);
        assert!((b.area_at(from + 1.0).unwrap() - PI * b.radius_mm.powi(2)).abs() < 1e-12);
        // It leaves through an end slice, not through the image's side.
        let s = &scene.settings;
        let w = (b.to - s.centre_mm).dot(V3::Z).abs();
        assert!((w - 0.5 * (s.slices as f64 - 1.0) * s.slice_spacing_mm).abs() < 1e-6);
    }
    let angles = scene.truth.junction.unwrap().angles.named();
    for (i, a) in angles.iter().enumerate() {
        assert!(angles[..i].iter().all(|b| (a.1 - b.1).abs() > 0.5), "{angles:?} are all different");
    }
}

#[test]
fn unrelated_vessels_touch_nothing() {
    let mut worst = f64::INFINITY;
    for kind in (0..20).map(Kind::Random).chain([Kind::Anastomosis, Kind::Helix, Kind::Trifurcation, Kind::Tube]) {
        let s = Settings { distractors: 3, ..Settings::of(kind) };
        let scene = Scene::new(kind, &s).unwrap();
        assert_eq!(scene.truth.distractors.len(), 3);
        for (i, d) in scene.truth.distractors.iter().enumerate() {
            assert!(d.clearance_mm >= 6.0);
            // By the walls' own points, for all pairs.
            let [a, b] = d.ends;
            let n = 60;
            for k in 0..=n {
                let guess = a.lerp(b, f64::from(k) / f64::from(n));
                let p = P3::from_raw(d.tube.axis.foot(guess.raw()).point);
                let others = scene.truth.distractors.iter().enumerate().filter(|(j, _)| *j != i);
                let nearest = others
                    .map(|(_, o)| p.raw().distance(o.tube.axis.foot(p.raw()).point) - o.tube.radius_mm)
                    .fold(-scene.vessel.distance(p), f64::min)
                    - d.tube.radius_mm;
                worst = worst.min(nearest);
            }
        }
    }
    assert!(worst > 5.9, "least distance {worst}");
}

#[test]
fn the_first_unrelated_vessel_runs_beside_the_host_through_every_slice() {
    let scene = Scene::new(Kind::Anastomosis, &Settings::default()).unwrap();
    let d = &scene.truth.distractors[0];
    let host = scene.truth.branch(Role::Proximal).unwrap().direction;
    assert!(matches!(d.tube.axis, Axis::Straight { direction, .. } if direction.angle_to(host) < 1e-9));
    assert!((d.ends[0].distance(d.ends[1]) - 43.0 * 1.5).abs() < 1e-6);
    for d in &scene.truth.distractors {
        eprintln!("clearance {:.2}, ends {:?}", d.clearance_mm, d.ends);
    }
}

#[test]
fn every_random_phantom_of_the_survey_can_be_placed() {
    for seed in 0..300 {
        let kind = Kind::Random(seed);
        let s = Settings::of(kind);
        let scene = Scene::new(kind, &s).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let b = s.bifurcation;
        assert!((2.0..=5.0).contains(&b.host_radius_mm) && (2.0..=5.0).contains(&b.graft_radius_mm));
        let lengths: Vec<f64> =
            scene.truth.branches.iter().map(|b| b.length_mm / (2.0 * s.bifurcation.graft_radius_mm)).collect();
        assert!(lengths.iter().all(|&l| l > 4.5), "seed {seed}: {lengths:?} graft diameters");
    }
}

#[test]
fn bad_settings_are_all_named_and_refused() {
    let s = Settings { pixel_mm: f64::NAN, snr: Some(0.0), missing_slices: vec![99], ..Settings::default() };
    let Err(Error::Settings(faults)) = Scene::new(Kind::Tube, &s) else { panic!("accepted") };
    let fields: Vec<_> = faults.iter().map(|f| f.field).collect();
    assert_eq!(fields, ["pixel_mm", "snr", "missing_slices"]);
    let s = Settings { columns: 2048, rows: 2048, slices: 100, ..Settings::default() };
    let fault = Scene::new(Kind::Tube, &s).unwrap_err();
    assert_eq!((fault.kind(), fault.code()), (FaultKind::Limit, "phantom.too_large"));
    let s = Settings { shift_mm: [500.0, 0.0, 0.0], ..Settings::default() };
    assert_eq!(Scene::new(Kind::Tube, &s).unwrap_err().code(), "phantom.outside");
    let s = Settings { clearance_mm: 50.0, ..Settings::default() };
    assert_eq!(Scene::new(Kind::Anastomosis, &s).unwrap_err().code(), "phantom.no_room");
    assert_eq!("spiral".parse::<Kind>().unwrap_err().code(), "phantom.kind");
    for kind in [Kind::Anastomosis, Kind::Tube, Kind::Helix, Kind::Trifurcation, Kind::Sphere, Kind::Random(12)] {
        assert_eq!(kind.name().parse::<Kind>(), Ok(kind));
    }
}

#[test]
fn a_cancelled_scan_says_so() {
    let ctx = ctx();
    ctx.cancel();
    assert_eq!(scan(Kind::Tube, &small(Kind::Tube), &ctx).map(|_| ()), Err(Error::Cancelled));
}

#[test]
fn without_noise_the_vessel_is_found_and_not_the_texture_of_the_tissue() {
    // texture is hidden by noise at SNR 20 and tangled, long and smooth without it
    let ctx = Ctx::new(2).unwrap();
    for (snr, distractors) in [(None, 0), (Some(100.0), 2)] {
        let scan = Settings { snr, distractors, ..Settings::of(Kind::Tube) };
        let scene = Scene::new(Kind::Tube, &scan).unwrap();
        let stack = scene.image(&ctx).unwrap();
        let (contours, _) = imaging::contours(&stack, &imaging::Settings::default(), &ctx).unwrap();
        assert_eq!(contours.curves.len(), scan.slices, "SNR {snr:?}, {distractors} distractors");
        for curve in &contours.curves {
            let plane = &contours.planes[curve.plane];
            let p = curve.at(plane, 0.0).position;
            assert!(scene.vessel.distance(p).abs() < 0.5, "{p:?} is not on the tube's wall");
        }
    }
}
