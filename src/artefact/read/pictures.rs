//! Grey pictures (PNG, PGM, JPEG, TIFF with one or many pages) in natural name order, placed by the plan's geometry.
//!
//! Values are the stored ones, never stretched. Colour is refused; grey stored as three equal channels is grey.

use super::volume::{Frame, Placed, Placement, orthonormal, place};
use super::{Error, Limits, NamedBytes};
use crate::plan::{Geometry, PlanFaults};
use image::{DynamicImage, ImageReader};
use space::{P3, V3};
use std::cmp::Ordering;
use std::io::Cursor;
use tiff::decoder::{Decoder, DecodingResult};

/// One picture.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Page {
    pub(crate) source: String,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    pub(crate) pixels: Vec<f32>,
}

/// The stack of some pictures.
///
/// # Errors
/// [`Error::GeometryMissing`] when the plan gives no scale, [`Error::UnequalSizes`], [`Error::Colour`],
/// [`Error::Malformed`], [`Error::TooLarge`], [`Error::Plan`] when `slice_positions_mm` has another length.
pub(crate) fn stack(files: &[NamedBytes], geometry: &Geometry, limits: &Limits) -> Result<Placement, Error> {
    let pages = pages(files, limits)?;
    let positions = positions(geometry, pages.len())?;
    let missing = |field, reason: &str| Error::GeometryMissing { file: None, field, reason: reason.to_owned() };
    let spacing = geometry.pixel_spacing_mm.ok_or_else(|| {
        missing(
            "geometry.pixel_spacing_mm",
            "pictures carry no scale; give pixel_spacing_mm and slice_spacing_mm in a plan",
        )
    })?;
    let u = geometry.row_direction.map_or(V3::X, V3::from);
    let v = geometry.column_direction.map_or(V3::Y, V3::from);
    let directions = orthonormal(u, v).map_err(|degrees| {
        PlanFaults::invalid("geometry.column_direction", format!("{degrees:.3} degrees away from a right angle"))
    })?;
    refuse_unequal(&pages)?;
    let (columns, rows) = (pages[0].columns, pages[0].rows);
    let origin = geometry.origin_mm.map_or(P3::ORIGIN, P3::from);
    let normal = directions[0].cross(directions[1]);
    let placed = pages.into_iter().zip(positions).map(|(page, offset)| Placed {
        source: page.source,
        origin: origin + normal * offset,
        pixels: page.pixels,
    });
    place(placed.collect(), &Frame { columns, rows, spacing, directions, thickness_mm: None }, limits)
}

/// Offsets of the slices along the normal from the first.
fn positions(geometry: &Geometry, slices: usize) -> Result<Vec<f64>, Error> {
    if let Some(p) = &geometry.slice_positions_mm {
        if p.len() != slices {
            let message = format!("{} positions for {slices} slices", p.len());
            return Err(PlanFaults::invalid("geometry.slice_positions_mm", message).into());
        }
        return Ok(p.iter().map(|x| x - p[0]).collect());
    }
    let step = geometry.slice_spacing_mm.ok_or_else(|| Error::GeometryMissing {
        file: None,
        field: if geometry.pixel_spacing_mm.is_none() {
            "geometry.pixel_spacing_mm"
        } else {
            "geometry.slice_spacing_mm"
        },
        reason: "pictures carry no scale; give pixel_spacing_mm and slice_spacing_mm in a plan".to_owned(),
    })?;
    Ok((0..slices).map(|k| k as f64 * step).collect())
}

fn refuse_unequal(pages: &[Page]) -> Result<(), Error> {
    let size = |p: &Page| (p.rows, p.columns);
    let Some(odd) = pages.iter().find(|p| size(p) != size(&pages[0])) else { return Ok(()) };
    let like_first = pages.iter().filter(|p| size(p) == size(&pages[0])).count();
    let (found, expected) = if 2 * like_first >= pages.len() { (odd, &pages[0]) } else { (&pages[0], odd) };
    let in_words = |p: &Page| format!("{} x {}", p.rows, p.columns);
    Err(Error::UnequalSizes { file: found.source.clone(), found: in_words(found), expected: in_words(expected) })
}

/// All pages of all files, files in natural name order.
///
/// # Errors
/// As [`stack`].
pub(crate) fn pages(files: &[NamedBytes], limits: &Limits) -> Result<Vec<Page>, Error> {
    let mut files: Vec<&NamedBytes> = files.iter().collect();
    files.sort_by(|a, b| natural(&a.name, &b.name));
    let mut pages: Vec<Page> = Vec::new();
    let mut total = 0u64;
    for file in files {
        let tiff = file.bytes.starts_with(b"II") || file.bytes.starts_with(b"MM");
        let more = if tiff { tiff_pages(file, limits)? } else { vec![picture(file, limits)?] };
        total += more.iter().map(|p| p.pixels.len() as u64).sum::<u64>();
        if total > limits.pixels {
            let (what, limit) = ("the number of pixels", limits.pixels);
            return Err(Error::TooLarge { file: Some(file.name.clone()), what, value: total, limit });
        }
        pages.extend(more);
    }
    match pages.is_empty() {
        true => Err(Error::NoImages { files: 0 }),
        false => Ok(pages),
    }
}

