//! NIfTI-1 single files (.nii, .nii.gz): nifti1.h of the NIMH, methods 1 to 3.
//!
//! The affine is the sform where its code is set, else the qform, else the plain voxel steps (with a warning: such a
//! file does not say where left is). RAS becomes LPS. Singles are read as the decimals they were written from.

use super::samples::{Order, Sample, decimal, grey};
use super::volume::Volume;
use super::{Error, Limits};
use space::{P3, Place, V3, Warning};

/// Bytes of the header.
pub(crate) const HEADER: usize = 348;

struct Header<'a> {
    bytes: &'a [u8],
    order: Order,
}

impl Header<'_> {
    fn short(&self, at: usize) -> i16 {
        let b = [self.bytes[at], self.bytes[at + 1]];
        if self.order == Order::Little { i16::from_le_bytes(b) } else { i16::from_be_bytes(b) }
    }
    fn single(&self, at: usize) -> f32 {
        let b = [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2], self.bytes[at + 3]];
        if self.order == Order::Little { f32::from_le_bytes(b) } else { f32::from_be_bytes(b) }
    }
    /// `count` singles as decimals.
    fn decimals<const N: usize>(&self, at: usize) -> [f64; N] {
        std::array::from_fn(|i| decimal(self.single(at + 4 * i)))
    }
}

/// A NIfTI-1 volume (not gzipped).
///
/// # Errors
/// [`Error::Unsupported`] for pairs, NIfTI-2, time series and complex values; [`Error::Truncated`],
/// [`Error::Malformed`], [`Error::TooLarge`], [`Error::Colour`], [`Error::NotFinite`].
pub(crate) fn volume(file: &str, bytes: &[u8], limits: &Limits) -> Result<(Volume, Vec<Warning>), Error> {
    let header = header(file, bytes)?;
    let size = size(file, &header)?;
    let count = limits.admit(file, size[0] as u64, size[1] as u64, size[2] as u64)?;
    let sample = sample(file, header.short(70))?;
    let offset = f64::from(header.single(108));
    if !(offset >= HEADER as f64 && offset <= bytes.len() as f64) {
        let reason = format!("its voxels are said to begin at byte {offset}");
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    let slope = f64::from(header.single(112));
    let scale = match slope {
        0.0 => (1.0, 0.0),
        s if s.is_finite() => (s, f64::from(header.single(116))),
        _ => (1.0, 0.0), // nibabel writes NaN for "not scaled"
    };
    let pixels = grey(file, &bytes[offset as usize..], count, (sample, header.order), scale)?;
    let (steps, origin, warnings) = affine(file, &header);
    Ok((Volume { file: file.to_owned(), size, steps, origin, pixels, thickness_mm: None }, warnings))
}

fn header<'a>(file: &str, bytes: &'a [u8]) -> Result<Header<'a>, Error> {
    let unsupported = |reason: &str| Err(Error::Unsupported { file: file.to_owned(), reason: reason.to_owned() });
    if matches!(bytes.get(4..7), Some(b"n+2" | b"ni2")) {
        return unsupported("NIfTI-2 is not read; save it as NIfTI-1 (.nii or .nii.gz)");
    }
    if bytes.get(344..347) == Some(b"ni1") {
        return unsupported("a NIfTI pair (.hdr and .img) is not read; save it as one .nii file");
    }
    let Some(head) = bytes.get(..HEADER) else {
        let found = bytes.len() as u64;
        return Err(Error::Truncated { file: file.to_owned(), what: "the header", needed: HEADER as u64, found });
    };
    let order = if head.starts_with(&348i32.to_be_bytes()) { Order::Big } else { Order::Little };
    Ok(Header { bytes: head, order })
}

fn size(file: &str, header: &Header) -> Result<[usize; 3], Error> {
    let dims: Vec<i16> = (0..8).map(|i| header.short(40 + 2 * i)).collect();
    let rank = dims[0];
    if !(3..=7).contains(&rank) || dims[1..=3].iter().any(|d| *d < 1) {
        let reason = format!("its dimensions are {dims:?}; a volume of three is needed");
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    if dims[4..=rank as usize].iter().any(|d| *d > 1) {
        let reason = format!("it holds several volumes (dimensions {dims:?}); send one");
        return Err(Error::Unsupported { file: file.to_owned(), reason });
    }
    Ok([dims[1] as usize, dims[2] as usize, dims[3] as usize])
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
    let pixdim: [f64; 4] = header.decimals(76);
    let rows: [[f64; 4]; 3] = if header.short(254) > 0 {
        [header.decimals(280), header.decimals(296), header.decimals(312)]
    } else if header.short(252) > 0 {
        qform(header, pixdim)
    } else {
        let message = "neither sform nor qform is set: the file does not say where left and right are";
        warnings.push(Warning::new("nifti.no_orientation", message, Place::file(file)));
        [[pixdim[1], 0.0, 0.0, 0.0], [0.0, pixdim[2], 0.0, 0.0], [0.0, 0.0, pixdim[3], 0.0]]
    };
    let unit = match header.bytes[123] & 7 {
        1 => 1e3,
        3 => 1e-3,
        _ => 1.0,
    };
    // RAS -> LPS: the first two axes change sign
    let column = |c: usize| [-unit * rows[0][c], -unit * rows[1][c], unit * rows[2][c]].map(|x| x + 0.0);
    ([0, 1, 2].map(|c| V3::from(column(c))), P3::from(column(3)), warnings)
}

/// Method 2: a unit quaternion (b, c, d), qfac in pixdim[0].
fn qform(header: &Header, pixdim: [f64; 4]) -> [[f64; 4]; 3] {
    let [b, c, d]: [f64; 3] = header.decimals(256);
    let offset: [f64; 3] = header.decimals(268);
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

/// The file without anything that could name a patient: free text blanked, extensions dropped.
///
/// # Errors
/// [`Error::Unsupported`], [`Error::Truncated`], [`Error::Malformed`] as for reading.
pub(crate) fn anonymous(file: &str, bytes: &[u8]) -> Result<Vec<u8>, Error> {
    let header = header(file, bytes)?;
    let offset = f64::from(header.single(108));
    if !(offset >= HEADER as f64 && offset <= bytes.len() as f64) {
        let reason = format!("its voxels are said to begin at byte {offset}");
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    let mut out = header.bytes.to_vec();
    // data_type and db_name, extents .. regular; descrip and aux_file; intent_name
    for range in [4..32, 148..252, 328..344] {
        out[range].fill(0);
    }
    let start = 352.0f32;
    out[108..112].copy_from_slice(&if header.order == Order::Little {
        start.to_le_bytes()
    } else {
        start.to_be_bytes()
    });
    out.extend([0; 4]);
    out.extend(&bytes[offset as usize..]);
    Ok(out)
}
