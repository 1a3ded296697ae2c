//! Slices and volumes to a [`Stack`]: right-handed, ascending, on one line along the normal, each slice where it is.
//!
//! Every reader ends here, so that the invariants of `Stack` are made in one place. A volume whose third axis runs
//! against row x column has its slices reversed; nothing is resampled. Slices that do not lie on one line along their
//! normal (gantry tilt) are refused: moving them would move the vessel, and skewing them would need resampling.

use super::{Error, Limits};
use imaging::Stack;
use space::{P3, Place, V3, Warning};

/// Fewest slices of a stack: between two slices lies one interval, the least that a vessel can run through.
pub(crate) const MIN_SLICES: usize = 2;

/// Largest distance of a slice's corner from the line of the others, in pixels. Headers round directions to six
/// decimals, which moves a corner by less than 0.001 px over 300 mm; contours are good to 0.05 px.
const LATERAL_TOLERANCE_PX: f64 = 0.05;

/// Largest cosine between axes that count as perpendicular: printed directions of four decimals reach 2e-4; what is
/// left is split evenly between both axes (0.03 degrees).
const COSINE_TOLERANCE: f64 = 1e-3;

/// Two slices nearer than this fraction of the median spacing (and 1 micrometre) lie in one position.
const SAME_POSITION: f64 = 1e-3;

/// One slice with its place in the patient.
#[derive(Clone, Debug)]
pub(crate) struct Placed {
    /// File (and frame) it came from.
    pub(crate) source: String,
    /// Centre of the first pixel, LPS mm.
    pub(crate) origin: P3,
    /// Grey values, row by row.
    pub(crate) pixels: Vec<f32>,
}

/// What all slices share.
#[derive(Clone, Debug)]
pub(crate) struct Frame {
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    /// [row step, column step], mm.
    pub(crate) spacing: [f64; 2],
    /// Directions in which the column and the row index grow.
    pub(crate) directions: [V3; 2],
    pub(crate) thickness_mm: Option<f64>,
}

/// A stack with what the reader must tell about it.
pub(crate) struct Placement {
    pub(crate) stack: Stack,
    pub(crate) missing: Vec<usize>,
    pub(crate) warnings: Vec<Warning>,
}

/// Both directions made exactly perpendicular unit vectors; `None` beyond the tolerance, with the deviation in degrees.
pub(crate) fn orthonormal(u: V3, v: V3) -> Result<[V3; 2], f64> {
    let (Some(u), Some(v)) = (u.normalised(), v.normalised()) else { return Err(90.0) };
    let cosine = u.dot(v);
    if !cosine.is_finite() || cosine.abs() > COSINE_TOLERANCE {
        return Err((90.0 - u.angle_to(v).to_degrees()).abs());
    }
    if cosine == 0.0 {
        return Ok([u, v]);
    }
    // symmetric: each axis gives way by half, then the second is made exact against the first
    let a = (u - v * (0.5 * cosine)).normalised().ok_or(90.0)?;
    let b = (v - a * v.dot(a)).normalised().ok_or(90.0)?;
    Ok([a, b])
}

/// Sort slices along the normal and check that they make one stack.
///
/// # Errors
/// [`Error::TooFewSlices`], [`Error::DuplicatePosition`], [`Error::GantryTilt`], [`Error::Geometry`],
/// [`Error::TooLarge`].
pub(crate) fn place(mut slices: Vec<Placed>, frame: &Frame, limits: &Limits) -> Result<Placement, Error> {
    let offsets = line_up(&mut slices, frame)?;
    let total = limits.admit(&slices[0].source, frame.columns as u64, frame.rows as u64, slices.len() as u64)?;
    let [u, v] = frame.directions;
    let (first, normal) = (slices[0].origin, u.cross(v));
    let (missing, warnings) = gaps(&offsets);
    let mut pixels = Vec::with_capacity(total);
    for s in &mut slices {
        pixels.append(&mut std::mem::take(&mut s.pixels));
    }
    if pixels.len() != total {
        return Err(Error::Internal(format!("{} pixels for a stack of {total}", pixels.len())));
    }
    let stack = Stack {
        columns: frame.columns,
        rows: frame.rows,
        pixels,
        pixel_spacing_mm: frame.spacing,
        row_direction: u,
        column_direction: v,
        origins: offsets.iter().map(|&d| first + normal * d).collect(),
        thickness_mm: frame.thickness_mm,
    };
    Ok(Placement { stack, missing, warnings })
}

/// Sort slices along the normal; their offsets from the first, mm. Pixels are not looked at.
///
/// # Errors
/// [`Error::TooFewSlices`], [`Error::DuplicatePosition`], [`Error::GantryTilt`], [`Error::Geometry`].
pub(crate) fn line_up(slices: &mut [Placed], frame: &Frame) -> Result<Vec<f64>, Error> {
    if slices.len() < MIN_SLICES {
        return Err(Error::TooFewSlices { found: slices.len(), needed: MIN_SLICES });
    }
    let name = slices[0].source.clone();
    check_frame(&name, frame)?;
    let [u, v] = frame.directions;
    let normal = u.cross(v);
    if let Some(bad) = slices.iter().find(|s| !s.origin.is_finite()) {
        let reason = "its position is not a finite number".to_owned();
        return Err(Error::Geometry { file: bad.source.clone(), reason });
    }
    slices.sort_by(|a, b| {
        let along = |p: &Placed| p.origin.raw().dot(normal.raw());
        along(a).total_cmp(&along(b)).then_with(|| a.source.cmp(&b.source))
    });
    let first = slices[0].origin;
    let offsets: Vec<f64> = slices.iter().map(|s| (s.origin - first).dot(normal)).collect();
    refuse_duplicates(slices, &offsets)?;
    refuse_tilt(slices, &offsets, frame)?;
    Ok(offsets)
}

