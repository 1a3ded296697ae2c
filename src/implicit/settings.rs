//! What may be set of the implicit fit.

/// Settings of [`crate::fit`].
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Largest distance of interior points from the wall, mm. Halved where the lumen is narrow.
    pub offset_mm: f64,
    /// Most constraints: the dense factor takes 8 n^2 bytes (8,000: 512 MB, 6 CPU-s a pass). Points are thinned by
    /// curvature to stay below.
    pub max_constraints: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { offset_mm: 1.0, max_constraints: 8000 }
    }
}
