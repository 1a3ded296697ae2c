//! What the user may set of the skeleton.

use crate::Error;

/// Settings of [`crate::medial_graph`]; the defaults are fully automatic.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Spacing of the voxel lattice, mm; `None` chooses a quarter of the smallest lumen radius seen from the seeds (at
    /// 2.5 voxels per radius the tests' bifurcation still gives 3 ends and 1 junction; at 4 a vessel that is a third
    /// narrower than the 5 % quantile that is looked at still does), not finer than `automatic_voxels` allows.
    pub spacing_mm: Option<f64>,
    /// Voxels that the automatic spacing may use: 256^3. A bifurcation's graph does not change above it, the time does.
    pub automatic_voxels: usize,
    /// Voxels above which a lattice is refused: 640^3 (32 MiB of bits).
    pub max_voxels: usize,
    /// A leaf branch is a spur when it is shorter than this many inscribed radii at its junction, 1.0 to 2.0. With
    /// 0.35 voxel of boundary noise, spurs up to 1.2 radii were met on the tests' phantoms.
    pub prune_radii: f64,
    /// Rays of a cross-section, at least 16. The centroid converges faster than any power of it; 64 leave less than
    /// 1e-3 mm on a section as long as 2.5 times its width.
    pub rays: usize,
    /// Recentring passes. The first moves a line by up to 1.3 voxel, the third by less than .001.
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
