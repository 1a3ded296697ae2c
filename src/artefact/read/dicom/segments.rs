//! DICOM segmentations (PS3.3 A.51): frames of one segment each, of one bit or of fractions, to label stacks.

use super::pixels::{Layout, samples};
use super::table::*;
use super::{body, headers, open, series};
use crate::read::volume::{Placed, Placement, place};
use crate::read::{Error, Limits, NamedBytes, mask};

/// Class of segmentations, as it lies in a file.
const CLASS: &[u8] = b"1.2.840.10008.5.1.4.1.1.66.4";
/// The file header with the class is shorter than this.
const HEAD: usize = 1024;

/// Whether a file is a segmentation by the class in its header.
pub(crate) fn is_segmentation(bytes: &[u8]) -> bool {
    let longer = |w: &[u8]| w.last().is_some_and(u8::is_ascii_digit);
    bytes[..bytes.len().min(HEAD)].windows(CLASS.len() + 1).any(|w| w.starts_with(CLASS) && !longer(w))
}

/// The chosen segment as a stack of label values at its frames' places, and the segment's number.
///
/// # Errors
/// As for images; [`Error::Label`].
pub(crate) fn labels(file: &NamedBytes, wanted: Option<u16>, limits: &Limits) -> Result<(Placement, u16), Error> {
    let name = file.name.as_str();
    let (uid, syntax, body) = body(name, &file.bytes, limits)?;
    let opened = open(name, uid, syntax, &body)?;
    let layout = Layout::of(name, &opened.ds, limits)?;
    let malformed = |reason: &str| Error::Malformed { file: name.to_owned(), reason: reason.to_owned() };
    let groups = opened.ds.items(PER_FRAME_GROUPS);
    let shared = opened.ds.items(SHARED_GROUPS).first();
    let of_frame = |frame: usize| {
        let in_group = |g: &super::DataSet| g.items(SEGMENT_IDENTIFICATION).first()?.short(REFERENCED_SEGMENT);
        groups.get(frame).and_then(in_group).or_else(|| shared.and_then(in_group))
    };
    let numbers: Option<Vec<u16>> = (0..layout.frames).map(of_frame).collect();
    let numbers = numbers.ok_or_else(|| malformed("a frame does not say which segment it shows"))?;
    let mut present = numbers.clone();
    present.sort_unstable();
    present.dedup();
    let label = mask::chosen(name, &present, wanted)?;
    // fractions count from one half
    let full = opened.ds.short(MAXIMUM_FRACTION).map_or(1.0, f32::from);
    let mut slices = headers(0, name, &opened.ds, &layout)?;
    slices.retain(|s| numbers.get(s.frame) == Some(&label));
    let Some(first) = slices.first() else { return Err(malformed("it shows no frame of its segment")) };
    let (frame, _) = series::frame(first).map_err(|_| malformed("a frame has no place"))?;
    let bytes = samples(name, &opened.ds, &opened.uid, &layout)?;
    let mut placed = Vec::with_capacity(slices.len());
    for s in &slices {
        let (_, plane) = series::frame(s).map_err(|_| malformed("a frame has no place"))?;
        let value = |p: f32| if 2.0 * p >= full { f32::from(label) } else { 0.0 };
        let pixels = layout.frame(name, &bytes, s.frame, (1.0, 0.0))?.into_iter().map(value).collect();
        placed.push(Placed { source: s.source.clone(), origin: plane.origin, pixels });
    }
    Ok((place(placed, &frame, limits)?, label))
}
