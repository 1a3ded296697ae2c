//! What the user may set of the skeleton.

use crate::Error;

/// Settings of [`crate::medial_graph`]; the defaults are fully automatic.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Spacing of the voxel lattice, mm; `None` chooses a quarter of the smallest lumen radius seen from the seeds (their
    /// 5 % quantile; at 2.5 voxels per radius the tests' bifurcation still gives 3 ends and 1 junction at every shift of
    /// the lattice), not finer than `automatic_voxels` allows.
    pub spacing_mm: Option<f64>,
    /// Voxels that the automatic spacing may use: 256^3.
    pub automatic_voxels: usize,
    /// Voxels above which a lattice is refused: 640^3 (32 MiB of bits).
    pub max_voxels: usize,
    /// A leaf branch is a spur when its tip is nearer to its junction than this many inscribed radii there, 1.0 to 2.0.
    /// At 1.3 no spur is left on the tests' bifurcation with 0.35 voxel of wall ripple at 4 to 15 voxels per radius.
    pub prune_radii: f64,
    /// Rays of a cross-section, at least 16. On a smooth outline the centroid converges faster than any power of
    /// their number.
    pub rays: usize,
    /// Recentring passes. On straight tubes the axis is exact to 1e-5 mm after the first; the junction of a 45 degree
    /// graft is off by .06 mm after the first, .001 mm after the second, and stays there.
    pub passes: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            spacing_mm: None,
            automatic_voxels: 1 << 24,
            max_voxels: 640 * 640 * 640,
            prune_radii: 1.3,
            rays: 64,
            passes: 3,
        }
    }
}

impl Settings {
    /// # Errors
    /// [`Error::Setting`] for the first setting out of its range.
    pub fn check(&self) -> Result<(), Error> {
        let fault = |name, value, range| Err(Error::Setting { name, value, range });
        match self {
            Self { spacing_mm: Some(h), .. } if !(h.is_finite() && *h > 0.0) => {
                fault("spacing_mm", *h, "positive and finite")
            }
            Self { prune_radii: p, .. } if !(1.0..=2.0).contains(p) => fault("prune_radii", *p, "1.0 to 2.0"),
            Self { rays, .. } if !(16..=4096).contains(rays) => fault("rays", *rays as f64, "16 to 4096"),
            Self { passes, .. } if !(1..=20).contains(passes) => fault("passes", *passes as f64, "1 to 20"),
            Self { automatic_voxels: n, .. } if *n < 1000 => fault("automatic_voxels", *n as f64, "1000 or more"),
            _ => Ok(()),
        }
    }
}
