//! Curves to an implicit function: constraints, the cubic radial basis fit, its evaluation, the sampled and smoothed form.
//!
//! ```text
//! planar curves -> constraints -> (K + D) c + P b = y -> f -> lattice values -> Gaussian within one pixel -> smoothed f
//! ```

mod conjugate;
mod constraints;
mod contrasts;
mod ensemble;
mod error;
mod field;
mod filter;
mod fit;
mod hierarchy;
mod interpolate;
mod kernel;
mod nearest;
mod product;
mod roughness;
mod sampled;
mod settings;
mod smooth;
mod system;
#[cfg(test)]
mod test_fields;
mod variational;
mod waves;
mod wide;

pub use constraints::Constraints;
pub use ensemble::{Draws, Ensemble};
pub use error::Error;
pub use field::{Field, foot};
pub use fit::{FitReport, fit, fit_with_ensemble};
pub use interpolate::{SolveReport, interpolant};
pub use sampled::{Sampled, SampledSettings};
pub use settings::{Method, Settings};
pub use smooth::{SmoothReport, Smoothing, smooth};
pub use variational::Variational;
