#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
use super::*;
use proptest::prelude::*;
use space::Faulty;

/// The plan of contract.md.
const CONTRACT: &str = r#"{"geometry": {"pixel_spacing_mm": [0.5, 0.5], "slice_spacing_mm": 2.0, "slice_positions_mm": null, "origin_mm": [0, 0, 0], "row_direction": [1, 0, 0], "column_direction": [0, 1, 0]},
 "segmentation": {"threshold": null, "region": {"slice": 14, "centre_px": [255.5, 255.5], "radius_px": 90}, "seeds_mm": [[0, 0, 0]], "exclude_slices": [], "psf_sigma_px": null},
 "contours": {"axis": "auto"},
 "roles": {"graft_mm": [21, 0, 21], "proximal_mm": [0, 0, 25], "distal_mm": [0, 0, -25]},
 "smoothing": {"max_displacement_px": 1.0}, "surface": {"max_error_mm": 0.02, "edge_mm": [0.15, 1.0]},
 "ends": {"extension_diameters": 4, "cut_mm": []}, "morphometry": {"fit_from_diameters": null, "fit_to_diameters": 4}, "outputs": ["surface", "skeleton", "volume"]}"#;

#[test]
fn the_contracts_plan_is_read() {
    let p = Plan::parse(CONTRACT.as_bytes()).unwrap();
    assert_eq!(p.geometry.slice_spacing_mm, Some(2.0));
    assert_eq!(p.imaging().region.unwrap().slice, 14);
    assert_eq!(p.imaging().axis, None);
    assert_eq!(p.morphometry().roles.graft.unwrap().to_array(), [21.0, 0.0, 21.0]);
    assert_eq!(Plan::parse(b"{}").unwrap(), Plan::default());
    assert_eq!(Plan::parse(br#"{"smoothing": {"max_displacement_px": null}}"#).unwrap(), Plan::default());
}

#[test]
fn a_plan_survives_being_written() {
    let p = Plan::parse(CONTRACT.as_bytes()).unwrap();
    assert_eq!(Plan::parse(&serde_json::to_vec(&p).unwrap()).unwrap(), p);
    assert_eq!(Plan::parse(&serde_json::to_vec(&Plan::default()).unwrap()).unwrap(), Plan::default());
}

#[test]
fn every_fault_is_told_at_once_with_its_path() {
    let text = br#"{"segmentation": {"treshold": 5, "psf_sigma_px": -1, "region": {"slice": 1}},
        "geometry": {"pixel_spacing_mm": [0.5, -0.5], "row_direction": [1, 1, 0]}, "output": [], "smoothing": 3}"#;
    let e = Plan::parse(text).unwrap_err();
    let told: Vec<(&str, &str)> = e.faults.iter().map(|f| (f.code, f.field.as_str())).collect();
    assert_eq!(
        told,
        [
            ("plan.unknown_field", "segmentation.treshold"),
            ("plan.invalid", "segmentation.psf_sigma_px"),
            ("plan.invalid", "segmentation.region.centre_px"),
            ("plan.invalid", "segmentation.region.radius_px"),
            ("plan.invalid", "geometry.pixel_spacing_mm"),
            ("plan.invalid", "geometry.row_direction"),
            ("plan.unknown_field", "output"),
            ("plan.invalid", "smoothing"),
        ]
    );
    assert!(e.faults[0].message.contains("threshold"), "{}", e.faults[0].message);
    assert!(e.faults[6].message.contains("outputs"));
    assert_eq!((e.code(), e.place().field.as_deref()), ("plan.unknown_field", Some("segmentation.treshold")));
}

#[test]
fn ranges_hold() {
    for (text, field) in [
        (r#"{"smoothing": {"max_displacement_px": 5.1}}"#, "smoothing.max_displacement_px"),
        (r#"{"smoothing": {"max_displacement_px": -0.1}}"#, "smoothing.max_displacement_px"),
        (r#"{"surface": {"edge_mm": [1.0, 0.5]}}"#, "surface.edge_mm"),
        (r#"{"segmentation": {"threshold": 1e300}}"#, "segmentation.threshold"),
        (r#"{"segmentation": {"threshold": "118"}}"#, "segmentation.threshold"),
        (r#"{"segmentation": {"exclude_slices": [1.5]}}"#, "segmentation.exclude_slices"),
        (r#"{"outputs": ["mesh"]}"#, "outputs"),
        (r#"{"contours": {"axis": "x"}}"#, "contours.axis"),
        (r#"{"morphometry": {"fit_from_diameters": 5}}"#, "morphometry.fit_from_diameters"),
        (r#"{"geometry": {"row_direction": [1,0,0], "column_direction": [1,0,0]}}"#, "geometry.column_direction"),
        (r#"{"geometry": {"row_direction": [1,0,0]}}"#, "geometry.column_direction"),
        (r#"{"geometry": {"slice_positions_mm": [0, 1, 1]}}"#, "geometry.slice_positions_mm"),
        (r#"{"roles": {"graft_mm": [1, 2]}}"#, "roles.graft_mm"),
    ] {
        let e = Plan::parse(text.as_bytes()).unwrap_err();
        assert_eq!((e.code(), e.faults[0].field.as_str(), e.faults.len()), ("plan.invalid", field, 1), "{text}: {e}");
    }
}

#[test]
fn bad_json_and_bombs_are_refused() {
    let e = Plan::parse(b"{\n  \"outputs\": [,]}").unwrap_err();
    assert_eq!(e.code(), "plan.not_json");
    assert!(e.to_string().contains("line 2 column 15"), "{e}");
    assert_eq!(Plan::parse(b"[1]").unwrap_err().code(), "plan.invalid");
    assert_eq!(Plan::parse(b"null").unwrap_err().code(), "plan.invalid");
    assert_eq!(Plan::parse("[".repeat(100_000).as_bytes()).unwrap_err().code(), "plan.too_large");
    assert_eq!(Plan::parse(&vec![b' '; 2 << 20]).unwrap_err().code(), "plan.too_large");
}

proptest! {
    #[test]
    fn any_bytes_give_a_plan_or_faults(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = Plan::parse(&bytes);
    }
    #[test]
    fn any_small_change_of_a_plan_gives_a_plan_or_faults(at in 0usize..700, b in any::<u8>()) {
        let mut text = CONTRACT.as_bytes().to_vec();
        let n = text.len();
        text[at % n] = b;
        if let Err(e) = Plan::parse(&text) { prop_assert!(!e.faults.is_empty()); }
    }
}
