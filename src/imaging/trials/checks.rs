//! What must be said of a shape: neighbours that touch, loose pieces, junctions in gaps, image borders; low SNR.

use super::scan::{Scan, fork};
use super::whole::{auto, codes, error, run};
use crate::{Axis, Settings};
use space::Warning;

fn said<'a>(warnings: &'a [Warning], code: &str) -> &'a Warning {
    warnings.iter().find(|w| w.code == code).unwrap_or_else(|| panic!("no {code} in {warnings:?}"))
}

#[test]
fn a_neighbour_that_touches_in_passing_is_said_with_its_slices() {
    // a vessel of 3 mm crosses the host below the junction and touches it near z = 6 mm (slice 4)
    for gap in [-0.6, 0.0] {
        let mut vessels = fork();
        vessels.push(([22.3 - gap - 7.0, 28.5, -8.0], [22.3 - gap, 28.5, 6.0], 3.0));
        vessels.push(([22.3 - gap, 28.5, 6.0], [22.3 - gap - 15.0, 28.5, 36.0], 3.0));
        let (_, r) = auto(&Scan { seed: 3, ..Scan::new(vessels) });
        println!("gap {gap}: {:?} {:?}", r.lumens, r.warnings);
        let w = said(&r.warnings, "segmentation.touching");
        assert!(w.place.slice.is_some_and(|k| k <= 7), "{w:?}");
    }
}

#[test]
fn two_vessels_side_by_side_are_said() {
    let vessels = vec![([25.0, 28.5, -10.0], [25.0, 28.5, 50.0], 3.0), ([31.2, 28.5, -10.0], [31.2, 28.5, 50.0], 3.4)];
    let (_, r) = auto(&Scan::new(vessels));
    println!("{:?} {:?}", r.lumens, r.warnings);
    // either seen as two, of which one is taken and the other a runner-up, or merged and said
    let merged = r.lumens.iter().any(|l| l.1 == 1);
    assert!(!merged || codes(&r).iter().any(|c| ["segmentation.touching", "segmentation.ambiguous"].contains(c)));
}

#[test]
fn a_fork_is_no_neighbour() {
    for seed in 0..4 {
        let (_, r) = auto(&Scan { seed, ..Scan::new(fork()) });
        assert!(r.warnings.is_empty(), "{:?}", r.warnings);
    }
}

#[test]
fn a_junction_in_a_gap_is_said_with_its_slices() {
    // the branches part in slice 14
    let settings = Settings { exclude_slices: vec![13, 14], ..Settings::default() };
    let (_, r) = run(&Scan::new(fork()).stack(), &settings).unwrap();
    let w = said(&r.warnings, "contours.junction_in_gap");
    assert_eq!(w.place.slice, Some(12), "{w:?}");
}

#[test]
fn a_vessel_that_leaves_through_the_border_is_said() {
    let c0 = [28.5, 28.5, 16.0];
    let vessels = vec![([28.5, 28.5, -10.0], c0, 3.2), (c0, [28.5, 28.5, 50.0], 3.0), (c0, [80.0, 28.5, 21.0], 3.0)];
    let settings = Settings { axis: Some(Axis::Slice), ..Settings::default() };
    let (_, r) = run(&Scan::new(vessels).stack(), &settings).unwrap();
    assert!(said(&r.warnings, "contours.at_border").place.slice.is_some());
}

#[test]
fn a_black_background_at_low_snr_keeps_the_area() {
    let tube = vec![([28.2, 28.7, -10.0], [29.0, 28.4, 50.0], 3.0)];
    let mut bias = 0.0;
    for seed in 0..5 {
        let scan = Scan { tissue: 0.0, noise: 12.5, seed, ..Scan::new(tube.clone()) };
        let (c, _) = auto(&scan);
        bias += error(&c, &tube, [0.0; 3]).1 / 5.0;
    }
    println!("black at SNR 8: mean {bias:+.4} mm");
    // the bar of 2 % of area at SNR 10, at SNR 8: 2.5 %, for a radius of 3 mm (-.079 mm with the half of the plain means)
    assert!(bias.abs() < 0.0375, "{bias}");
}
