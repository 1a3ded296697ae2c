//! Stored pixels to grey values: sample width, sign, rescale; compressed frames through dicom-rs.

use super::dataset::{DataSet, Encoding, Value};
use super::table::{
    BITS_ALLOCATED, BITS_STORED, COLUMNS, FRAMES, HIGH_BIT, PHOTOMETRIC, PIXEL_DATA, PIXEL_REPRESENTATION, ROWS,
    SAMPLES_PER_PIXEL,
};
use super::{jpegls, rle};
use crate::read::samples::Order;
use crate::read::{Error, Limits};
use dicom_core::value::{PixelFragmentSequence, PrimitiveValue};
use dicom_core::{DataElement, VR};
use dicom_dictionary_std::tags;
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use dicom_pixeldata::PixelDecoder;
use std::borrow::Cow;

/// How pixels are written in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Syntax {
    /// Plain samples.
    Native(Encoding),
    /// Plain samples in a deflated data set.
    Deflated,
    /// Fragments of RLE, JPEG, JPEG-LS or JPEG 2000.
    Encapsulated,
}

const JPEG_LS: &str = "1.2.840.10008.1.2.4.80";
const JPEG_LS_NEAR: &str = "1.2.840.10008.1.2.4.81";
const RLE: &str = "1.2.840.10008.1.2.5";

/// The syntax of a transfer syntax UID.
///
/// # Errors
/// [`Error::Unsupported`] for those that are not read.
pub(crate) fn syntax(file: &str, uid: &str) -> Result<Syntax, Error> {
    let native = |explicit, order| Ok(Syntax::Native(Encoding { explicit, order }));
    match uid {
        "1.2.840.10008.1.2" => native(false, Order::Little),
        "1.2.840.10008.1.2.1" => native(true, Order::Little),
        "1.2.840.10008.1.2.1.99" => Ok(Syntax::Deflated),
        "1.2.840.10008.1.2.2" => native(true, Order::Big),
        // JPEG baseline, extended, lossless (two), JPEG-LS and JPEG 2000 lossless and lossy, RLE
        "1.2.840.10008.1.2.4.50"
        | "1.2.840.10008.1.2.4.51"
        | "1.2.840.10008.1.2.4.57"
        | "1.2.840.10008.1.2.4.70"
        | JPEG_LS
        | JPEG_LS_NEAR
        | "1.2.840.10008.1.2.4.90"
        | "1.2.840.10008.1.2.4.91"
        | RLE => Ok(Syntax::Encapsulated),
        other => {
            let shown: String = other.chars().filter(|c| c.is_ascii_digit() || *c == '.').take(64).collect();
            let reason = format!(
                "transfer syntax {shown} is not read; export uncompressed, RLE, JPEG lossless, JPEG-LS or JPEG 2000 instead"
            );
            Err(Error::Unsupported { file: file.to_owned(), reason })
        }
    }
}

/// Size and sample layout of a file's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layout {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    pub(crate) frames: usize,
    allocated: u16,
    stored: u16,
    high_bit: u16,
    signed: bool,
}

impl Layout {
    /// The layout that the header states, within the limits; nothing is allocated before.
    ///
    /// # Errors
    /// [`Error::TooLarge`], [`Error::Malformed`], [`Error::Unsupported`], [`Error::Colour`].
    pub(crate) fn of(file: &str, ds: &DataSet, limits: &Limits) -> Result<Self, Error> {
        let malformed = |reason: String| Error::Malformed { file: file.to_owned(), reason };
        let short = |tag, name: &str| ds.short(tag).ok_or_else(|| malformed(format!("{name} is missing")));
        let photometric = ds.text(PHOTOMETRIC).unwrap_or("MONOCHROME2");
        if ds.short(SAMPLES_PER_PIXEL).unwrap_or(1) != 1 || !photometric.starts_with("MONOCHROME") {
            return Err(Error::Colour { file: file.to_owned() });
        }
        let (rows, columns) = (short(ROWS, "Rows")?, short(COLUMNS, "Columns")?);
        let frames = ds.numbers(FRAMES).and_then(|f| f.first().copied()).unwrap_or(1.0);
        if !(1.0..=1e9).contains(&frames) || frames.fract() != 0.0 {
            return Err(malformed(format!("it states {frames} frames")));
        }
        limits.admit(file, u64::from(columns), u64::from(rows), frames as u64)?;
        let allocated = short(BITS_ALLOCATED, "BitsAllocated")?;
        let stored = ds.short(BITS_STORED).unwrap_or(allocated);
        let high_bit = ds.short(HIGH_BIT).unwrap_or(stored.saturating_sub(1));
        if ![1, 8, 16, 32].contains(&allocated) {
            let reason = format!("{allocated} bits per pixel are not read; 1, 8, 16 and 32 are");
            return Err(Error::Unsupported { file: file.to_owned(), reason });
        }
        if stored == 0 || stored > allocated || high_bit >= allocated || high_bit + 1 < stored {
            return Err(malformed(format!("{stored} bits up to bit {high_bit} do not fit into {allocated}")));
        }
        let signed = ds.short(PIXEL_REPRESENTATION).unwrap_or(0) == 1;
        Ok(Self {
            rows: usize::from(rows),
            columns: usize::from(columns),
            frames: frames as usize,
            allocated,
            stored,
            high_bit,
            signed,
        })
    }

