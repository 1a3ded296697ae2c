//! The implicit function to medial lines: voxelise, thin, graph, prune, recentre.

mod bits;
mod error;
mod masks;
mod graph;
mod lumen;
mod medial;
mod settings;
mod thin;
mod voxelise;

pub use bits::BitVolume;
pub use error::Error;
pub use graph::graph;
pub use lumen::Lumen;
pub use medial::{Edge, MedialGraph, Node, NodeKind};
pub use settings::Settings;
pub use thin::{ThinReport, thin};
pub use voxelise::voxelise;
