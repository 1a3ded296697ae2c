//! The paper as one function: [`run`] reads like its section 3. Knows no HTTP, user or queue; the command line and the
//! service's worker both call it.

mod ends;
mod facts;
mod failure;
mod folder;
mod memory;
mod mesh_fault;
mod openings;
mod patches;
mod reconstruct;
mod source;
mod step;
mod wall;

pub use failure::Failure;
pub use reconstruct::{Understood, input, run, run_after, understand, validate};
pub use step::{Event, Observer};
