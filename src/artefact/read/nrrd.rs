//! NRRD (teem.sourceforge.net/nrrd/format.html): three axes, raw or gzip, attached or one data file.

use super::archive::gunzip;
use super::fields::{Fields, Line};
use super::samples::{Order, Sample, grey};
use super::volume::Volume;
use super::{Error, Limits, NamedBytes};
use space::{P3, Place, V3, Warning};

/// Fields that describe the image; no other passes de-identifying.
const FIELDS: [&str; 10] = [
    "type",
    "dimension",
    "space",
    "space dimension",
    "sizes",
    "space directions",
    "space origin",
    "spacings",
    "endian",
    "encoding",
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
        let line = |number: usize, text: &'a str| match text.split_once(": ") {
            // the magic, comments and key/value pairs are not fields
            _ if number == 0 || text.starts_with('#') || text.contains(":=") => Line::Nothing,
            _ if text.trim().is_empty() => Line::End,
            Some((key, value)) => Line::Field(key.trim().to_ascii_lowercase(), value.trim()),
            None => Line::Foreign,
        };
        // a detached header may end without an empty line
        Ok(Self(Fields::parse(file, bytes, line)?.0))
    }
    fn data_file(&self) -> Option<&'a str> {
        self.get("data file").or_else(|| self.get("datafile"))
    }
    fn sample(&self) -> Result<Sample, Error> {
        match self.get("type").unwrap_or_default() {
            "signed char" | "int8" | "int8_t" => Ok(Sample::Signed(1)),
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => Ok(Sample::Unsigned(1)),
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Ok(Sample::Signed(2)),
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Ok(Sample::Unsigned(2)),
            "int" | "signed int" | "int32" | "int32_t" => Ok(Sample::Signed(4)),
            "uint" | "unsigned int" | "uint32" | "uint32_t" => Ok(Sample::Unsigned(4)),
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => Ok(Sample::Signed(8)),
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
                Ok(Sample::Unsigned(8))
            }
            "float" => Ok(Sample::Float),
            "double" => Ok(Sample::Double),
            _ => Err(self.unsupported("its type is not read; save it as short or float")),
        }
    }
    fn size(&self) -> Result<[u64; 3], Error> {
        if self.get("dimension") != Some("3") {
            return Err(self.unsupported("it does not have 3 dimensions; send one grey volume"));
        }
        let size = self.numbers("sizes", self.get("sizes").unwrap_or_default())?;
        if size.iter().any(|n| *n < 1.0 || *n > 1e9 || n.fract() != 0.0) {
            return Err(self.malformed(format!("sizes are {size:?}")));
        }
        Ok(size.map(|n| n as u64))
    }
    fn geometry(&self) -> Result<([V3; 3], P3, Vec<Warning>), Error> {
        let mut warnings = Vec::new();
        let origin = self.get("space origin").map_or(Ok([0.0; 3]), |t| self.numbers("space origin", t))?;
        if let Some(text) = self.get("space directions") {
            // each axis' vector in parentheses
            let parts: Vec<&str> = text.split(')').map(str::trim).filter(|t| !t.is_empty()).collect();
            let [a, b, c] = parts[..] else { return Err(self.malformed("space directions does not hold 3 vectors")) };
            let sign = self.space()?;
            let lps = |t: [f64; 3]| [sign[0] * t[0] + 0.0, sign[1] * t[1] + 0.0, sign[2] * t[2] + 0.0];
            let step = |t: &str| Ok::<_, Error>(V3::from(lps(self.numbers("space directions", t)?)));
            return Ok(([step(a)?, step(b)?, step(c)?], P3::from(lps(origin)), warnings));
        }
        let Some(text) = self.get("spacings") else {
            let reason = "the header has neither space directions nor spacings; add one".to_owned();
            let file = Some(self.file.to_owned());
            return Err(Error::GeometryMissing { file, field: "geometry.pixel_spacing_mm", reason });
        };
        let message = "no space directions: the axes of the volume are taken as those of the patient (LPS)";
        warnings.push(Warning::new("nrrd.no_orientation", message, Place::file(self.file)));
        let s: [f64; 3] = self.numbers("spacings", text)?;
        Ok(([V3::X * s[0], V3::Y * s[1], V3::Z * s[2]], P3::from(origin), warnings))
    }
    /// Signs that turn the file's space into LPS.
    fn space(&self) -> Result<[f64; 3], Error> {
        match self.get("space").unwrap_or_default().to_ascii_lowercase().as_str() {
            "left-posterior-superior" | "lps" => Ok([1.0, 1.0, 1.0]),
            "right-anterior-superior" | "ras" => Ok([-1.0, -1.0, 1.0]),
            "left-anterior-superior" | "las" => Ok([1.0, -1.0, 1.0]),
            _ => Err(self.unsupported("its space is not one of LPS, RAS, LAS; save it in one of them")),
        }
    }
}

