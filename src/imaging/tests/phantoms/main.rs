//! Contours of simulated scans against their exact truth, and of a real scan where it lies on this machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod scan;
mod survey;
mod turned;