    /// Bytes of all frames; single bits are packed across rows and frames (PS3.5 8.2).
    fn bytes(&self) -> usize {
        (self.frames * self.rows * self.columns * usize::from(self.allocated)).div_ceil(8)
    }

    /// The value of one little-endian sample: bits low to high, other bits (old overlays) masked, sign extended.
    fn value(&self, sample: &[u8]) -> f64 {
        let raw = sample.iter().rev().fold(0u64, |acc, b| (acc << 8) | u64::from(*b));
        let low = u32::from(self.high_bit + 1 - self.stored);
        let stored = u32::from(self.stored);
        let up = (raw >> low) << (64 - stored);
        if self.signed { ((up as i64) >> (64 - stored)) as f64 } else { (up >> (64 - stored)) as f64 }
    }

    /// One frame's grey values slope * stored + intercept from a file's little-endian samples.
    ///
    /// # Errors
    /// [`Error::Truncated`].
    pub(crate) fn frame(
        &self,
        file: &str,
        samples: &[u8],
        frame: usize,
        (slope, intercept): (f64, f64),
    ) -> Result<Vec<f32>, Error> {
        let count = self.rows * self.columns;
        let size = count * usize::from(self.allocated / 8);
        if samples.len() < self.bytes() || frame >= self.frames {
            let (needed, found) = (self.bytes() as u64, samples.len() as u64);
            return Err(Error::Truncated { file: file.to_owned(), what: "the pixel data", needed, found });
        }
        if self.allocated == 1 {
            let bit = |i: usize| f64::from(samples[i / 8] >> (i % 8) & 1);
            return Ok((frame * count..(frame + 1) * count).map(|i| (slope * bit(i) + intercept) as f32).collect());
        }
        let bytes = &samples[frame * size..(frame + 1) * size];
        let width = usize::from(self.allocated / 8);
        Ok(bytes.chunks_exact(width).map(|s| (slope * self.value(s) + intercept) as f32).collect())
    }
}

/// All samples of a file, little endian, frame after frame.
///
/// # Errors
/// [`Error::Truncated`] without (whole) pixel data, [`Error::Unsupported`] or [`Error::Malformed`] when a compressed
/// frame cannot be decoded.
pub(crate) fn samples<'a>(file: &str, ds: &DataSet<'a>, uid: &str, layout: &Layout) -> Result<Cow<'a, [u8]>, Error> {
    let needed = layout.bytes() as u64;
    match ds.elements.get(&PIXEL_DATA) {
        Some(Value::Bytes(bytes, vr)) => {
            if (bytes.len() as u64) < needed {
                let found = bytes.len() as u64;
                return Err(Error::Truncated { file: file.to_owned(), what: "the pixel data", needed, found });
            }
            let word = match ds.order {
                Order::Little => 1,
                // 8-bit pixels in 16-bit words are swapped with the words
                Order::Big if layout.allocated <= 8 && *vr != Some(*b"OW") => 1,
                Order::Big => usize::from(layout.allocated / 8).max(2),
            };
            if word == 1 {
                return Ok(Cow::Borrowed(bytes));
            }
            Ok(Cow::Owned(bytes.chunks_exact(word).flat_map(|w| w.iter().rev().copied()).collect()))
        }
        Some(Value::Fragments(fragments)) => decoded(file, fragments, uid, layout).map(Cow::Owned),
        _ => Err(Error::Truncated { file: file.to_owned(), what: "the pixel data", needed, found: 0 }),
    }
}

