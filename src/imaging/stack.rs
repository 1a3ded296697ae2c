//! A stack of grey slices, each at its true position.

use crate::Error;
use space::{P3, Place, V3, Warning};

/// Largest number of rows, columns or slices: twice what a scanner of today gives.
pub const MAX_SIDE: usize = 8192;
/// Largest number of pixels in a stack (2 GiB of grey values).
pub const MAX_PIXELS: usize = 1 << 29;
/// Smallest number of rows and columns: fewer cannot hold a lumen and its surroundings.
pub const MIN_SIDE: usize = 8;
/// Sideways displacement of a slice, in pixels, above which a stack counts as sheared. Rounded DICOM positions stay
/// below .01 px; a gantry tilt of 1 degree gives .05 px per slice and passes the bound within a few slices.
const MAX_SHEAR_PX: f64 = 0.1;
/// Slices closer than this share of a pixel are in one position.
const SAME_POSITION_PX: f64 = 1e-3;
/// A step above this many median steps is a gap.
const GAP_STEPS: f64 = 1.5;

/// Parallel slices of one size, sorted along their normal. Spacing along the normal may vary (missing slices are gaps,
/// never stretched); thickness is a property of the acquisition and says nothing about spacing.
#[derive(Clone, Debug)]
pub struct Stack {
    /// Pixels per row.
    pub columns: usize,
    /// Rows per slice.
    pub rows: usize,
    /// Grey values after rescale; slice by slice, row by row: index = (slice * rows + row) * columns + column.
    pub pixels: Vec<f32>,
    /// Distance between neighbouring rows and between neighbouring columns, mm (DICOM PixelSpacing's order).
    pub pixel_spacing_mm: [f64; 2],
    /// Unit vector in which the column index grows.
    pub row_direction: V3,
    /// Unit vector in which the row index grows, at a right angle to `row_direction`.
    pub column_direction: V3,
    /// Centre of pixel (row 0, column 0) of every slice; strictly ascending along [`Stack::normal`], all on one line
    /// along the normal.
    pub origins: Vec<P3>,
    /// Slice thickness in mm where the acquisition states it.
    pub thickness_mm: Option<f64>,
}

/// One slice as read, before it joins a stack.
#[derive(Clone, Debug)]
pub struct Slice {
    /// Pixels per row.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
    /// Grey values after rescale, row by row.
    pub pixels: Vec<f32>,
    /// Centre of pixel (row 0, column 0), LPS mm.
    pub origin: P3,
}

/// What all slices of a stack share.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Row step and column step, mm.
    pub pixel_spacing_mm: [f64; 2],
    /// Direction in which the column index grows.
    pub row_direction: V3,
    /// Direction in which the row index grows.
    pub column_direction: V3,
    /// Slice thickness where stated, mm.
    pub thickness_mm: Option<f64>,
}

