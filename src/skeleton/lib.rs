//! The implicit function to medial lines: voxelise, thin, graph, prune, recentre.

mod bits;
mod error;
mod masks;
mod medial;

pub use bits::BitVolume;
pub use error::Error;
pub use medial::{Edge, MedialGraph, Node, NodeKind};
