use super::scan::{Scan, fork};
use crate::{Axis, Settings, contours};
use exec::Ctx;

#[test]
fn a_fork_is_found_whole() {
    let stack = Scan::new(fork()).stack();
    let t = std::time::Instant::now();
    let (c, r) = contours(&stack, &Settings::default(), &Ctx::new(2).unwrap()).unwrap();
    println!(
        "{:?} psf {:?} thr {} lumens {:?} cuts {:?} tips {:?} warnings {:?} specks {}",
        r.axis, r.psf_sigma_px, r.threshold, r.lumens, c.cuts, c.tips, r.warnings, r.specks
    );
    println!("{:?} {:?}", r.candidates, t.elapsed());
    assert_eq!(r.axis, Axis::Slice);
}
