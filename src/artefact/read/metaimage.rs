//! MetaImage (.mha, .mhd with its data file) as ITK writes it.
//!
//! The i-th triple of TransformMatrix is the direction of the i-th index (ITK's convention; the format's own page leaves
//! it open), LPS. AnatomicalOrientation is a comment to ITK and to us.

use super::archive::unzlib;
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

/// A header is shorter than this.
const MAX_HEADER: usize = 64 << 10;

struct Header<'a> {
    file: &'a str,
    fields: Vec<(&'a str, &'a str)>,
    /// Bytes after the header.
    rest: &'a [u8],
}

impl<'a> Header<'a> {
    fn parse(file: &'a str, bytes: &'a [u8]) -> Result<Self, Error> {
        let malformed = |reason: &str| Error::Malformed { file: file.to_owned(), reason: reason.to_owned() };
        let mut fields = Vec::new();
        let mut at = 0;
        while at < bytes.len().min(MAX_HEADER) {
            let line = bytes[at..].split(|b| *b == b'\n').next().unwrap_or_default();
            at = (at + line.len() + 1).min(bytes.len());
            let text = std::str::from_utf8(line).map_err(|_| malformed("a line of its header is no text"))?.trim();
            if text.is_empty() {
                continue;
            }
            let (key, value) =
                text.split_once('=').ok_or_else(|| malformed("a line of its header is not Key = value"))?;
            fields.push((key.trim(), value.trim()));
            if key.trim() == "ElementDataFile" {
                return Ok(Self { file, fields, rest: &bytes[at..] });
            }
        }
        Err(malformed("its header names no ElementDataFile"))
    }
    fn get(&self, key: &str) -> Option<&'a str> {
        self.fields.iter().find(|(k, _)| *k == key).map(|(_, v)| *v)
    }
    fn any(&self, keys: &[&str]) -> Option<&'a str> {
        keys.iter().find_map(|k| self.get(k))
    }
    fn malformed(&self, reason: impl Into<String>) -> Error {
        Error::Malformed { file: self.file.to_owned(), reason: reason.into() }
    }
    fn unsupported(&self, reason: impl Into<String>) -> Error {
        Error::Unsupported { file: self.file.to_owned(), reason: reason.into() }
    }
    fn numbers<const N: usize>(&self, key: &str, text: &str) -> Result<[f64; N], Error> {
        let parsed: Option<Vec<f64>> =
            text.split_whitespace().map(|t| t.parse().ok().filter(|x: &f64| x.is_finite())).collect();
        parsed
            .and_then(|v| <[f64; N]>::try_from(v).ok())
            .ok_or_else(|| self.malformed(format!("{key} does not hold {N} numbers")))
    }
    fn truth(&self, keys: &[&str]) -> bool {
        self.any(keys).is_some_and(|v| v.eq_ignore_ascii_case("true") || v == "1")
    }
    /// The data file's name, unless the data follows the header.
    fn data_file(&self) -> Option<&'a str> {
        self.get("ElementDataFile").filter(|name| !name.eq_ignore_ascii_case("LOCAL"))
    }
    /// The bytes of the image, compressed or not, HeaderSize not yet skipped.
    fn data<'b>(&self, companions: &[&'b NamedBytes]) -> Result<&'b [u8], Error>
    where
        'a: 'b,
    {
        let Some(name) = self.data_file() else { return Ok(self.rest) };
        if name.starts_with("LIST") || name.contains('%') {
            return Err(self.unsupported("one data file per slice is not read; save the volume as one .mha file"));
        }
        companion(companions, name)
            .ok_or_else(|| self.malformed("the data file that its header names was not sent with it"))
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
        let size = self.numbers::<3>("DimSize", self.get("DimSize").unwrap_or_default())?;
        if size.iter().any(|n| *n < 1.0 || *n > 1e9 || n.fract() != 0.0) {
            return Err(self.malformed(format!("DimSize is {size:?}")));
        }
        Ok(size.map(|n| n as u64))
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

/// A file by the last part of its name.
pub(crate) fn companion<'b>(files: &[&'b NamedBytes], name: &str) -> Option<&'b [u8]> {
    let base = |n: &str| n.rsplit(['/', '\\']).next().unwrap_or_default().to_owned();
    files.iter().find(|f| base(&f.name) == base(name)).map(|f| f.bytes.as_slice())
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
    let data = h.data(companions)?;
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
    let data = h.data(companions)?;
    let mut out = String::new();
    for (key, value) in &h.fields {
        let word =
            |t: &str| t.parse::<f64>().is_ok() || t.starts_with("MET_") || ["True", "False", "Image"].contains(&t);
        if KEYS.contains(key) && value.split_whitespace().all(word) {
            out += &format!("{key} = {value}\n");
        }
    }
    out += "ElementDataFile = LOCAL\n";
    let mut bytes = out.into_bytes();
    bytes.extend(data);
    Ok(bytes)
}
