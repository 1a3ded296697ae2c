//! Analytic vessels and simulated scans of them with exact truth, for the demo, tests, surveys and benches.
//!
//! [`scan`] gives a [`imaging::Stack`] and the [`Truth`] in the same frame (LPS, mm). The vessel itself is an exact
//! function ([`Vessel::distance`], gradient and second derivatives), an oracle for the tests of other crates.
//! Everything follows from the kind and the settings, seed included: equal bytes on any number of threads.
//!
//! ```
//! let kind = phantom::Kind::Anastomosis;
//! let settings = phantom::Settings { columns: 64, rows: 64, slices: 9, pixel_mm: 2.0, ..phantom::Settings::of(kind) };
//! let ctx = exec::Ctx::new(1).map_err(|e| e.to_string())?;
//! let (stack, truth) = phantom::scan(kind, &settings, &ctx).map_err(|e| e.to_string())?;
//! assert_eq!(stack.slices(), 9);
//! assert!((truth.junction.map(|j| j.angles.graft_proximal).unwrap_or(0.0) - 45.0).abs() < 1e-9);
//! # Ok::<(), String>(())
//! ```

mod axis;
mod error;
mod frame;
mod image;
mod kind;
mod random;
mod scene;
mod settings;
#[cfg(test)]
mod tests;
mod tissue;
mod truth;
mod vessel;

pub use axis::Axis;
pub use error::{Error, SettingFault};
pub use kind::{Bifurcation, Kind};
pub use scene::Scene;
pub use settings::{Body, Levels, Settings};
pub use truth::{Angles, BranchTruth, DistractorTruth, HelixTruth, JunctionTruth, Role, Truth};
pub use vessel::{Tube, Vessel};

/// A simulated scan of a phantom and what is true of it.
///
/// # Errors
/// [`Error::Settings`], [`Error::TooLarge`], [`Error::OutsideStack`], [`Error::NoRoom`], [`Error::Cancelled`].
pub fn scan(kind: Kind, settings: &Settings, ctx: &exec::Ctx) -> Result<(imaging::Stack, Truth), Error> {
    let scene = Scene::new(kind, settings)?;
    let stack = scene.image(ctx)?;
    Ok((stack, scene.truth))
}
