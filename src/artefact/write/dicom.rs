//! A simulated scan as classic MR images (PS3.3 A.4), explicit little endian, 16 bits unsigned.

pub(crate) mod encode;

use crate::read::NamedBytes;
use crate::write::png::whole;
use encode::{Content, EXPLICIT_LITTLE, Element, file, uid_of};
use imaging::Stack;
use space::{FaultKind, Faulty, P3, V3};

/// MR Image Storage.
const MR: &str = "1.2.840.10008.5.1.4.1.1.4";

/// Why a stack is not written.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotWritable {
    /// `write.not_whole`
    #[error("pixel {index} of slice {slice} is {value}; whole numbers from 0 to 65535 are written")]
    NotWhole {
        /// Slice number.
        slice: usize,
        /// Pixel within the slice.
        index: usize,
        /// Its value.
        value: f32,
    },
    /// `write.encoder`
    #[error("the encoder failed: {0}")]
    Encoder(String),
}

impl Faulty for NotWritable {
    fn kind(&self) -> FaultKind {
        FaultKind::Internal
    }
    fn code(&self) -> &'static str {
        match self {
            Self::NotWhole { .. } => "write.not_whole",
            Self::Encoder(_) => "write.encoder",
        }
    }
}

/// The grey values as unsigned shorts, slice by slice.
///
/// # Errors
/// [`NotWritable::NotWhole`].
pub(crate) fn whole_values(stack: &Stack) -> Result<Vec<u16>, NotWritable> {
    let size = (stack.rows * stack.columns).max(1);
    let value =
        |(i, p): (usize, &f32)| whole(*p).ok_or(NotWritable::NotWhole { slice: i / size, index: i % size, value: *p });
    stack.pixels.iter().enumerate().map(value).collect()
}

/// What a simulated scan says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Meta {
    /// Tells one scan from another: equal seeds give equal UIDs.
    pub seed: u64,
    /// SeriesDescription, at most 64 ASCII characters (others are cut or dropped).
    pub description: String,
    /// Order of InstanceNumber against position.
    pub numbering: Numbering,
}

/// How InstanceNumber runs. Real scanners do all of these; a reader must not care.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Numbering {
    /// With the position.
    #[default]
    Ascending,
    /// Against the position.
    Descending,
    /// Odd positions first, as interleaved acquisitions do.
    Interleaved,
}

/// One file per slice, `slice-0000.dcm` and on, along the stack's normal. No patient data beyond `Anonymous`.
///
/// # Errors
/// [`NotWritable`] when a grey value is no whole number from 0 to 65535.
pub fn slices(stack: &Stack, meta: &Meta) -> Result<Vec<NamedBytes>, NotWritable> {
    let values = whole_values(stack)?;
    let size = (stack.rows * stack.columns).max(1);
    Ok(values.chunks_exact(size).enumerate().map(|(k, slice)| one(stack, meta, k, slice)).collect())
}

fn one(stack: &Stack, meta: &Meta, k: usize, values: &[u16]) -> NamedBytes {
    let uid = |what: &str| uid_of(format!("{what} {}", meta.seed).as_bytes());
    let instance = uid(&format!("instance {k}"));
    let mut elements = identity(meta, &uid, &instance);
    elements.extend(geometry(stack, k));
    elements.push(text(0x0020_0013, b"IS", number(meta.numbering, k, stack.slices()).to_string()));
    let largest = values.iter().max().copied().unwrap_or(0);
    elements.extend([
        Element::short(0x0028_0002, 1),
        text(0x0028_0004, b"CS", "MONOCHROME2"),
        Element::short(0x0028_0010, stack.rows as u16),
        Element::short(0x0028_0011, stack.columns as u16),
        Element::short(0x0028_0100, 16),
        Element::short(0x0028_0101, 16),
        Element::short(0x0028_0102, 15),
        Element::short(0x0028_0103, 0),
        text(0x0028_1050, b"DS", (f64::from(largest) / 2.0).to_string()),
        text(0x0028_1051, b"DS", f64::from(largest.max(1)).to_string()),
        text(0x0028_1052, b"DS", "0"),
        text(0x0028_1053, b"DS", "1"),
        text(0x0028_1054, b"LO", "US"),
        Element {
            tag: 0x7fe0_0010,
            vr: *b"OW",
            content: Content::Bytes(values.iter().flat_map(|v| v.to_le_bytes()).collect()),
        },
    ]);
    NamedBytes::new(format!("slice-{k:04}.dcm"), file(EXPLICIT_LITTLE, MR, &instance, elements))
}

fn text(tag: u32, vr: &[u8; 2], text: impl AsRef<str>) -> Element {
    Element::text(tag, vr, text.as_ref())
}

