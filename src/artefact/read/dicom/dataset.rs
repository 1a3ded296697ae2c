//! A DICOM file to the elements of the allow-list (PS3.5 section 7, PS3.10 section 7).
//!
//! An own parser, because a general one keeps everything (a patient's name would live in memory and in its error
//! messages) and trusts stated lengths. This one borrows the bytes, allocates nothing by a stated length, and drops all
//! that [`super::table`] does not allow, at any depth.

use super::table::{PIXEL_DATA, Tag, representation};
use crate::read::Error;
use crate::read::samples::Order;
use std::collections::BTreeMap;

/// Sequences nested deeper than this are refused; functional groups need 3.
const MAX_DEPTH: usize = 16;
const UNDEFINED: u32 = u32::MAX;
const ITEM: Tag = 0xfffe_e000;
const ITEM_END: Tag = 0xfffe_e00d;
const SEQUENCE_END: Tag = 0xfffe_e0dd;
/// Value representations with a 32-bit length.
const LONG: [&[u8; 2]; 14] =
    [b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV", b"OX"];

/// How the elements are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Encoding {
    pub(crate) explicit: bool,
    pub(crate) order: Order,
}

/// An element's value.
#[derive(Clone, Debug)]
pub(crate) enum Value<'a> {
    /// Plain bytes, with the stated representation (`None` where implicit).
    Bytes(&'a [u8], Option<[u8; 2]>),
    /// A sequence.
    Items(Vec<DataSet<'a>>),
    /// Encapsulated pixel data; the first fragment is the offset table.
    Fragments(Vec<&'a [u8]>),
}

/// Allowed elements of a data set or an item.
#[derive(Clone, Debug)]
pub(crate) struct DataSet<'a> {
    pub(crate) elements: BTreeMap<Tag, Value<'a>>,
    pub(crate) order: Order,
}

impl<'a> DataSet<'a> {
    fn bytes(&self, tag: Tag) -> Option<&'a [u8]> {
        match self.elements.get(&tag)? {
            Value::Bytes(b, _) => Some(b),
            _ => None,
        }
    }
    /// A text value without padding.
    pub(crate) fn text(&self, tag: Tag) -> Option<&'a str> {
        let text = std::str::from_utf8(self.bytes(tag)?).ok()?;
        Some(text.trim_matches([' ', '\0'])).filter(|t| !t.is_empty())
    }
    /// The numbers of a decimal or integer string; `None` when one of them is no finite number.
    pub(crate) fn numbers(&self, tag: Tag) -> Option<Vec<f64>> {
        let parse = |t: &str| t.trim().parse::<f64>().ok().filter(|x| x.is_finite());
        self.text(tag)?.split('\\').map(parse).collect()
    }
    /// An unsigned short.
    pub(crate) fn short(&self, tag: Tag) -> Option<u16> {
        // Exactly two bytes: sizes sent as UL would lose their upper half here and overflowed elsewhere (CVE-2026-5442).
        let b = <&[u8; 2]>::try_from(self.bytes(tag)?).ok()?;
        Some(match self.order {
            Order::Little => u16::from_le_bytes(*b),
            Order::Big => u16::from_be_bytes(*b),
        })
    }
    /// The items of a sequence.
    pub(crate) fn items(&self, tag: Tag) -> &[DataSet<'a>] {
        match self.elements.get(&tag) {
            Some(Value::Items(items)) => items,
            _ => &[],
        }
    }
}

/// The transfer syntax (explicit little endian or implicit where the file has no header) and the bytes of the data set.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Truncated`].
pub(crate) fn split<'a>(file: &str, bytes: &'a [u8]) -> Result<(String, &'a [u8]), Error> {
    let start = if bytes.get(128..132) == Some(b"DICM") { 132 } else { 0 };
    let mut reader = Reader { file, bytes, at: start, encoding: EXPLICIT };
    let mut syntax = None;
    while let Some(tag) = reader.peek_tag() {
        if tag >> 16 != 0x0002 {
            break;
        }
        let (tag, _, length) = reader.header()?;
        let value = reader.take(length, "the file header")?;
        if tag == 0x0002_0010 {
            syntax = Some(String::from_utf8_lossy(value).trim_matches(['\0', ' ']).to_owned());
        }
    }
    let body = &bytes[reader.at..];
    let explicit = body.get(4..6).is_some_and(|vr| vr.iter().all(u8::is_ascii_uppercase));
    let guessed = if explicit { "1.2.840.10008.1.2.1" } else { "1.2.840.10008.1.2" };
    Ok((syntax.unwrap_or_else(|| guessed.to_owned()), body))
}

const EXPLICIT: Encoding = Encoding { explicit: true, order: Order::Little };

/// The allowed elements of a data set, up to and with the pixel data.
///
/// # Errors
/// [`Error::Truncated`] when a stated length exceeds what is there, [`Error::Malformed`] otherwise.
pub(crate) fn parse<'a>(file: &str, body: &'a [u8], encoding: Encoding) -> Result<DataSet<'a>, Error> {
    let mut reader = Reader { file, bytes: body, at: 0, encoding };
    reader.data_set(body.len(), 0)
}

struct Reader<'a, 'n> {
    file: &'n str,
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl<'a> Reader<'a, '_> {
    fn malformed(&self, reason: impl Into<String>) -> Error {
        Error::Malformed { file: self.file.to_owned(), reason: reason.into() }
    }

