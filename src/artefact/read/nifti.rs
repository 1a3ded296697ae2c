//! NIfTI-1 and NIfTI-2, single files and pairs (.nii, .nii.gz, .hdr with .img): nifti1.h and nifti2.h of the NIMH,
//! methods 1 to 3.
//!
//! The affine is the sform where its code is set, else the qform, else the plain voxel steps (with a warning: such a
//! file does not say where left is). RAS becomes LPS. Singles are read as the decimals they were written from.

use super::fields::companion;
use super::samples::{Order, Sample, decimal, grey};
use super::volume::Volume;
use super::{Error, Limits, NamedBytes};
use space::{P3, Place, V3, Warning};

/// Bytes of the header of each version.
const HEADER: [usize; 2] = [348, 540];

/// Numbers of a header in its byte order.
struct Raw<'a> {
    bytes: &'a [u8],
    order: Order,
}

impl Raw<'_> {
    fn array<const N: usize>(&self, at: usize) -> [u8; N] {
        let mut b: [u8; N] = std::array::from_fn(|i| self.bytes.get(at + i).copied().unwrap_or(0));
        if self.order == Order::Big {
            b.reverse();
        }
        b
    }
    fn short(&self, at: usize) -> i16 {
        i16::from_le_bytes(self.array(at))
    }
    fn int(&self, at: usize) -> i32 {
        i32::from_le_bytes(self.array(at))
    }
    fn long(&self, at: usize) -> i64 {
        i64::from_le_bytes(self.array(at))
    }
    fn single(&self, at: usize) -> f64 {
        decimal(f32::from_le_bytes(self.array(at)))
    }
    fn singles<const N: usize>(&self, at: usize) -> [f64; N] {
        std::array::from_fn(|i| self.single(at + 4 * i))
    }
    fn double(&self, at: usize) -> f64 {
        f64::from_le_bytes(self.array(at))
    }
    fn doubles<const N: usize>(&self, at: usize) -> [f64; N] {
        std::array::from_fn(|i| self.double(at + 8 * i))
    }
}

/// What both versions state, in one form.
struct Header<'a> {
    bytes: &'a [u8],
    order: Order,
    second: bool,
    /// The voxels lie in a file of their own.
    pair: bool,
    dims: [i64; 8],
    datatype: i16,
    pixdim: [f64; 4],
    offset: f64,
    /// Slope and intercept.
    scale: [f64; 2],
    /// qform and sform codes.
    codes: [i32; 2],
    quaternion: [f64; 3],
    shift: [f64; 3],
    rows: [[f64; 4]; 3],
    units: u8,
}

impl<'a> Header<'a> {
    fn parse(file: &str, bytes: &'a [u8]) -> Result<Self, Error> {
        let second = matches!(bytes.get(4..7), Some(b"n+2" | b"ni2"));
        let size = HEADER[usize::from(second)];
        let Some(head) = bytes.get(..size) else {
            let found = bytes.len() as u64;
            return Err(Error::Truncated { file: file.to_owned(), what: "the header", needed: size as u64, found });
        };
        let order = if head.starts_with(&(size as i32).to_be_bytes()) { Order::Big } else { Order::Little };
        let raw = Raw { bytes: head, order };
        Ok(if second { Self::second(&raw, head) } else { Self::first(&raw, head) })
    }
    fn first(raw: &Raw, bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            order: raw.order,
            second: false,
            pair: bytes.get(344..347) == Some(b"ni1"),
            dims: std::array::from_fn(|i| i64::from(raw.short(40 + 2 * i))),
            datatype: raw.short(70),
            pixdim: raw.singles(76),
            offset: raw.single(108),
            scale: raw.singles(112),
            codes: [252, 254].map(|at| i32::from(raw.short(at))),
            quaternion: raw.singles(256),
            shift: raw.singles(268),
            rows: [280, 296, 312].map(|at| raw.singles(at)),
            units: bytes.get(123).copied().unwrap_or(0),
        }
    }
    fn second(raw: &Raw, bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            order: raw.order,
            second: true,
            pair: bytes.get(4..7) == Some(b"ni2"),
            dims: std::array::from_fn(|i| raw.long(16 + 8 * i)),
            datatype: raw.short(12),
            pixdim: raw.doubles(104),
            offset: raw.long(168) as f64,
            scale: raw.doubles(176),
            codes: [344, 348].map(|at| raw.int(at)),
            quaternion: raw.doubles(352),
            shift: raw.doubles(376),
            rows: [400, 432, 464].map(|at| raw.doubles(at)),
            units: (raw.int(500) & 0xff) as u8,
        }
    }
}

