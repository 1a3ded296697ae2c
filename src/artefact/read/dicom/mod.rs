//! DICOM images to a stack (PS3.3 C.7.6.2 image plane, C.7.6.16 functional groups).
//!
//! Slices are ordered by ImagePositionPatient along the normal; InstanceNumber, SliceLocation, SpacingBetweenSlices and
//! SliceThickness never place a slice. The rescale is applied per frame; windows are not (they are for the eye).
//! MONOCHROME1 values are kept as stored, with a warning: only the display is inverted, the physics is not. Several
//! series in one upload: the one that the plan names, else the longest that makes a stack, is taken and said; two of
//! equal length are refused, because choosing between them would be a guess.

mod anonymous;
pub(crate) mod dataset;
mod instance;
mod jpegls;
mod pixels;
mod rle;
mod segments;
mod series;
pub(crate) mod table;

pub(crate) use anonymous::anonymous;
pub use instance::{InstanceNames, instance};
pub(crate) use segments::{is_segmentation, labels};

use super::report::Acquisition;
use super::volume::{Frame, Placed, Placement, orthonormal, place};
use super::{Error, Limits, NamedBytes};
use dataset::{DataSet, Encoding};
use pixels::{Layout, Syntax};
use space::{P3, Place, V3, Warning};
use std::borrow::Cow;
use table::*;

/// Explicit little endian, as deflated data sets are.
const EXPLICIT: Encoding = Encoding { explicit: true, order: super::samples::Order::Little };

/// An opened file: the elements of the allow-list and how its pixels are coded.
pub(crate) struct Opened<'a> {
    pub(crate) ds: DataSet<'a>,
    pub(crate) uid: String,
    pub(crate) syntax: Syntax,
}

/// The bytes of a file with a deflated data set inflated (deflated files only; others are borrowed).
///
/// # Errors
/// [`Error::Malformed`], [`Error::TooLarge`], [`Error::Unsupported`].
pub(crate) fn body<'a>(file: &str, bytes: &'a [u8], limits: &Limits) -> Result<(String, Syntax, Cow<'a, [u8]>), Error> {
    let (uid, body) = dataset::split(file, bytes)?;
    let syntax = pixels::syntax(file, &uid)?;
    let body = match syntax {
        Syntax::Deflated => Cow::Owned(super::archive::inflate(file, body, limits)?),
        _ => Cow::Borrowed(body),
    };
    Ok((uid, syntax, body))
}

/// Parse a body made by [`body`].
///
/// # Errors
/// [`Error::Truncated`], [`Error::Malformed`], [`Error::BurnedIn`], [`Error::Unsupported`] for a modality look-up table.
pub(crate) fn open<'a>(file: &str, uid: String, syntax: Syntax, body: &'a [u8]) -> Result<Opened<'a>, Error> {
    let encoding = match syntax {
        Syntax::Native(encoding) => encoding,
        Syntax::Deflated | Syntax::Encapsulated => EXPLICIT,
    };
    let ds = dataset::parse(file, body, encoding)?;
    if ds.elements.contains_key(&MODALITY_LUT) {
        let reason = "its values go through a modality look-up table, which is not read; export with a rescale slope";
        return Err(Error::Unsupported { file: file.to_owned(), reason: reason.to_owned() });
    }
    if ds.elements.contains_key(&0x7fe0_0008) || ds.elements.contains_key(&0x7fe0_0009) {
        let reason = "floating-point pixel data is not read; export integers with a rescale slope".to_owned();
        return Err(Error::Unsupported { file: file.to_owned(), reason });
    }
    if ds.text(BURNED_IN) == Some("YES") {
        return Err(Error::BurnedIn { file: file.to_owned() });
    }
    Ok(Opened { ds, uid, syntax })
}

/// Whether the object holds an image at all (reports, presentation states and plans do not).
pub(crate) fn is_image(ds: &DataSet) -> bool {
    ds.elements.contains_key(&ROWS) || ds.elements.contains_key(&PIXEL_DATA)
}

