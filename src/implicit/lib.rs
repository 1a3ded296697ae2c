//! Curves to an implicit function: constraints, the cubic radial basis fit, its evaluation, the sampled and smoothed form.

mod field;

pub use field::Field;
