//! Curves to an implicit function: constraints, the cubic radial basis fit, its evaluation, the sampled and smoothed form.
//!
//! ```text
//! planar curves -> constraints -> (K + D) c + P b = y -> f -> lattice values -> Gaussian within one pixel -> smoothed f
//! ```

mod constraints;
mod ensemble;
mod error;
mod field;
mod fit;
mod kernel;
mod sampled;
mod settings;
mod smooth;
mod system;
#[cfg(test)]
mod test_fields;

pub use constraints::Constraints;
pub use ensemble::{Draws, Ensemble};
pub use error::Error;
pub use field::{Field, foot};
pub use fit::{FitReport, Variational, fit, fit_with_ensemble};
pub use sampled::{Sampled, SampledSettings};
pub use settings::Settings;
pub use smooth::{SmoothReport, Smoothing, smooth};