/// One frame's header.
#[derive(Clone, Debug)]
struct Slice {
    file: usize,
    frame: usize,
    source: String,
    /// SeriesInstanceUID and SeriesNumber.
    series: [String; 2],
    size: [usize; 2],
    plane: Option<PlaneOf>,
    rescale: (f64, f64),
    inverted: bool,
    facts: Acquisition,
}

/// Where a frame lies.
#[derive(Clone, Copy, Debug)]
struct PlaneOf {
    origin: P3,
    directions: [V3; 2],
    spacing: [f64; 2],
}

/// The stack in some DICOM files; `series` names one of several by SeriesNumber or SeriesInstanceUID.
///
/// # Errors
/// See [`Error`]; `input.unequal_sizes`, `stack.duplicate_position`, `dicom.gantry_tilt` name the files.
pub(crate) fn stack(
    files: &[NamedBytes],
    series: Option<&str>,
    limits: &Limits,
) -> Result<(Placement, Acquisition), Error> {
    let mut warnings = Vec::new();
    let mut slices = Vec::new();
    let mut colour = None;
    for (index, file) in files.iter().enumerate() {
        let (uid, syntax, body) = body(&file.name, &file.bytes, limits)?;
        let opened = open(&file.name, uid, syntax, &body)?;
        if !is_image(&opened.ds) {
            let message = format!("{} holds no image (a report or a plan) and was left out", file.name);
            warnings.push(Warning::new("dicom.not_an_image", message, Place::file(&file.name)));
            continue;
        }
        match Layout::of(&file.name, &opened.ds, limits) {
            Err(e @ Error::Colour { .. }) => {
                let message = format!("{} is a colour image and was left out", file.name);
                warnings.push(Warning::new("dicom.colour", message, Place::file(&file.name)));
                colour = Some(e);
            }
            other => slices.append(&mut headers(index, &file.name, &opened.ds, &other?)?),
        }
    }
    if slices.is_empty() {
        return Err(colour.unwrap_or(Error::NoImages { files: files.len() }));
    }
    let group = series::chosen(slices, series, &mut warnings)?;
    if group[0].inverted {
        let message = "MONOCHROME1: what looks bright on the screen is dark in the values, which are used as stored";
        warnings.push(Warning::new("dicom.monochrome1", message, Place::none()));
    }
    let mut placement = decoded(&group, files, limits)?;
    warnings.append(&mut placement.warnings);
    Ok((Placement { warnings, ..placement }, group[0].facts.clone()))
}

/// An element of a frame: from its own functional group, else the shared one, else the data set itself.
fn lookup(ds: &DataSet, frame: usize, sequence: Tag, tag: Tag) -> Option<Vec<f64>> {
    let in_group = |item: &DataSet| item.items(sequence).first().and_then(|i| i.numbers(tag));
    ds.items(PER_FRAME_GROUPS)
        .get(frame)
        .and_then(in_group)
        .or_else(|| ds.items(SHARED_GROUPS).first().and_then(in_group))
        .or_else(|| ds.numbers(tag))
}

