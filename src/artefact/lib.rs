//! Bytes to types and back: the only crate that knows a file format.

pub mod plan;
pub mod read;
pub mod write;