/// The name of the data file that a header refers to; `None` when the data follows the header.
pub(crate) fn data_file(file: &NamedBytes) -> Option<String> {
    Header::parse(&file.name, &file.bytes).ok()?.data_file().map(str::to_owned)
}

/// An NRRD volume; `companions` are the files that may hold its data.
///
/// # Errors
/// [`Error::Malformed`], [`Error::Unsupported`], [`Error::Truncated`], [`Error::TooLarge`], [`Error::GeometryMissing`],
/// [`Error::NotFinite`].
pub(crate) fn volume(
    file: &NamedBytes,
    companions: &[&NamedBytes],
    limits: &Limits,
) -> Result<(Volume, Vec<Warning>), Error> {
    let h = Header::parse(&file.name, &file.bytes)?;
    if ["line skip", "lineskip", "byte skip", "byteskip"].iter().any(|k| h.get(k).is_some_and(|v| v != "0")) {
        return Err(h.unsupported("skipped lines or bytes are not read; save it as one .nrrd file"));
    }
    let sample = h.sample()?;
    let size = h.size()?;
    let count = limits.admit(&file.name, size[0], size[1], size[2])?;
    let (steps, origin, warnings) = h.geometry()?;
    let data = h.data(h.data_file(), companions)?;
    let inflated;
    let data = match h.get("encoding").unwrap_or_default() {
        "raw" => data,
        "gzip" | "gz" => {
            inflated = gunzip(&file.name, data, limits)?;
            &inflated[..]
        }
        _ => return Err(h.unsupported("its encoding is not read; raw and gzip are")),
    };
    let order = match h.get("endian") {
        Some("big") => Order::Big,
        Some("little") => Order::Little,
        _ if sample.bytes() == 1 => Order::Little,
        _ => return Err(h.malformed("it does not state its endian")),
    };
    let pixels = grey(&file.name, data, count, (sample, order), (1.0, 0.0))?;
    let size = size.map(|n| n as usize);
    Ok((Volume { file: file.name.clone(), size, steps, origin, pixels, thickness_mm: None }, warnings))
}

/// The volume as one .nrrd file with the known fields alone; values are numbers and words of the format.
///
/// # Errors
/// As [`volume`] for headers that cannot be parsed or whose data file is absent.
pub(crate) fn anonymous(file: &NamedBytes, companions: &[&NamedBytes]) -> Result<Vec<u8>, Error> {
    let h = Header::parse(&file.name, &file.bytes)?;
    h.sample()?;
    if h.get("space directions").is_some() {
        h.space()?;
    }
    let data = h.data(h.data_file(), companions)?;
    let mut out = String::from("NRRD0004\n");
    for (key, value) in &h.fields {
        let numeric = value.bytes().all(|b| b.is_ascii_digit() || b" ().,+-eE".contains(&b));
        let word = ["type", "space"].contains(&key.as_str()) || ["raw", "gzip", "gz", "little", "big"].contains(value);
        if FIELDS.contains(&key.as_str()) && (numeric || word) {
            out += &format!("{key}: {value}\n");
        }
    }
    out.push('\n');
    let mut bytes = out.into_bytes();
    bytes.extend(data);
    Ok(bytes)
}