fn check_frame(file: &str, frame: &Frame) -> Result<(), Error> {
    let [row, column] = frame.spacing;
    // 100 mm: no scanner has such pixels; metres or micrometres written as millimetres do
    if [row, column].iter().all(|s| s.is_finite() && *s > 1e-4 && *s < 100.0) {
        return Ok(());
    }
    let reason = format!("a pixel of {row} x {column} mm cannot be right; check the spacing and its unit");
    Err(Error::Geometry { file: file.to_owned(), reason })
}

fn median_step(offsets: &[f64]) -> f64 {
    let mut steps: Vec<f64> = offsets.windows(2).map(|w| w[1] - w[0]).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().unwrap_or(0.0)
}

fn refuse_duplicates(slices: &[Placed], offsets: &[f64]) -> Result<(), Error> {
    let least = (SAME_POSITION * median_step(offsets)).max(1e-3);
    match offsets.windows(2).position(|w| w[1] - w[0] < least) {
        None => Ok(()),
        Some(k) => Err(Error::DuplicatePosition {
            first: slices[k].source.clone(),
            second: slices[k + 1].source.clone(),
            slice: k,
            offset_mm: offsets[k],
        }),
    }
}

fn refuse_tilt(slices: &[Placed], offsets: &[f64], frame: &Frame) -> Result<(), Error> {
    let [u, v] = frame.directions;
    let tolerance = LATERAL_TOLERANCE_PX * frame.spacing[0].min(frame.spacing[1]);
    let lateral = |k: usize| {
        let d = slices[k].origin - slices[0].origin;
        d.dot(u).hypot(d.dot(v))
    };
    match (1..slices.len()).map(|k| (k, lateral(k))).max_by(|a, b| a.1.total_cmp(&b.1)) {
        Some((k, aside)) if aside > tolerance => {
            Err(Error::GantryTilt { degrees: aside.atan2(offsets[k]).to_degrees() })
        }
        _ => Ok(()),
    }
}

/// Numbers that the missing slices would have had, counting the filled stack from 0, and the warnings about spacing.
fn gaps(offsets: &[f64]) -> (Vec<usize>, Vec<Warning>) {
    let step = median_step(offsets);
    let (mut missing, mut warnings, mut number) = (Vec::new(), Vec::new(), 0);
    for (k, w) in offsets.windows(2).enumerate() {
        let gap = w[1] - w[0];
        let steps = (gap / step).round().max(1.0);
        // 0.1: reconstructed positions are printed to 0.01 mm or better on steps of 0.5 mm and more
        if (gap / step - steps).abs() > 0.1 {
            let message = format!("the step after slice {k} is {gap:.3} mm against {step:.3} mm elsewhere");
            warnings.push(Warning::new("stack.uneven_spacing", message, Place::slice(k)));
        } else if steps > 1.0 {
            let n = steps as usize - 1;
            let message =
                format!("{n} slice(s) missing after slice {k}: a gap of {gap:.3} mm is bridged, not stretched");
            warnings.push(Warning::new("stack.gap", message, Place::slice(k)));
            missing.extend((1..=n).map(|i| number + i));
        }
        number += steps as usize;
    }
    (missing, warnings)
}

/// A regular volume as NIfTI, MetaImage and NRRD give it: the first index runs fastest.
#[derive(Clone, Debug)]
pub(crate) struct Volume {
    pub(crate) file: String,
    /// Voxels along the first, second and third index.
    pub(crate) size: [usize; 3],
    /// Step vectors of the three indices, LPS mm.
    pub(crate) steps: [V3; 3],
    /// Centre of voxel (0, 0, 0), LPS mm.
    pub(crate) origin: P3,
    pub(crate) pixels: Vec<f32>,
    pub(crate) thickness_mm: Option<f64>,
}

impl Volume {
    /// The stack of its planes of constant third index.
    ///
    /// # Errors
    /// [`Error::Sheared`] when the axes are not at right angles; else as [`place`].
    pub(crate) fn stack(self, limits: &Limits) -> Result<Placement, Error> {
        let [i, j, k] = self.steps;
        let lengths = [i.length(), j.length(), k.length()];
        if lengths.iter().any(|l| !l.is_finite() || *l < 1e-4) || !self.origin.is_finite() {
            let reason = format!("voxel steps of {lengths:?} mm cannot be right");
            return Err(Error::Geometry { file: self.file, reason });
        }
        let sheared = |degrees| Error::Sheared { file: self.file.clone(), degrees };
        let directions = orthonormal(i, j).map_err(sheared)?;
        let normal = directions[0].cross(directions[1]);
        let lean = k.angle_to(normal).to_degrees().min(180.0 - k.angle_to(normal).to_degrees());
        if lean.to_radians().sin() > COSINE_TOLERANCE {
            return Err(sheared(lean));
        }
        // within the tolerance the third axis is the normal itself: no slice leaves the line
        let step = normal * (lengths[2] * k.dot(normal).signum());
        let [columns, rows, slices] = self.size;
        let frame =
            Frame { columns, rows, spacing: [lengths[1], lengths[0]], directions, thickness_mm: self.thickness_mm };
        let placed = (0..slices).map(|s| Placed {
            source: format!("{} (slice {s})", self.file),
            origin: self.origin + step * s as f64,
            pixels: self.pixels[s * rows * columns..(s + 1) * rows * columns].to_vec(),
        });
        place(placed.collect(), &frame, limits)
    }
}