/// Compressed frames through dicom-rs, behind a check of the size that each JPEG or JPEG 2000 stream states for itself
/// (a decoder allocates by that) and a guard against panics of the decoders.
fn decoded(file: &str, fragments: &[&[u8]], uid: &str, layout: &Layout) -> Result<Vec<u8>, Error> {
    let malformed = |reason: String| Error::Malformed { file: file.to_owned(), reason };
    if layout.allocated == 1 {
        let reason = "compressed single bits are not read; export it uncompressed".to_owned();
        return Err(Error::Unsupported { file: file.to_owned(), reason });
    }
    match uid {
        JPEG_LS | JPEG_LS_NEAR => return jpeg_ls(fragments, layout).map_err(malformed),
        RLE => return run_lengths(fragments, layout).map_err(malformed),
        _ => {}
    }
    for (columns, rows) in fragments.iter().skip(1).filter_map(|f| stream_size(f)) {
        if (columns as usize, rows as usize) != (layout.columns, layout.rows) {
            let stated = format!("{} x {}", layout.columns, layout.rows);
            return Err(malformed(format!(
                "a compressed frame is {columns} x {rows} pixels, the header states {stated}"
            )));
        }
    }
    let object = encapsulated(fragments, uid, layout).map_err(malformed)?;
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| object.decode_pixel_data()));
    let unreadable = |e: String| {
        let reason =
            format!("its compressed pixels (transfer syntax {uid}) cannot be decoded: {e}; export uncompressed");
        Error::Unsupported { file: file.to_owned(), reason }
    };
    let decoded = match outcome {
        Ok(Ok(decoded)) => decoded,
        Ok(Err(e)) => return Err(unreadable(e.to_string())),
        Err(_) => return Err(unreadable("the decoder gave up".to_owned())),
    };
    if decoded.bits_allocated() != layout.allocated || decoded.samples_per_pixel() != 1 {
        let bits = decoded.bits_allocated();
        return Err(malformed(format!("{bits} bits per pixel come out where {} are stated", layout.allocated)));
    }
    Ok(decoded.into_data())
}

/// Run-length coded frames as little-endian samples.
fn run_lengths(fragments: &[&[u8]], layout: &Layout) -> Result<Vec<u8>, String> {
    let (pixels, width) = (layout.rows * layout.columns, usize::from(layout.allocated / 8));
    let mut out = Vec::new();
    for frame in frames(fragments, layout.frames)? {
        out.append(&mut rle::decode(&frame, pixels, width)?);
    }
    Ok(out)
}

/// JPEG-LS frames as little-endian samples.
fn jpeg_ls(fragments: &[&[u8]], layout: &Layout) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    for stream in frames(fragments, layout.frames)? {
        let frame = jpegls::decode(&stream, layout.columns, layout.rows)?;
        match layout.allocated {
            8 if frame.precision <= 8 => out.extend(frame.samples.iter().map(|&s| s as u8)),
            16 => out.extend(frame.samples.iter().flat_map(|s| s.to_le_bytes())),
            bits => return Err(format!("{} bits per pixel come out where {bits} are stated", frame.precision)),
        }
    }
    Ok(out)
}

/// The code streams of all frames: one fragment each, or all fragments of a single frame, or by the offset table (byte
/// offsets of the frames' first fragments, item headers of 8 bytes counted; PS3.5 A.4).
fn frames<'a>(fragments: &[&'a [u8]], count: usize) -> Result<Vec<Cow<'a, [u8]>>, String> {
    let Some((table, pieces)) = fragments.split_first() else { return Err("it holds no fragment".to_owned()) };
    if pieces.len() == count {
        return Ok(pieces.iter().map(|p| Cow::Borrowed(*p)).collect());
    }
    if count == 1 {
        return Ok(vec![Cow::Owned(pieces.concat())]);
    }
    let offsets: Vec<u64> =
        table.chunks_exact(4).map(|b| u64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect();
    if offsets.len() != count {
        return Err(format!("{} fragments for {count} frames and no offset table", pieces.len()));
    }
    let mut out: Vec<Vec<u8>> = Vec::new();
    let mut at = 0;
    for piece in pieces {
        if offsets.get(out.len()) == Some(&at) {
            out.push(Vec::new());
        }
        let Some(last) = out.last_mut() else { return Err("its offset table is damaged".to_owned()) };
        last.extend(*piece);
        at += 8 + piece.len() as u64;
    }
    if out.len() == count {
        Ok(out.into_iter().map(Cow::Owned).collect())
    } else {
        Err("its offset table is damaged".to_owned())
    }
}