/// The name of the file that holds a pair's voxels; `None` for single files.
pub(crate) fn data_file(file: &NamedBytes) -> Option<String> {
    let header = Header::parse(&file.name, &file.bytes).ok()?;
    header.pair.then(|| {
        let stem = file.name.trim_end_matches(".gz");
        format!("{}.img", stem.strip_suffix(".hdr").unwrap_or(stem))
    })
}

/// The voxels' bytes: behind the header, or in the file beside it.
fn voxels<'b>(file: &'b NamedBytes, header: &Header, companions: &[&'b NamedBytes]) -> Result<&'b [u8], Error> {
    let malformed = |reason: String| Error::Malformed { file: file.name.clone(), reason };
    let (bytes, least) = match data_file(file) {
        None => (&file.bytes[..], HEADER[usize::from(header.second)]),
        Some(name) => match companion(companions, &name) {
            Some(bytes) => (bytes, 0),
            None => return Err(malformed("the .img file of its pair was not sent with it".to_owned())),
        },
    };
    if !(header.offset >= least as f64 && header.offset <= bytes.len() as f64) {
        return Err(malformed(format!("its voxels are said to begin at byte {}", header.offset)));
    }
    Ok(&bytes[header.offset as usize..])
}

/// A NIfTI volume (not gzipped); `companions` are the files that may hold a pair's voxels.
///
/// # Errors
/// [`Error::Unsupported`] for time series and complex values; [`Error::Truncated`], [`Error::Malformed`],
/// [`Error::TooLarge`], [`Error::Colour`], [`Error::NotFinite`].
pub(crate) fn volume(
    file: &NamedBytes,
    companions: &[&NamedBytes],
    limits: &Limits,
) -> Result<(Volume, Vec<Warning>), Error> {
    let name = file.name.as_str();
    let header = Header::parse(name, &file.bytes)?;
    let size = size(name, &header)?;
    let count = limits.admit(name, size[0], size[1], size[2])?;
    let sample = sample(name, header.datatype)?;
    let scale = match header.scale {
        [slope, intercept] if slope != 0.0 && slope.is_finite() => (slope, intercept),
        _ => (1.0, 0.0), // 0 by the standard, NaN by nibabel: "not scaled"
    };
    let pixels = grey(name, voxels(file, &header, companions)?, count, (sample, header.order), scale)?;
    let (steps, origin, warnings) = affine(name, &header);
    let size = size.map(|n| n as usize);
    Ok((Volume { file: name.to_owned(), size, steps, origin, pixels, thickness_mm: None }, warnings))
}

fn size(file: &str, header: &Header) -> Result<[u64; 3], Error> {
    let dims = header.dims;
    let rank = dims[0];
    if !(3..=7).contains(&rank) || dims[1..=3].iter().any(|d| !(1..=1 << 32).contains(d)) {
        let reason = format!("its dimensions are {dims:?}; a volume of three is needed");
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    if dims[4..=rank as usize].iter().any(|d| *d > 1) {
        let reason = format!("it holds several volumes (dimensions {dims:?}); send one");
        return Err(Error::Unsupported { file: file.to_owned(), reason });
    }
    Ok([dims[1] as u64, dims[2] as u64, dims[3] as u64])
}

fn sample(file: &str, code: i16) -> Result<Sample, Error> {
    match code {
        2 => Ok(Sample::Unsigned(1)),
        4 => Ok(Sample::Signed(2)),
        8 => Ok(Sample::Signed(4)),
        16 => Ok(Sample::Float),
        64 => Ok(Sample::Double),
        256 => Ok(Sample::Signed(1)),
        512 => Ok(Sample::Unsigned(2)),
        768 => Ok(Sample::Unsigned(4)),
        1024 => Ok(Sample::Signed(8)),
        1280 => Ok(Sample::Unsigned(8)),
        128 | 2304 => Err(Error::Colour { file: file.to_owned() }),
        other => {
            let reason = format!("data type {other} is not read; integers and floats up to 64 bits are");
            Err(Error::Unsupported { file: file.to_owned(), reason })
        }
    }
}

/// Step vectors and origin in LPS mm.
fn affine(file: &str, header: &Header) -> ([V3; 3], P3, Vec<Warning>) {
    let mut warnings = Vec::new();
    let pixdim = header.pixdim;
    let [qform_code, sform_code] = header.codes;
    let rows: [[f64; 4]; 3] = if sform_code > 0 {
        header.rows
    } else if qform_code > 0 {
        qform(header)
    } else {
        let message = "neither sform nor qform is set: the file does not say where left and right are";
        warnings.push(Warning::new("nifti.no_orientation", message, Place::file(file)));
        [[pixdim[1], 0.0, 0.0, 0.0], [0.0, pixdim[2], 0.0, 0.0], [0.0, 0.0, pixdim[3], 0.0]]
    };
    let unit = match header.units & 7 {
        1 => 1e3,
        3 => 1e-3,
        _ => 1.0,
    };
    // RAS -> LPS: the first two axes change sign
    let column = |c: usize| [-unit * rows[0][c], -unit * rows[1][c], unit * rows[2][c]].map(|x| x + 0.0);
    ([0, 1, 2].map(|c| V3::from(column(c))), P3::from(column(3)), warnings)
}

/// Method 2: a unit quaternion (b, c, d), qfac in pixdim[0].
fn qform(header: &Header) -> [[f64; 4]; 3] {
    let Header { pixdim, quaternion: [b, c, d], shift: offset, .. } = *header;
    let a = (1.0 - (b * b + c * c + d * d)).max(0.0).sqrt();
    let r = [
        [a * a + b * b - c * c - d * d, 2.0 * (b * c - a * d), 2.0 * (b * d + a * c)],
        [2.0 * (b * c + a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d - a * b)],
        [2.0 * (b * d - a * c), 2.0 * (c * d + a * b), a * a + d * d - c * c - b * b],
    ];
    let qfac = if pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let step = [pixdim[1], pixdim[2], qfac * pixdim[3]];
    std::array::from_fn(|i| [r[i][0] * step[0], r[i][1] * step[1], r[i][2] * step[2], offset[i]])
}

/// The volume as one file without anything that could name a patient: free text blanked, extensions dropped.
///
/// # Errors
/// [`Error::Truncated`], [`Error::Malformed`] as for reading.
pub(crate) fn anonymous(file: &NamedBytes, companions: &[&NamedBytes]) -> Result<Vec<u8>, Error> {
    let header = Header::parse(&file.name, &file.bytes)?;
    let voxels = voxels(file, &header, companions)?;
    let mut out = header.bytes.to_vec();
    // data_type and db_name, extents .. regular; descrip and aux_file; intent_name (for the second version: descrip and
    // aux_file, intent_name, unused)
    let texts =
        if header.second { vec![240..344, 508..524, 525..540] } else { vec![4..32, 32..39, 148..252, 328..344] };
    for range in texts {
        out[range].fill(0);
    }
    let start = HEADER[usize::from(header.second)] + 4;
    let mut put = |at: usize, mut bytes: Vec<u8>| {
        if header.order == Order::Big {
            bytes.reverse();
        }
        out[at..at + bytes.len()].copy_from_slice(&bytes);
    };
    if header.second {
        put(168, (start as i64).to_le_bytes().to_vec());
        out[4..7].copy_from_slice(b"n+2");
    } else {
        put(108, (start as f32).to_le_bytes().to_vec());
        out[344..347].copy_from_slice(b"n+1");
    }
    out.extend([0; 4]);
    out.extend(voxels);
    Ok(out)
}
