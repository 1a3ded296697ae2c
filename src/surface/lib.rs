//! The implicit function to triangles: polygonise, project, cut and cap, remesh, distances, patches, checks.
//!
//! f = 0 on the wall, f > 0 in the lumen. The usual way: [`polygonise`] from the contour points, [`project`], [`cut`]
//! by the planes at which the data end, [`remesh`], then [`check`], [`quality`], [`displacement`] and [`patches`].

mod error;
#[cfg(test)]
mod fields;
mod land;
mod mesh;
mod polygonise;
mod topology;
mod web;

pub use error::Error;
pub use land::{ProjectReport, project};
pub use mesh::{TriMesh, WALL};
pub use polygonise::{PolygoniseReport, PolygoniseSettings, polygonise};
pub use topology::{Defect, DefectKind, Topology, check};
