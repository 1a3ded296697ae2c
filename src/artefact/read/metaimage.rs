//! MetaImage (.mha, .mhd with its data file) as ITK writes it.
//!
//! The i-th triple of TransformMatrix is the direction of the i-th index (ITK's convention; the format's own page leaves
//! it open), LPS. AnatomicalOrientation is a comment to ITK and to us.

use super::archive::unzlib;
use super::fields::{Fields, Line};
use super::samples::{Order, Sample, grey};
use super::volume::Volume;
use super::{Error, Limits, NamedBytes};
use space::{P3, Place, V3, Warning};

/// Keys that describe the image; no other passes de-identifying.
const KEYS: [&str; 19] = [
    "ObjectType",
    "NDims",
    "BinaryData",
    "BinaryDataByteOrderMSB",
    "ElementByteOrderMSB",
    "CompressedData",
    "CompressedDataSize",
    "TransformMatrix",
    "Rotation",
    "Orientation",
    "Offset",
    "Position",
    "Origin",
    "ElementSpacing",
    "ElementSize",
    "DimSize",
    "ElementNumberOfChannels",
    "ElementType",
    "HeaderSize",
];

struct Header<'a>(Fields<'a>);

impl<'a> std::ops::Deref for Header<'a> {
    type Target = Fields<'a>;
    fn deref(&self) -> &Fields<'a> {
        &self.0
    }
}

impl<'a> Header<'a> {
    fn parse(file: &'a str, bytes: &'a [u8]) -> Result<Self, Error> {
        let line = |_: usize, text: &'a str| match text.trim().split_once('=') {
            None if text.trim().is_empty() => Line::Nothing,
            None => Line::Foreign,
            Some((key, value)) if key.trim() == "ElementDataFile" => {
                Line::LastField(key.trim().to_owned(), value.trim())
            }
            Some((key, value)) => Line::Field(key.trim().to_owned(), value.trim()),
        };
        match Fields::parse(file, bytes, line)? {
            (fields, true) => Ok(Self(fields)),
            (fields, false) => Err(fields.malformed("its header names no ElementDataFile")),
        }
    }
    fn truth(&self, keys: &[&str]) -> bool {
        self.any(keys).is_some_and(|v| v.eq_ignore_ascii_case("true") || v == "1")
    }
    /// The data file's name, unless the data follows the header.
    fn data_file(&self) -> Option<&'a str> {
        self.get("ElementDataFile").filter(|name| !name.eq_ignore_ascii_case("LOCAL"))
    }
    fn sample(&self) -> Result<Sample, Error> {
        match self.get("ElementType").unwrap_or_default() {
            "MET_UCHAR" => Ok(Sample::Unsigned(1)),
            "MET_CHAR" => Ok(Sample::Signed(1)),
            "MET_USHORT" => Ok(Sample::Unsigned(2)),
            "MET_SHORT" => Ok(Sample::Signed(2)),
            "MET_UINT" => Ok(Sample::Unsigned(4)),
            "MET_INT" => Ok(Sample::Signed(4)),
            "MET_ULONG_LONG" => Ok(Sample::Unsigned(8)),
            "MET_LONG_LONG" => Ok(Sample::Signed(8)),
            "MET_FLOAT" => Ok(Sample::Float),
            "MET_DOUBLE" => Ok(Sample::Double),
            _ => Err(self.unsupported("its ElementType is not read; save it as MET_SHORT or MET_FLOAT")),
        }
    }
    fn size(&self) -> Result<[u64; 3], Error> {
        let dims = self.numbers::<1>("NDims", self.get("NDims").unwrap_or_default())?[0];
        if dims != 3.0 {
            return Err(self.unsupported(format!("it has {dims} dimensions; a volume of 3 is needed")));
        }
        self.0.size("DimSize")
    }
    fn geometry(&self) -> Result<([V3; 3], P3, Vec<Warning>), Error> {
        let Some(spacing) = self.any(&["ElementSpacing", "ElementSize"]) else {
            let reason = "the header has no ElementSpacing; add it".to_owned();
            let file = Some(self.file.to_owned());
            return Err(Error::GeometryMissing { file, field: "geometry.pixel_spacing_mm", reason });
        };
        let spacing = self.numbers::<3>("ElementSpacing", spacing)?;
        let mut warnings = Vec::new();
        let matrix = match self.any(&["TransformMatrix", "Rotation", "Orientation"]) {
            Some(text) => self.numbers::<9>("TransformMatrix", text)?,
            None => {
                let message = "no TransformMatrix: the axes of the volume are taken as those of the patient (LPS)";
                warnings.push(Warning::new("metaimage.no_orientation", message, Place::file(self.file)));
                [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
            }
        };
        let origin = match self.any(&["Offset", "Position", "Origin"]) {
            Some(text) => self.numbers::<3>("Offset", text)?,
            None => [0.0; 3],
        };
        let step = |i: usize| V3::new(matrix[3 * i], matrix[3 * i + 1], matrix[3 * i + 2]) * spacing[i];
        Ok(([step(0), step(1), step(2)], P3::from(origin), warnings))
    }
    fn header_size(&self) -> Result<f64, Error> {
        self.get("HeaderSize").map_or(Ok(0.0), |v| self.numbers::<1>("HeaderSize", v).map(|n| n[0]))
    }
}

