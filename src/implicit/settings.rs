//! What may be set of the implicit fit.

/// How the linear system is solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Method {
    /// Dense up to 1,000 constraints; iterative beyond, with the dense factor as fallback up to 8,000.
    #[default]
    BySize,
    /// The dense factor (the oracle): n^3 / 3 operations, 8 n^2 bytes.
    Dense,
    /// Conjugate gradients without fallback: about 15 n^2 / 2 kernel values, 1.3 kB per constraint.
    Iterative,
}

/// Settings of [`crate::fit`].
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Largest distance of interior points from the wall, mm. Halved where the lumen is narrow.
    pub offset_mm: f64,
    /// Most constraints (100,000: 130 MB). Beyond it the step between points grows until they fit.
    pub max_constraints: usize,
    /// Step between the wall points of a contour, in pixels or half plane distances, whichever is longer. The error of
    /// the demo's wall is .031 mm at .5, .030 at 1 and at 1.5: the contours hold no more (docs/adr/0022).
    pub step: f64,
    /// How the system is solved.
    pub method: Method,
}

impl Default for Settings {
    fn default() -> Self {
        Self { offset_mm: 1.0, max_constraints: 100_000, step: 1.5, method: Method::BySize }
    }
}
