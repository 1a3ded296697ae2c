//! A stack of grey slices, each at its true position.

use space::{P3, V3};

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

impl Stack {
    /// Number of slices.
    pub fn slices(&self) -> usize {
        self.origins.len()
    }
    /// Unit normal: row_direction x column_direction. Slices ascend along it.
    pub fn normal(&self) -> V3 {
        self.row_direction.cross(self.column_direction)
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
}