/// The name of the data file that a header refers to; `None` when the data follows the header.
pub(crate) fn data_file(file: &NamedBytes) -> Option<String> {
    Header::parse(&file.name, &file.bytes).ok()?.data_file().map(str::to_owned)
}

/// A MetaImage volume; `companions` are the files that may hold its data.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Unsupported`], [`Error::Truncated`], [`Error::TooLarge`], [`Error::GeometryMissing`],
/// [`Error::Colour`], [`Error::NotFinite`].
pub(crate) fn volume(
    file: &NamedBytes,
    companions: &[&NamedBytes],
    limits: &Limits,
) -> Result<(Volume, Vec<Warning>), Error> {
    let h = Header::parse(&file.name, &file.bytes)?;
    if h.get("BinaryData").is_some_and(|v| v.eq_ignore_ascii_case("false")) {
        return Err(h.unsupported("data written as text is not read; save it as binary"));
    }
    if h.get("ElementNumberOfChannels").is_some_and(|v| v != "1") {
        return Err(Error::Colour { file: file.name.clone() });
    }
    let sample = h.sample()?;
    let size = h.size()?;
    let count = limits.admit(&file.name, size[0], size[1], size[2])?;
    let needed = count as u64 * sample.bytes() as u64;
    let (steps, origin, warnings) = h.geometry()?;
    let data = h.data(h.data_file(), companions)?;
    let inflated;
    let data = if h.truth(&["CompressedData"]) {
        inflated = unzlib(&file.name, data, needed, limits)?;
        &inflated[..]
    } else {
        let skip = match h.header_size()? {
            n if n < 0.0 => (data.len() as u64).saturating_sub(needed) as usize,
            n => (n as usize).min(data.len()),
        };
        &data[skip..]
    };
    let msb = h.truth(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"]);
    let order = if msb { Order::Big } else { Order::Little };
    let pixels = grey(&file.name, data, count, (sample, order), (1.0, 0.0))?;
    let size = size.map(|n| n as usize);
    Ok((Volume { file: file.name.clone(), size, steps, origin, pixels, thickness_mm: None }, warnings))
}

/// The volume as one .mha file with the known keys alone; values are numbers and single words.
///
/// # Errors
/// As [`volume`] for headers that cannot be parsed or whose data file is absent.
pub(crate) fn anonymous(file: &NamedBytes, companions: &[&NamedBytes]) -> Result<Vec<u8>, Error> {
    let h = Header::parse(&file.name, &file.bytes)?;
    let data = h.data(h.data_file(), companions)?;
    let mut out = String::new();
    for (key, value) in &h.fields {
        let word =
            |t: &str| t.parse::<f64>().is_ok() || t.starts_with("MET_") || ["True", "False", "Image"].contains(&t);
        if KEYS.contains(&key.as_str()) && value.split_whitespace().all(word) {
            out += &format!("{key} = {value}\n");
        }
    }
    out += "ElementDataFile = LOCAL\n";
    let mut bytes = out.into_bytes();
    bytes.extend(data);
    Ok(bytes)
}