impl Stack {
    /// A checked stack from slices in any order: they are sorted by their position along the normal.
    ///
    /// # Errors
    /// [`Error::UnequalSizes`] and those of [`Stack::validated`].
    pub fn new(layout: Layout, slices: Vec<Slice>) -> Result<Self, Error> {
        let Some(first) = slices.first() else { return Err(Error::TooFewSlices { slices: 0 }) };
        let (columns, rows) = (first.columns, first.rows);
        if let Some((slice, s)) = slices.iter().enumerate().find(|(_, s)| (s.columns, s.rows) != (columns, rows)) {
            return Err(Error::UnequalSizes {
                slice,
                columns: s.columns,
                rows: s.rows,
                first_columns: columns,
                first_rows: rows,
            });
        }
        check_sizes(columns, rows, slices.len())?;
        let origins = slices.iter().map(|s| s.origin).collect();
        let mut pixels = Vec::with_capacity(columns * rows * slices.len());
        for s in slices {
            if s.pixels.len() != columns * rows {
                return Err(Error::PixelCount { pixels: s.pixels.len(), wanted: columns * rows });
            }
            pixels.extend_from_slice(&s.pixels);
        }
        let Layout { pixel_spacing_mm, row_direction, column_direction, thickness_mm } = layout;
        Self { columns, rows, pixels, pixel_spacing_mm, row_direction, column_direction, origins, thickness_mm }
            .validated()
    }
    /// The same stack with unit directions and slices in ascending order, after all checks: sizes, pixel count,
    /// spacing, right angles, at least three slices, one line along the normal, no position twice, finite pixels.
    ///
    /// # Errors
    /// Every variant of [`Error`] whose code begins with `stack.`, except `stack.uniform`.
    pub fn validated(mut self) -> Result<Self, Error> {
        check_sizes(self.columns, self.rows, self.slices())?;
        let wanted = self.columns * self.rows * self.slices();
        if self.pixels.len() != wanted {
            return Err(Error::PixelCount { pixels: self.pixels.len(), wanted });
        }
        self.square_up()?;
        self.sort();
        self.check_positions()?;
        match self.pixels.iter().position(|p| !p.is_finite()) {
            None => Ok(self),
            Some(i) => Err(Error::NotFinite {
                slice: i / (self.rows * self.columns),
                row: i / self.columns % self.rows,
                column: i % self.columns,
            }),
        }
    }
    /// Checks spacing and directions; makes the directions unit vectors at a right angle.
    fn square_up(&mut self) -> Result<(), Error> {
        let bad = |what: String| Error::Geometry { what };
        let [row, column] = self.pixel_spacing_mm;
        // .001 to 100 mm spans microscopy to scouts; anything else is a unit mistake
        if ![row, column].iter().all(|s| (1e-3..=100.0).contains(s)) {
            return Err(bad(format!("pixel spacing {row} x {column} mm")));
        }
        if self.thickness_mm.is_some_and(|t| !(t > 0.0 && t.is_finite())) {
            self.thickness_mm = None;
        }
        let (r, c) = (self.row_direction.normalised(), self.column_direction.normalised());
        let (Some(r), Some(c)) = (r, c) else { return Err(bad("a direction has no length".into())) };
        // Image directions are stated with 6 digits; half a degree is a different lattice.
        if r.dot(c).abs() > 5e-3 {
            return Err(bad(format!("row and column directions are {:.2} degrees apart", r.angle_to(c).to_degrees())));
        }
        let Some(c) = (c - r * r.dot(c)).normalised() else { return Err(bad("directions are parallel".into())) };
        if let Some(slice) = self.origins.iter().position(|o| !o.is_finite()) {
            return Err(bad(format!("the position of slice {slice} is not finite")));
        }
        (self.row_direction, self.column_direction) = (r, c);
        Ok(())
    }
    fn sort(&mut self) {
        let n = self.normal();
        let mut order: Vec<usize> = (0..self.slices()).collect();
        order.sort_by(|&a, &b| (self.origins[a] - self.origins[b]).dot(n).total_cmp(&0.0));
        if order.is_sorted() {
            return;
        }
        self.pixels = order.iter().flat_map(|&k| self.slice(k).iter().copied()).collect();
        self.origins = order.iter().map(|&k| self.origins[k]).collect();
    }
    fn check_positions(&self) -> Result<(), Error> {
        let px = self.pixel_mm();
        for k in 1..self.slices() {
            let step = self.offset_mm(k) - self.offset_mm(k - 1);
            if step < SAME_POSITION_PX * px {
                return Err(Error::DuplicatePosition { slice: k - 1, other: k, distance_mm: step });
            }
        }
        for k in 1..self.slices() {
            let offset_mm = (self.origins[k] - self.origins[0] - self.normal() * self.offset_mm(k)).length();
            if offset_mm > MAX_SHEAR_PX * px {
                return Err(Error::Sheared { slice: k, offset_mm });
            }
        }
        Ok(())
    }
    /// Number of slices.
    pub fn slices(&self) -> usize {
        self.origins.len()
    }
    /// Unit normal: row_direction x column_direction. Slices ascend along it.
    pub fn normal(&self) -> V3 {
        self.row_direction.cross(self.column_direction)
    }
    /// Geometric mean of the in-plane steps, mm.
    pub fn pixel_mm(&self) -> f64 {
        (self.pixel_spacing_mm[0] * self.pixel_spacing_mm[1]).sqrt()
    }
    /// One slice's pixels, row by row.
    pub fn slice(&self, slice: usize) -> &[f32] {
        let n = self.rows * self.columns;
        &self.pixels[slice * n..(slice + 1) * n]
    }
    /// Position of a slice along the normal, relative to the first slice, mm.
    pub fn offset_mm(&self, slice: usize) -> f64 {
        (self.origins[slice] - self.origins[0]).dot(self.normal())
    }
    /// Centre of a (possibly fractional) pixel in the patient.
    pub fn position(&self, slice: usize, row: f64, column: f64) -> P3 {
        self.origins[slice]
            + self.row_direction * (column * self.pixel_spacing_mm[1])
            + self.column_direction * (row * self.pixel_spacing_mm[0])
    }
    /// Median distance between neighbouring slices, mm; 0 for a single slice.
    pub fn slice_spacing_mm(&self) -> f64 {
        let mut d: Vec<f64> = (1..self.slices()).map(|k| self.offset_mm(k) - self.offset_mm(k - 1)).collect();
        d.sort_by(f64::total_cmp);
        d.get(d.len() / 2).copied().unwrap_or(0.0)
    }
    /// Whether slices are missing between `slice` and the one before it.
    pub fn gap_before(&self, slice: usize) -> bool {
        slice > 0 && self.offset_mm(slice) - self.offset_mm(slice - 1) > GAP_STEPS * self.slice_spacing_mm()
    }
    /// Numbers of the missing slices in the completed regular series (first slice present = 0).
    pub fn missing_slices(&self) -> Vec<usize> {
        let step = self.slice_spacing_mm();
        let mut number = 0;
        let mut missing = Vec::new();
        for k in 1..self.slices() {
            let steps = ((self.offset_mm(k) - self.offset_mm(k - 1)) / step).round().max(1.0) as usize;
            // A lone far-away slice must not fill the memory with numbers.
            let steps = if self.gap_before(k) { steps.min(MAX_SIDE) } else { 1 };
            missing.extend(number + 1..number + steps);
            number += steps;
        }
        missing
    }
    /// One warning `stack.gap` per gap, at the last slice before it.
    pub fn gap_warnings(&self) -> Vec<Warning> {
        let gaps = (1..self.slices()).filter(|&k| self.gap_before(k));
        gaps.map(|k| {
            let gap = self.offset_mm(k) - self.offset_mm(k - 1);
            let message = format!(
                "{gap:.2} mm lie between slices {} and {k} where the stack's step is {:.2} mm: slices are missing and \
                 the wall there is interpolated",
                k - 1,
                self.slice_spacing_mm()
            );
            Warning::new("stack.gap", message, Place::slice(k - 1))
        })
        .collect()
    }
    /// The stack without some slices; numbers outside the stack are ignored.
    #[must_use]
    pub fn without(&self, slices: &[usize]) -> Self {
        let kept: Vec<usize> = (0..self.slices()).filter(|k| !slices.contains(k)).collect();
        Self {
            pixels: kept.iter().flat_map(|&k| self.slice(k).iter().copied()).collect(),
            origins: kept.iter().map(|&k| self.origins[k]).collect(),
            ..*self
        }
    }
}

fn check_sizes(columns: usize, rows: usize, slices: usize) -> Result<(), Error> {
    for (what, value) in [("the number of columns", columns), ("the number of rows", rows)] {
        if value < MIN_SIDE {
            return Err(Error::Geometry { what: format!("{what} is {value}, at least {MIN_SIDE} are needed") });
        }
    }
    for (what, value) in
        [("the number of columns", columns), ("the number of rows", rows), ("the number of slices", slices)]
    {
        if value > MAX_SIDE {
            return Err(Error::TooLarge { what, value, limit: MAX_SIDE });
        }
    }
    if slices < 3 {
        return Err(Error::TooFewSlices { slices });
    }
    let value = columns * rows * slices;
    if value > MAX_PIXELS {
        return Err(Error::TooLarge { what: "the number of pixels", value, limit: MAX_PIXELS });
    }
    Ok(())
}
