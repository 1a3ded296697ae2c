//! One DICOM instance by itself, as DICOMweb sends it: what it is called, and the file without anything that could name a
//! patient.

use super::dataset::{self, DataSet};
use super::pixels::Syntax;
use super::table::{SERIES, SOP_CLASS, SOP_INSTANCE, STUDY, Tag};
use super::{EXPLICIT, anonymous, body};
use crate::read::{Error, Limits};

/// The names of an instance, as sent: they identify it to its sender and are not to be kept. Empty where the file has none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct InstanceNames {
    /// SOPClassUID.
    pub class: String,
    /// SOPInstanceUID.
    pub instance: String,
    /// StudyInstanceUID.
    pub study: String,
    /// SeriesInstanceUID.
    pub series: String,
}

/// Names and cleaned file of an instance; `None` in place of the file for an object that holds no image. The names are
/// told even of a file that is refused, where they could be read.
///
/// # Errors
/// As [`crate::read::intake`] for a single file.
pub fn instance(bytes: &[u8], limits: &Limits) -> (InstanceNames, Result<Option<Vec<u8>>, Error>) {
    const FILE: &str = "the instance";
    let names = match names(FILE, bytes, limits) {
        Ok(names) => names,
        Err(error) => return (InstanceNames::default(), Err(error)),
    };
    let clean = anonymous(FILE, bytes, limits);
    (names, clean)
}

fn names(file: &str, bytes: &[u8], limits: &Limits) -> Result<InstanceNames, Error> {
    let (_, syntax, body) = body(file, bytes, limits)?;
    let encoding = match syntax {
        Syntax::Native(encoding) => encoding,
        Syntax::Deflated | Syntax::Encapsulated => EXPLICIT,
    };
    let ds = dataset::parse(file, &body, encoding)?;
    Ok(InstanceNames {
        class: uid(&ds, SOP_CLASS),
        instance: uid(&ds, SOP_INSTANCE),
        study: uid(&ds, STUDY),
        series: uid(&ds, SERIES),
    })
}

/// A UID of at most 64 digits and dots: nothing else goes back to the client under this name.
fn uid(ds: &DataSet<'_>, tag: Tag) -> String {
    let text = ds.text(tag).unwrap_or_default();
    let is_uid = text.len() <= 64 && text.bytes().all(|b| b.is_ascii_digit() || b == b'.');
    if is_uid { text.to_owned() } else { String::new() }
}
