use super::scan::{Scan, fork};
use crate::{Error, Layout, Slice, Stack};
use space::{Faulty, P3, V3};

fn layout() -> Layout {
    Layout { pixel_spacing_mm: [0.5, 0.5], row_direction: V3::X, column_direction: V3::Y, thickness_mm: None }
}
fn slices(z: &[f64]) -> Vec<Slice> {
    let one = |&z: &f64| Slice { columns: 8, rows: 8, pixels: vec![z as f32; 64], origin: P3::new(0.0, 0.0, z) };
    z.iter().map(one).collect()
}
fn refusal(s: Vec<Slice>) -> Error {
    Stack::new(layout(), s).unwrap_err()
}

#[test]
fn slices_are_sorted_by_position() {
    let s = Stack::new(layout(), slices(&[4.0, 0.0, 2.0])).unwrap();
    assert_eq!([s.slice(0)[0], s.slice(1)[0], s.slice(2)[0]], [0.0, 2.0, 4.0]);
    assert_eq!(s.offset_mm(2), 4.0);
}

#[test]
fn two_slices_in_one_position_are_refused_with_the_slice() {
    let e = refusal(slices(&[0.0, 2.0, 2.0, 4.0]));
    assert_eq!((e.code(), e.place().slice), ("stack.duplicate_position", Some(2)));
}

#[test]
fn a_sheared_stack_is_refused() {
    let mut s = slices(&[0.0, 2.0, 4.0]);
    s[2].origin = P3::new(0.3, 0.0, 4.0);
    assert_eq!(refusal(s).code(), "stack.sheared");
}

#[test]
fn other_faults_have_their_codes() {
    assert_eq!(refusal(slices(&[0.0, 1.0])).code(), "stack.too_few_slices");
    let mut s = slices(&[0.0, 1.0, 2.0]);
    s[1].columns = 9;
    assert_eq!(refusal(s).code(), "stack.unequal_sizes");
    let mut s = slices(&[0.0, 1.0, 2.0]);
    s[2].pixels[5] = f32::NAN;
    assert_eq!(refusal(s), Error::NotFinite { slice: 2, row: 0, column: 5 });
    let mut s = slices(&[0.0, 1.0, 2.0]);
    s[0].pixels.pop();
    assert_eq!(refusal(s).code(), "stack.pixel_count");
    let skew = Layout { column_direction: V3::new(0.1, 1.0, 0.0), ..layout() };
    assert_eq!(Stack::new(skew, slices(&[0.0, 1.0, 2.0])).unwrap_err().code(), "stack.geometry");
}

#[test]
fn gaps_are_listed_in_the_completed_series() {
    let s = Stack::new(layout(), slices(&[0.0, 2.0, 4.0, 10.0, 12.0, 16.0, 18.0])).unwrap();
    assert_eq!(s.missing_slices(), vec![3, 4, 7]);
    let w = s.gap_warnings();
    assert_eq!(w.iter().map(|w| w.place.slice).collect::<Vec<_>>(), vec![Some(2), Some(4)]);
}

#[test]
fn leaving_slices_out_makes_a_gap() {
    let s = Scan::new(fork()).stack().without(&[3, 4]);
    assert_eq!(s.missing_slices(), vec![3, 4]);
}