/// Patient, study, series, equipment and MR modules: type 1 attributes filled, type 2 empty.
fn identity(meta: &Meta, uid: &dyn Fn(&str) -> String, instance: &str) -> Vec<Element> {
    let description: String = meta.description.chars().filter(|c| c.is_ascii_graphic() || *c == ' ').take(64).collect();
    vec![
        text(0x0008_0008, b"CS", "DERIVED\\SECONDARY\\OTHER"),
        text(0x0008_0016, b"UI", MR),
        text(0x0008_0018, b"UI", instance),
        text(0x0008_0020, b"DA", ""),
        text(0x0008_0030, b"TM", ""),
        text(0x0008_0050, b"SH", ""),
        text(0x0008_0060, b"CS", "MR"),
        text(0x0008_0070, b"LO", "Vasculum"),
        text(0x0008_0090, b"PN", ""),
        text(0x0008_103e, b"LO", description),
        text(0x0010_0010, b"PN", "Anonymous"),
        text(0x0010_0020, b"LO", "Anonymous"),
        text(0x0010_0030, b"DA", ""),
        text(0x0010_0040, b"CS", ""),
        text(0x0012_0062, b"CS", "YES"),
        text(0x0012_0063, b"LO", "Simulated"),
        text(0x0018_0020, b"CS", "RM"),
        text(0x0018_0021, b"CS", "NONE"),
        text(0x0018_0022, b"CS", ""),
        text(0x0018_0023, b"CS", "2D"),
        text(0x0018_0080, b"DS", ""),
        text(0x0018_0081, b"DS", ""),
        text(0x0018_0091, b"IS", ""),
        text(0x0018_5100, b"CS", "HFS"),
        text(0x0020_000d, b"UI", uid("study")),
        text(0x0020_000e, b"UI", uid("series")),
        text(0x0020_0010, b"SH", "1"),
        text(0x0020_0011, b"IS", "1"),
        text(0x0020_0052, b"UI", uid("frame")),
        text(0x0020_1040, b"LO", ""),
    ]
}

fn geometry(stack: &Stack, k: usize) -> Vec<Element> {
    let [u, v] = [stack.row_direction, stack.column_direction].map(V3::to_array);
    let position: P3 = stack.origins[k];
    let thickness = stack.thickness_mm.map(decimal).unwrap_or_default();
    vec![
        text(0x0018_0050, b"DS", thickness),
        text(0x0020_0032, b"DS", decimals(&position.to_array())),
        text(0x0020_0037, b"DS", decimals(&[u[0], u[1], u[2], v[0], v[1], v[2]])),
        text(0x0028_0030, b"DS", decimals(&stack.pixel_spacing_mm)),
    ]
}

fn number(numbering: Numbering, k: usize, slices: usize) -> usize {
    match numbering {
        Numbering::Ascending => k + 1,
        Numbering::Descending => slices - k,
        Numbering::Interleaved if k.is_multiple_of(2) => slices / 2 + k / 2 + 1,
        Numbering::Interleaved => k / 2 + 1,
    }
}

fn decimals(values: &[f64]) -> String {
    values.iter().map(|x| decimal(*x)).collect::<Vec<_>>().join("\\")
}

/// The nearest decimal string of at most 16 characters (the DS representation).
fn decimal(x: f64) -> String {
    let plain = format!("{}", x + 0.0);
    if plain.len() <= 16 {
        return plain;
    }
    let candidates = (0..=16).rev().flat_map(|digits| [format!("{x:.digits$}"), format!("{x:.digits$e}")]);
    let fits = candidates.filter(|t| t.len() <= 16);
    let error = |t: &str| t.parse::<f64>().map_or(f64::INFINITY, |y| (y - x).abs());
    fits.min_by(|a, b| error(a).total_cmp(&error(b))).unwrap_or_else(|| "0".to_owned())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn decimal_strings_fit_and_stay_near() {
        for x in [0.1, -127.75, 1.0 / 3.0, -std::f64::consts::PI * 100.0, 1.234_567_890_123e-9, -0.000_012_345_678_9] {
            let t = decimal(x);
            let tolerance = 1e-8 * x.abs().max(1e-3);
            assert!(t.len() <= 16 && (t.parse::<f64>().unwrap() - x).abs() <= tolerance, "{x} -> {t}");
        }
        assert_eq!(decimal(-0.0), "0");
    }

    #[test]
    fn numbers_are_a_permutation() {
        for numbering in [Numbering::Ascending, Numbering::Descending, Numbering::Interleaved] {
            for n in [1, 2, 7, 8] {
                let mut all: Vec<usize> = (0..n).map(|k| number(numbering, k, n)).collect();
                all.sort_unstable();
                assert_eq!(all, (1..=n).collect::<Vec<_>>(), "{numbering:?} {n}");
            }
        }
    }
}
