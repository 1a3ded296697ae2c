//! The implicit function to triangles: polygonise, project, remesh, cut and cap, distances, patches, checks.

mod mesh;

pub use mesh::{TriMesh, WALL};
