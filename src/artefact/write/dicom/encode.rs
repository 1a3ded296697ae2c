//! DICOM elements to bytes: PS3.10 file, explicit little endian.

use sha2::{Digest, Sha256};

/// Explicit VR little endian.
pub(crate) const EXPLICIT_LITTLE: &str = "1.2.840.10008.1.2.1";

/// Our implementation class UID (a UUID-derived one, PS3.5 B.2).
const IMPLEMENTATION: &str = "2.25.243017853049270196512438571930467221";

/// An element's content.
#[derive(Clone, Debug)]
pub(crate) enum Content {
    /// A plain value; odd lengths are padded.
    Bytes(Vec<u8>),
    /// A sequence's items.
    Items(Vec<Vec<Element>>),
    /// Encapsulated pixel data, offset table first.
    Fragments(Vec<Vec<u8>>),
}

/// An element.
#[derive(Clone, Debug)]
pub(crate) struct Element {
    pub(crate) tag: u32,
    pub(crate) vr: [u8; 2],
    pub(crate) content: Content,
}

impl Element {
    /// A text element, padded as its representation asks.
    pub(crate) fn text(tag: u32, vr: &[u8; 2], text: &str) -> Self {
        let mut bytes = text.as_bytes().to_vec();
        if bytes.len() % 2 == 1 {
            bytes.push(if vr == b"UI" { 0 } else { b' ' });
        }
        Self { tag, vr: *vr, content: Content::Bytes(bytes) }
    }
    /// An unsigned short.
    pub(crate) fn short(tag: u32, value: u16) -> Self {
        Self { tag, vr: *b"US", content: Content::Bytes(value.to_le_bytes().to_vec()) }
    }
}

/// A UID that is a hash: equal for equal bytes, and not to be turned back (2.25 and a 128-bit number, PS3.5 B.2).
pub(crate) fn uid_of(bytes: &[u8]) -> String {
    let hash = Sha256::new().chain_update(b"vasculum uid").chain_update(bytes).finalize();
    let number = hash.iter().take(16).fold(0u128, |acc, b| (acc << 8) | u128::from(*b));
    format!("2.25.{number}")
}

/// A whole file; the elements may come in any order.
pub(crate) fn file(syntax: &str, class: &str, instance: &str, elements: Vec<Element>) -> Vec<u8> {
    let meta = vec![
        Element { tag: 0x0002_0001, vr: *b"OB", content: Content::Bytes(vec![0, 1]) },
        Element::text(0x0002_0002, b"UI", class),
        Element::text(0x0002_0003, b"UI", instance),
        Element::text(0x0002_0010, b"UI", syntax),
        Element::text(0x0002_0012, b"UI", IMPLEMENTATION),
        Element::text(0x0002_0013, b"SH", "VASCULUM"),
    ];
    let mut header = Vec::new();
    put_all(&mut header, meta);
    let mut out = vec![0; 128];
    out.extend(b"DICM");
    put(
        &mut out,
        Element { tag: 0x0002_0000, vr: *b"UL", content: Content::Bytes((header.len() as u32).to_le_bytes().to_vec()) },
    );
    out.append(&mut header);
    put_all(&mut out, elements);
    out
}

fn put_all(out: &mut Vec<u8>, mut elements: Vec<Element>) {
    elements.sort_by_key(|e| e.tag);
    for e in elements {
        put(out, e);
    }
}

fn put_tag(out: &mut Vec<u8>, tag: u32) {
    out.extend(((tag >> 16) as u16).to_le_bytes());
    out.extend((tag as u16).to_le_bytes());
}

fn put_item(out: &mut Vec<u8>, tag: u32, bytes: &[u8]) {
    put_tag(out, tag);
    let padded = bytes.len() + bytes.len() % 2;
    out.extend((padded as u32).to_le_bytes());
    out.extend(bytes);
    out.resize(out.len() + padded - bytes.len(), 0);
}

fn put(out: &mut Vec<u8>, element: Element) {
    put_tag(out, element.tag);
    out.extend(element.vr);
    let long = [b"OB", b"OW", b"SQ", b"UN"].contains(&&element.vr);
    match element.content {
        Content::Bytes(mut bytes) => {
            bytes.resize(bytes.len() + bytes.len() % 2, 0);
            if long {
                out.extend([0, 0]);
                out.extend((bytes.len() as u32).to_le_bytes());
            } else {
                out.extend((bytes.len() as u16).to_le_bytes());
            }
            out.append(&mut bytes);
        }
        Content::Items(items) => {
            let mut inner = Vec::new();
            for item in items {
                let mut bytes = Vec::new();
                put_all(&mut bytes, item);
                put_item(&mut inner, 0xfffe_e000, &bytes);
            }
            out.extend([0, 0]);
            out.extend((inner.len() as u32).to_le_bytes());
            out.append(&mut inner);
        }
        Content::Fragments(fragments) => {
            out.extend([0, 0]);
            out.extend(u32::MAX.to_le_bytes());
            for f in fragments {
                put_item(out, 0xfffe_e000, &f);
            }
            put_item(out, 0xfffe_e0dd, &[]);
        }
    }
}
