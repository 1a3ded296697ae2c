//! Bytes to a [`Stack`]: what a scanner, a research tool or a picture folder gives.
//!
//! Two doors. [`intake`] is for the service: it opens archives in memory, strips everything that could name a patient
//! and gives neutral names, before anything touches disk. [`stack`] reads what is on disk (or what intake left): the
//! kind of each file is told by its content, one kind makes one stack, and every slice stays at its true position.
//! Sizes are held against [`Limits`] before they are allocated. Colour pictures are refused rather than turned into
//! luminance: a screenshot's colours are not the scanner's grey values (grey stored as equal RGB channels is taken).
//!
//! A `plan.json` among the files lends its geometry when the caller's plan has none; its other fields are never taken
//! (a warning says so), because what is not asked for openly must not steer a result.

mod archive;
mod collect;
mod detect;
mod dicom;
mod error;
mod fields;
mod intake;
mod limits;
mod mask;
mod metaimage;
mod nifti;
mod nrrd;
mod pictures;
mod report;
mod samples;
mod sections;
mod volume;

pub use crate::NamedBytes;
pub use collect::collect;
pub use dicom::{InstanceNames, instance};
pub use error::Error;
pub use intake::intake;
pub use limits::Limits;
pub use report::{Acquisition, Format, InputReport, stack, stack_of};
pub use sections::{SECTIONS_SCHEMA, sections};

#[cfg(test)]
mod tests;
