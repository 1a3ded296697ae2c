//! Tubes turned against the slices: which axis is taken, and how exact the contours are.

use crate::survey::{compare, doubts};
use imaging::{Axis, Settings, contours};
use phantom::{Kind, Scene};

#[test]
fn turned_tubes_keep_their_wall_on_near_isotropic_volumes() {
    let ctx = exec::Ctx::new(2).unwrap();
    for tilt_deg in [0.0, 30.0, 45.0, 60.0, 90.0] {
        let settings = phantom::Settings {
            columns: 96,
            rows: 96,
            slices: 60,
            pixel_mm: 0.6,
            slice_spacing_mm: 0.8,
            thickness_mm: 0.8,
            distractors: 0,
            tilt_deg,
            ..phantom::Settings::of(Kind::Tube)
        };
        let scene = Scene::new(Kind::Tube, &settings).unwrap();
        let stack = scene.image(&ctx).unwrap();
        let mut errors = Vec::new();
        for axis in [None, Some(Axis::Slice), Some(Axis::Column)] {
            let Ok((c, r)) = contours(&stack, &Settings { axis, ..Settings::default() }, &ctx) else { continue };
            let o = compare(&c, &scene);
            println!(
                "{tilt_deg} deg {axis:?} -> {:?}: rms {:.4} mean {:+.4} worst {:.3} mm missed {:.3} {:?}",
                r.axis,
                o.rms_mm,
                o.mean_mm,
                o.worst_mm,
                o.missed,
                doubts(&r)
            );
            errors.push(o);
        }
        // the bar of a disc of 5 px at SNR 20, .06 px
        assert!(errors[0].rms_mm < 0.036 && errors[0].missed < 0.03, "{tilt_deg}");
    }
}
