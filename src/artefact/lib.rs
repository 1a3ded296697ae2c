//! Bytes to types and back: the only crate that knows a file format.

pub mod cohort;
pub mod field;
mod named;
mod next;
pub mod plan;
pub mod problem;
pub mod read;
pub mod reconstruction;
pub mod write;

pub use named::NamedBytes;
pub use reconstruction::Reconstruction;
