//! The implicit function to medial lines: voxelise, thin, graph, prune, recentre.
//!
//! [`medial_graph`] does all of it; the steps are public so that each can be tested and measured alone.

mod bits;
mod caps;
mod check;
mod cluster;
mod error;
mod graph;
mod lumen;
mod masks;
mod medial;
mod pinholes;
mod prune;
mod recentre;
mod settings;
mod thin;
mod voxelise;
mod whole;

pub use bits::BitVolume;
pub use caps::{CapHint, cut_back, extend_to_caps};
pub use check::check;
pub use error::Error;
pub use graph::graph;
pub use lumen::Lumen;
pub use medial::{Edge, MedialGraph, Node, NodeKind};
pub use prune::{PruneReport, prune};
pub use recentre::{Missing, recentre, swollen};
pub use settings::Settings;
pub use thin::{ThinReport, thin};
pub use voxelise::voxelise;
pub use whole::{Report, medial_graph};
