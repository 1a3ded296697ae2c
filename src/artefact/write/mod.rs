//! Types to bytes: every file that leaves the service.

pub mod dicom;
pub mod metaimage;
pub mod nifti;
pub mod png;