/// The frames' headers of one file.
fn headers(index: usize, file: &str, ds: &DataSet, layout: &Layout) -> Result<Vec<Slice>, Error> {
    let per_frame = ds.items(PER_FRAME_GROUPS);
    if layout.frames > 1 && !per_frame.is_empty() && per_frame.len() != layout.frames {
        let reason = format!("{} frames but {} functional groups", layout.frames, per_frame.len());
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    (0..layout.frames)
        .map(|frame| {
            let one = |sequence, tag| lookup(ds, frame, sequence, tag).and_then(|v| v.first().copied());
            // a position at the root is one for all frames: it places none of them
            let placed = layout.frames == 1 || !per_frame.is_empty();
            let source = if layout.frames == 1 { file.to_owned() } else { format!("{file} (frame {frame})") };
            Ok(Slice {
                file: index,
                frame,
                source,
                series: [SERIES, SERIES_NUMBER].map(|t| ds.text(t).unwrap_or_default().to_owned()),
                size: [layout.rows, layout.columns],
                plane: if placed { plane(file, ds, frame)? } else { None },
                rescale: rescale(file, one(PIXEL_VALUE_SEQUENCE, SLOPE), one(PIXEL_VALUE_SEQUENCE, INTERCEPT))?,
                inverted: ds.text(PHOTOMETRIC) == Some("MONOCHROME1"),
                facts: Acquisition {
                    modality: ds.text(MODALITY).map(str::to_owned),
                    thickness_mm: one(PIXEL_MEASURES_SEQUENCE, THICKNESS).filter(|t| *t > 0.0),
                    echo_time_ms: one(0, ECHO_TIME),
                    repetition_time_ms: one(0, REPETITION_TIME),
                    field_strength_t: one(0, FIELD_STRENGTH),
                },
            })
        })
        .collect()
}

fn rescale(file: &str, slope: Option<f64>, intercept: Option<f64>) -> Result<(f64, f64), Error> {
    let slope = slope.unwrap_or(1.0);
    if slope == 0.0 {
        let reason = "its rescale slope is 0".to_owned();
        return Err(Error::Malformed { file: file.to_owned(), reason });
    }
    Ok((slope, intercept.unwrap_or(0.0)))
}

fn plane(file: &str, ds: &DataSet, frame: usize) -> Result<Option<PlaneOf>, Error> {
    let position = lookup(ds, frame, PLANE_POSITION_SEQUENCE, POSITION);
    let orientation = lookup(ds, frame, PLANE_ORIENTATION_SEQUENCE, ORIENTATION);
    let spacing = lookup(ds, frame, PIXEL_MEASURES_SEQUENCE, PIXEL_SPACING);
    let (Some(p), Some(o), Some(s)) = (position, orientation, spacing) else { return Ok(None) };
    let (&[x, y, z], &[a, b, c, d, e, f], &[row, column]) = (&p[..], &o[..], &s[..]) else {
        let reason = format!(
            "ImagePositionPatient, ImageOrientationPatient and PixelSpacing have {}, {} and {} values instead of 3, 6 and 2",
            p.len(),
            o.len(),
            s.len()
        );
        return Err(Error::Malformed { file: file.to_owned(), reason });
    };
    let directions = orthonormal(V3::new(a, b, c), V3::new(d, e, f)).map_err(|degrees| {
        let reason = format!("its row and column directions are {degrees:.3} degrees away from a right angle");
        Error::Geometry { file: file.to_owned(), reason }
    })?;
    Ok(Some(PlaneOf { origin: P3::new(x, y, z), directions, spacing: [row, column] }))
}

/// The pixels of the chosen slices, file by file.
fn decoded(group: &[Slice], files: &[NamedBytes], limits: &Limits) -> Result<Placement, Error> {
    let first = &group[0];
    let (frame, plane) = series::frame(first)?;
    let Frame { columns, rows, .. } = frame;
    limits.admit(&first.source, columns as u64, rows as u64, group.len() as u64)?;
    let mut order: Vec<&Slice> = group.iter().collect();
    order.sort_by_key(|s| (s.file, s.frame));
    let mut placed = Vec::with_capacity(group.len());
    for of_file in order.chunk_by(|a, b| a.file == b.file) {
        let file = &files[of_file[0].file];
        let (uid, syntax, body) = body(&file.name, &file.bytes, limits)?;
        let opened = open(&file.name, uid, syntax, &body)?;
        let layout = Layout::of(&file.name, &opened.ds, limits)?;
        let samples = pixels::samples(&file.name, &opened.ds, &opened.uid, &layout)?;
        for s in of_file {
            let origin = s.plane.map_or(plane.origin, |p| p.origin);
            let pixels = layout.frame(&file.name, &samples, s.frame, s.rescale)?;
            placed.push(Placed { source: s.source.clone(), origin, pixels });
        }
    }
    place(placed, &frame, limits)
}