fn encapsulated(
    fragments: &[&[u8]],
    uid: &str,
    layout: &Layout,
) -> Result<dicom_object::FileDicomObject<InMemDicomObject>, String> {
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uid)
        .media_storage_sop_class_uid("1.2.840.10008.5.1.4.1.1.4")
        .media_storage_sop_instance_uid("2.25.1")
        .build()
        .map_err(|e| e.to_string())?;
    let mut object = InMemDicomObject::new_empty();
    let shorts = [
        (tags::SAMPLES_PER_PIXEL, 1),
        (tags::ROWS, layout.rows as u16),
        (tags::COLUMNS, layout.columns as u16),
        (tags::BITS_ALLOCATED, layout.allocated),
        (tags::BITS_STORED, layout.stored),
        (tags::HIGH_BIT, layout.high_bit),
        (tags::PIXEL_REPRESENTATION, u16::from(layout.signed)),
    ];
    for (tag, value) in shorts {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    object.put(DataElement::new(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, PrimitiveValue::from("MONOCHROME2")));
    object.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from(layout.frames.to_string())));
    let table = fragments.first().map_or(&[][..], |t| t);
    let offsets: Vec<u32> = table.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let pieces: Vec<Vec<u8>> = fragments.iter().skip(1).map(|f| f.to_vec()).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PixelFragmentSequence::new(offsets, pieces)));
    Ok(object.with_exact_meta(meta))
}

/// (columns, rows) that a JPEG or JPEG 2000 code stream states at its start; `None` for other data.
fn stream_size(stream: &[u8]) -> Option<(u32, u32)> {
    let long = |at: usize| stream.get(at..)?.first_chunk::<4>().map(|b| u32::from_be_bytes(*b));
    let short = |at: usize| stream.get(at..)?.first_chunk::<2>().map(|b| u16::from_be_bytes(*b));
    if stream.starts_with(&[0xff, 0x4f, 0xff, 0x51]) {
        // SIZ: length, capabilities, Xsiz, Ysiz, XOsiz, YOsiz
        return Some((long(8)?.checked_sub(long(16)?)?, long(12)?.checked_sub(long(20)?)?));
    }
    if !stream.starts_with(&[0xff, 0xd8]) {
        return None;
    }
    let mut at = 2;
    loop {
        let marker = short(at)?;
        // start of frame of any process, but neither DHT, JPG nor DAC
        if (0xffc0..=0xffcf).contains(&marker) && ![0xffc4, 0xffc8, 0xffcc].contains(&marker) {
            return Some((u32::from(short(at + 7)?), u32::from(short(at + 5)?)));
        }
        at += 2 + usize::from(short(at + 2)?.max(2));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(allocated: u16, stored: u16, high_bit: u16, signed: bool) -> Layout {
        Layout { rows: 1, columns: 1, frames: 1, allocated, stored, high_bit, signed }
    }

    #[test]
    fn bits_above_and_below_the_stored_ones_are_masked_and_the_sign_is_extended() {
        assert_eq!(layout(16, 12, 11, false).value(&[0xff, 0xff]), 4095.0);
        assert_eq!(layout(16, 12, 11, true).value(&[0xff, 0xff]), -1.0);
        assert_eq!(layout(16, 12, 11, true).value(&[0xff, 0xf7]), 2047.0);
        assert_eq!(layout(16, 12, 15, false).value(&[0x0f, 0x80]), 2048.0);
        assert_eq!(layout(8, 8, 7, true).value(&[0x80]), -128.0);
        assert_eq!(layout(32, 32, 31, true).value(&[0xfe, 0xff, 0xff, 0xff]), -2.0);
    }

    #[test]
    fn a_stream_states_its_own_size() {
        let mut j2k = vec![0xff, 0x4f, 0xff, 0x51, 0, 41, 0, 0];
        for v in [70_000u32, 20, 0, 4] {
            j2k.extend(v.to_be_bytes());
        }
        assert_eq!(stream_size(&j2k), Some((70_000, 16)));
        let jpeg = [0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xc3, 0, 11, 8, 0, 16, 0, 32];
        assert_eq!(stream_size(&jpeg), Some((32, 16)));
        assert_eq!(stream_size(&[0xff, 0xd8, 0xff]), None);
    }
}
