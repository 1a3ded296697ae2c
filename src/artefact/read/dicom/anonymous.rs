//! De-identifying: a DICOM file written anew with the allow-list alone.
//!
//! Everything else is dropped, at any depth; identifiers become hashes that are equal for equal ones; numbers must be
//! numbers and codes short, so that no free text can hide in an allowed element.

use super::dataset::{DataSet, Value};
use super::pixels::{Layout, Syntax};
use super::table::*;
use super::{body, is_image, open};
use crate::read::{Error, Limits};
use crate::write::dicom::encode::{Content, EXPLICIT_LITTLE, Element, file, uid_of};

/// The file without anything that could name a patient; `None` for objects that hold no image.
///
/// # Errors
/// As reading the file: damaged or unsupported files are refused, not passed on.
pub(crate) fn anonymous(name: &str, bytes: &[u8], limits: &Limits) -> Result<Option<Vec<u8>>, Error> {
    let (uid, syntax, body) = body(name, bytes, limits)?;
    let opened = open(name, uid, syntax, &body)?;
    if !is_image(&opened.ds) {
        return Ok(None);
    }
    let layout = Layout::of(name, &opened.ds, limits)?;
    let mut elements = allowed(&opened.ds);
    let pixels = match (opened.syntax, opened.ds.elements.get(&PIXEL_DATA)) {
        (Syntax::Encapsulated, Some(Value::Fragments(f))) => Content::Fragments(f.iter().map(|f| f.to_vec()).collect()),
        _ => Content::Bytes(super::pixels::samples(name, &opened.ds, &opened.uid, &layout)?.into_owned()),
    };
    let syntax = if matches!(pixels, Content::Fragments(_)) { opened.uid.as_str() } else { EXPLICIT_LITTLE };
    let class = opened.ds.text(SOP_CLASS).filter(|t| is_uid(t)).unwrap_or("1.2.840.10008.5.1.4.1.1.4");
    let instance = uid_of(opened.ds.text(SOP_INSTANCE).unwrap_or_default().as_bytes());
    elements.retain(|e| ![SOP_CLASS, SOP_INSTANCE, PIXEL_DATA].contains(&e.tag));
    elements.push(Element::text(SOP_CLASS, b"UI", class));
    elements.push(Element::text(SOP_INSTANCE, b"UI", &instance));
    let vr = if matches!(pixels, Content::Fragments(_)) || opened.ds.short(BITS_ALLOCATED).is_some_and(|b| b <= 8) {
        b"OB"
    } else {
        b"OW"
    };
    elements.push(Element { tag: PIXEL_DATA, vr: *vr, content: pixels });
    Ok(Some(file(syntax, class, &instance, elements)))
}

fn is_uid(text: &str) -> bool {
    text.len() <= 64 && text.bytes().all(|b| b.is_ascii_digit() || b == b'.')
}

/// The elements of a data set that may pass, cleaned.
fn allowed(ds: &DataSet) -> Vec<Element> {
    ds.elements
        .iter()
        .filter_map(|(&tag, value)| {
            let vr = representation(tag)?;
            match value {
                Value::Items(items) if vr == b"SQ" => {
                    let items = items.iter().map(allowed).collect();
                    Some(Element { tag, vr: *vr, content: Content::Items(items) })
                }
                Value::Bytes(..) => clean(ds, tag, vr),
                _ => None,
            }
        })
        .collect()
}

fn clean(ds: &DataSet, tag: Tag, vr: &[u8; 2]) -> Option<Element> {
    match vr {
        b"US" => Some(Element::short(tag, ds.short(tag)?)),
        b"DS" | b"IS" => {
            ds.numbers(tag)?;
            Some(Element::text(tag, vr, ds.text(tag)?))
        }
        b"UI" if tag == SOP_CLASS => ds.text(tag).filter(|t| is_uid(t)).map(|t| Element::text(tag, vr, t)),
        b"UI" => ds.text(tag).map(|t| Element::text(tag, vr, &uid_of(t.as_bytes()))),
        // MR, CT, HFS, 2D, YES: four letters; the photometric interpretation is one of two here
        b"CS" if tag == PHOTOMETRIC => {
            ds.text(tag).filter(|t| matches!(*t, "MONOCHROME1" | "MONOCHROME2")).map(|t| Element::text(tag, vr, t))
        }
        b"CS" => ds
            .text(tag)
            .filter(|t| t.len() <= 4 && t.bytes().all(|b| b.is_ascii_uppercase() || b.is_ascii_digit()))
            .map(|t| Element::text(tag, vr, t)),
        _ => None,
    }
}
