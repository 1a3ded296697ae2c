//! The implicit function to medial lines: voxelise, thin, graph, prune, recentre.

mod medial;

pub use medial::{Edge, MedialGraph, Node, NodeKind};
