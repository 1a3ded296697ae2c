//! What an upload may cost, decided before anything of that size is allocated.

use super::Error;

/// Limits of one upload. The defaults are service.md's, sized for a clinical stack (512 x 512 x 400 voxels) with room.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Files, after archives are opened.
    pub entries: usize,
    /// Bytes of all files together, after decompression.
    pub total_bytes: u64,
    /// Decompressed over compressed bytes. Small outputs (16 MiB) are free: an all-black slice shrinks a thousandfold.
    pub ratio: u64,
    /// Columns, and rows, of a slice.
    pub side: usize,
    /// Slices of a stack.
    pub slices: usize,
    /// Pixels of a stack (4 bytes each).
    pub pixels: u64,
}

/// Outputs up to this size are not held to [`Limits::ratio`].
const RATIO_FREE_BYTES: u64 = 16 << 20;

impl Default for Limits {
    fn default() -> Self {
        Self { entries: 10_000, total_bytes: 2 << 30, ratio: 100, side: 8192, slices: 4096, pixels: 512 << 20 }
    }
}

impl Limits {
    /// Most bytes that `compressed` bytes may inflate to.
    pub(crate) fn inflated(&self, compressed: u64) -> u64 {
        compressed.saturating_mul(self.ratio).max(RATIO_FREE_BYTES).min(self.total_bytes)
    }

    /// Number of pixels of a stack whose header states these sizes.
    ///
    /// # Errors
    /// [`Error::TooLarge`] beyond a limit, [`Error::Malformed`] for a size of 0.
    pub(crate) fn admit(&self, file: &str, columns: u64, rows: u64, slices: u64) -> Result<usize, Error> {
        let too_large = |what, value, limit| Err(Error::TooLarge { file: Some(file.to_owned()), what, value, limit });
        if columns == 0 || rows == 0 || slices == 0 {
            let reason = format!("its header states {columns} columns, {rows} rows, {slices} slices");
            return Err(Error::Malformed { file: file.to_owned(), reason });
        }
        for (what, value) in [("the number of columns", columns), ("the number of rows", rows)] {
            if value > self.side as u64 {
                return too_large(what, value, self.side as u64);
            }
        }
        if slices > self.slices as u64 {
            return too_large("the number of slices", slices, self.slices as u64);
        }
        let pixels = columns * rows * slices; // at most 2^13 * 2^13 * 2^12 with the default limits
        if pixels > self.pixels {
            return too_large("the number of pixels", pixels, self.pixels);
        }
        Ok(pixels as usize)
    }
}
