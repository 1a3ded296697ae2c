//! The implicit function to medial lines: voxelise, thin, graph, prune, recentre.

mod bits;
mod error;
mod masks;
mod medial;
mod settings;
mod thin;

pub use bits::BitVolume;
pub use error::Error;
pub use medial::{Edge, MedialGraph, Node, NodeKind};
pub use settings::Settings;
pub use thin::{ThinReport, thin};
