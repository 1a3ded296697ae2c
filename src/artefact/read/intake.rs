//! The service's door: archives opened in memory, patients' names removed, neutral file names, before anything touches
//! disk.
//!
//! DICOM files are written anew with the allow-list alone; volumes keep the header fields that place their voxels;
//! pictures are decoded and written anew, so that no text chunk, EXIF block or TIFF tag survives. The stack that comes
//! out has the same digest as the stack that went in. What is not understood is refused, not passed on; documents beside
//! the images are dropped.

use super::collect::expand;
use super::detect::Kind;
use super::report::{Sorted, sort};
use super::{Error, Limits, NamedBytes, dicom, metaimage, nifti, nrrd, pictures};
use crate::plan::Plan;
use crate::write::png;

/// Files that may be kept: no more than the images, and a plan where one lay beside them.
///
/// Names are neutral (`image-00001.dcm`, `mask-00001.nii`); the order of pictures is kept. Errors carry the client's own file names: give
/// them back to the client, not to a log.
///
/// # Errors
/// See [`Error`]; among them `archive.refused`, `input.too_large`, `input.unsupported`, `dicom.burned_in_annotation`.
pub fn intake(files: Vec<NamedBytes>, limits: &Limits) -> Result<Vec<NamedBytes>, Error> {
    let Sorted { kind, images, masks, others, plans, .. } = sort(expand(files, limits)?, limits)?;
    let others: Vec<&NamedBytes> = others.iter().collect();
    let mut out: Vec<NamedBytes> = Vec::with_capacity(images.len() + masks.len() + plans.len());
    if kind == Kind::Picture {
        for page in pictures::pages(&images, limits)? {
            let (extension, bytes) = png::lossless(&page.pixels, page.columns, page.rows).map_err(Error::Internal)?;
            out.push(numbered("image", out.len() + 1, extension, bytes));
        }
    } else {
        for file in &images {
            let clean = clean(kind, file, &others, limits)?;
            out.extend(clean.map(|(extension, bytes)| numbered("image", out.len() + 1, extension, bytes)));
        }
    }
    for (i, (kind, file)) in masks.iter().enumerate() {
        let clean = clean(*kind, file, &others, limits)?;
        out.extend(clean.map(|(extension, bytes)| numbered("mask", i + 1, extension, bytes)));
    }
    if out.is_empty() {
        return Err(Error::NoImages { files: 0 });
    }
    if let [plan] = &plans[..] {
        // written anew: no text of the client's passes
        let plan = Plan::parse(&plan.bytes)?;
        let bytes = serde_json::to_vec(&plan).map_err(|e| Error::Internal(e.to_string()))?;
        out.push(NamedBytes::new("plan.json", bytes));
    }
    Ok(out)
}

/// A file of a kind without anything that could name a patient, and its extension; `None` for DICOM without an image.
fn clean(
    kind: Kind,
    file: &NamedBytes,
    others: &[&NamedBytes],
    limits: &Limits,
) -> Result<Option<(&'static str, Vec<u8>)>, Error> {
    Ok(match kind {
        Kind::Dicom => dicom::anonymous(&file.name, &file.bytes, limits)?.map(|bytes| ("dcm", bytes)),
        Kind::Nifti => Some(("nii", nifti::anonymous(file, others)?)),
        Kind::MetaImage => Some(("mha", metaimage::anonymous(file, others)?)),
        _ => Some(("nrrd", nrrd::anonymous(file, others)?)),
    })
}

fn numbered(what: &str, number: usize, extension: &str, bytes: Vec<u8>) -> NamedBytes {
    NamedBytes::new(format!("{what}-{number:05}.{extension}"), bytes)
}
