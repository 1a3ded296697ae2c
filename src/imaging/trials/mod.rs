//! Simulated scans with known truth: discs, tubes, forks, fading, gaps, distractors, noise.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod checks;
mod contour;
mod scan;
mod stack;
mod whole;