/// Numbers within names count as numbers: `slice2` before `slice10`.
pub(crate) fn natural(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a, b);
    while let (Some(p), Some(q)) = (x.chars().next(), y.chars().next()) {
        if p.is_ascii_digit() && q.is_ascii_digit() {
            let run = |s: &str| s.find(|c: char| !c.is_ascii_digit()).unwrap_or(s.len());
            let (m, n) = (run(x), run(y));
            let (i, j) = (x[..m].trim_start_matches('0'), y[..n].trim_start_matches('0'));
            match i.len().cmp(&j.len()).then_with(|| i.cmp(j)) {
                Ordering::Equal => (x, y) = (&x[m..], &y[n..]),
                other => return other,
            }
        } else {
            match p.cmp(&q) {
                Ordering::Equal => (x, y) = (&x[p.len_utf8()..], &y[q.len_utf8()..]),
                other => return other,
            }
        }
    }
    x.len().cmp(&y.len()).then_with(|| a.cmp(b))
}

fn malformed(file: &NamedBytes, e: impl std::fmt::Display) -> Error {
    Error::Malformed { file: file.name.clone(), reason: e.to_string() }
}

fn picture(file: &NamedBytes, limits: &Limits) -> Result<Page, Error> {
    let reader = || {
        let mut reader = ImageReader::new(Cursor::new(file.bytes.as_slice())).with_guessed_format()?;
        let mut image_limits = image::Limits::default();
        // 8 bytes: the widest pixel that is read (four channels of 16 bits)
        image_limits.max_alloc = Some(limits.pixels.saturating_mul(8));
        reader.limits(image_limits);
        Ok::<_, std::io::Error>(reader)
    };
    let size = reader().map_err(|e| malformed(file, e))?.into_dimensions().map_err(|e| malformed(file, e))?;
    limits.admit(&file.name, u64::from(size.0), u64::from(size.1), 1)?;
    let image = reader().map_err(|e| malformed(file, e))?.decode().map_err(|e| malformed(file, e))?;
    let (columns, rows) = (image.width() as usize, image.height() as usize);
    let pixels = grey(image).ok_or_else(|| Error::Colour { file: file.name.clone() })?;
    Ok(Page { source: file.name.clone(), columns, rows, pixels })
}

/// Grey values; `None` when the channels differ or something is transparent.
fn grey(image: DynamicImage) -> Option<Vec<f32>> {
    fn equal<T: Copy + PartialEq + Into<f32>>(samples: &[T], channels: usize, opaque: T) -> Option<Vec<f32>> {
        let colours = channels - usize::from(channels.is_multiple_of(2));
        let value = |p: &[T]| {
            let same = p[..colours].iter().all(|c| *c == p[0]) && p[colours..].iter().all(|a| *a == opaque);
            same.then(|| p[0].into())
        };
        samples.chunks_exact(channels).map(value).collect()
    }
    match &image {
        DynamicImage::ImageLuma8(i) => equal(i, 1, u8::MAX),
        DynamicImage::ImageLumaA8(i) => equal(i, 2, u8::MAX),
        DynamicImage::ImageRgb8(i) => equal(i, 3, u8::MAX),
        DynamicImage::ImageRgba8(i) => equal(i, 4, u8::MAX),
        DynamicImage::ImageLuma16(i) => equal(i, 1, u16::MAX),
        DynamicImage::ImageLumaA16(i) => equal(i, 2, u16::MAX),
        DynamicImage::ImageRgb16(i) => equal(i, 3, u16::MAX),
        DynamicImage::ImageRgba16(i) => equal(i, 4, u16::MAX),
        _ => None,
    }
}

fn tiff_pages(file: &NamedBytes, limits: &Limits) -> Result<Vec<Page>, Error> {
    let bad = |e: tiff::TiffError| malformed(file, e);
    let mut caps = tiff::decoder::Limits::default();
    caps.decoding_buffer_size = usize::try_from(limits.pixels.saturating_mul(8)).unwrap_or(usize::MAX);
    let mut decoder = Decoder::new(Cursor::new(file.bytes.as_slice())).map_err(bad)?.with_limits(caps);
    let mut pages = Vec::new();
    let mut total = 0u64;
    loop {
        let (columns, rows) = decoder.dimensions().map_err(bad)?;
        let count = limits.admit(&file.name, u64::from(columns), u64::from(rows), pages.len() as u64 + 1)?;
        total += u64::from(columns) * u64::from(rows);
        if total > limits.pixels || count as u64 > limits.pixels {
            let (what, limit) = ("the number of pixels", limits.pixels);
            return Err(Error::TooLarge { file: Some(file.name.clone()), what, value: total, limit });
        }
        if !matches!(decoder.colortype().map_err(bad)?, tiff::ColorType::Gray(_)) {
            return Err(Error::Colour { file: file.name.clone() });
        }
        let pixels = values(decoder.read_image().map_err(bad)?);
        if pixels.len() as u64 != u64::from(columns) * u64::from(rows) {
            let reason = "its pixels have a width that is not read; save 8, 16 or 32 bits per pixel".to_owned();
            return Err(Error::Unsupported { file: file.name.clone(), reason });
        }
        if let Some(index) = pixels.iter().position(|p| !p.is_finite()) {
            return Err(Error::NotFinite { file: file.name.clone(), index });
        }
        let source = format!("{} (page {})", file.name, pages.len());
        pages.push(Page { source, columns: columns as usize, rows: rows as usize, pixels });
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().map_err(bad)?;
    }
    if let [only] = &mut pages[..] {
        only.source.clone_from(&file.name);
    }
    Ok(pages)
}

fn values(result: DecodingResult) -> Vec<f32> {
    match result {
        DecodingResult::U8(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::U16(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::U32(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::U64(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::F16(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::F32(v) => v,
        DecodingResult::F64(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::I8(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::I16(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::I32(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::I64(v) => v.into_iter().map(|x| x as f32).collect(),
    }
}