    fn take(&mut self, length: u32, what: &'static str) -> Result<&'a [u8], Error> {
        let rest = &self.bytes[self.at..];
        let Some(taken) = rest.get(..length as usize) else {
            let (needed, found) = (u64::from(length), rest.len() as u64);
            return Err(Error::Truncated { file: self.file.to_owned(), what, needed, found });
        };
        self.at += length as usize;
        Ok(taken)
    }

    fn u16(&self, b: [u8; 2]) -> u16 {
        match self.encoding.order {
            Order::Little => u16::from_le_bytes(b),
            Order::Big => u16::from_be_bytes(b),
        }
    }

    fn u32(&self, b: [u8; 4]) -> u32 {
        match self.encoding.order {
            Order::Little => u32::from_le_bytes(b),
            Order::Big => u32::from_be_bytes(b),
        }
    }

    fn peek_tag(&self) -> Option<Tag> {
        let b = self.bytes.get(self.at..)?.first_chunk::<4>()?;
        Some(u32::from(self.u16([b[0], b[1]])) << 16 | u32::from(self.u16([b[2], b[3]])))
    }

    /// Tag, representation and length of the next element.
    fn header(&mut self) -> Result<(Tag, Option<[u8; 2]>, u32), Error> {
        let b = self.take(8, "an element header")?;
        let tag = u32::from(self.u16([b[0], b[1]])) << 16 | u32::from(self.u16([b[2], b[3]]));
        let length = self.u32([b[4], b[5], b[6], b[7]]);
        if !self.encoding.explicit || matches!(tag, ITEM | ITEM_END | SEQUENCE_END) {
            return Ok((tag, None, length));
        }
        let vr = [b[4], b[5]];
        if !vr.iter().all(u8::is_ascii_uppercase) {
            let (group, element) = (tag >> 16, tag & 0xffff);
            return Err(self.malformed(format!("element ({group:04x},{element:04x}) has no value representation")));
        }
        if !LONG.contains(&&vr) {
            return Ok((tag, Some(vr), u32::from(self.u16([b[6], b[7]]))));
        }
        let b = self.take(4, "an element header")?;
        Ok((tag, Some(vr), self.u32([b[0], b[1], b[2], b[3]])))
    }

    /// Elements up to `end`, or to an item delimiter.
    fn data_set(&mut self, end: usize, depth: usize) -> Result<DataSet<'a>, Error> {
        if depth > MAX_DEPTH {
            return Err(self.malformed(format!("sequences nested deeper than {MAX_DEPTH}")));
        }
        let mut elements = BTreeMap::new();
        // fewer than 8 bytes cannot be an element: padding at the end of some files
        while self.at + 8 <= end {
            let (tag, vr, length) = self.header()?;
            if tag == ITEM_END {
                break;
            }
            let allowed = representation(tag);
            let sequence = match vr {
                Some(vr) => vr == *b"SQ" || (length == UNDEFINED && tag != PIXEL_DATA),
                None => allowed == Some(b"SQ") || (length == UNDEFINED && tag != PIXEL_DATA),
            };
            let value = if length == UNDEFINED && tag == PIXEL_DATA {
                Value::Fragments(self.fragments()?)
            } else if sequence && (length == UNDEFINED || allowed.is_some()) {
                self.sequence(vr, length, depth)?
            } else {
                Value::Bytes(self.take(length, if tag == PIXEL_DATA { "the pixel data" } else { "an element" })?, vr)
            };
            if allowed.is_some() {
                elements.insert(tag, value);
            }
            if tag == PIXEL_DATA && depth == 0 {
                break;
            }
        }
        Ok(DataSet { elements, order: self.encoding.order })
    }

    /// A sequence's items. Of unknown representation and undefined length, it is implicit little endian (PS3.5 6.2.2).
    fn sequence(&mut self, vr: Option<[u8; 2]>, length: u32, depth: usize) -> Result<Value<'a>, Error> {
        let outer = self.encoding;
        if vr == Some(*b"UN") {
            self.encoding = Encoding { explicit: false, order: Order::Little };
        }
        let end = self.end_of(length)?;
        let mut items = Vec::new();
        while self.at + 8 <= end {
            let (tag, _, length) = self.header()?;
            match tag {
                SEQUENCE_END => break,
                ITEM => {
                    let end = self.end_of(length)?;
                    items.push(self.data_set(end, depth + 1)?);
                }
                other => return Err(self.malformed(format!("{other:08x} where a sequence item should begin"))),
            }
        }
        self.encoding = outer;
        Ok(Value::Items(items))
    }

    fn end_of(&self, length: u32) -> Result<usize, Error> {
        if length == UNDEFINED {
            return Ok(self.bytes.len());
        }
        let end = self.at + length as usize;
        if end > self.bytes.len() {
            let (needed, found) = (u64::from(length), (self.bytes.len() - self.at) as u64);
            return Err(Error::Truncated { file: self.file.to_owned(), what: "a sequence", needed, found });
        }
        Ok(end)
    }

    fn fragments(&mut self) -> Result<Vec<&'a [u8]>, Error> {
        let mut fragments = Vec::new();
        loop {
            let (tag, _, length) = self.header()?;
            match tag {
                SEQUENCE_END => return Ok(fragments),
                ITEM => fragments.push(self.take(length, "the pixel data")?),
                other => return Err(self.malformed(format!("{other:08x} where a pixel fragment should begin"))),
            }
        }
    }
}
