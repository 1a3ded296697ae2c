//! The implicit function to triangles: polygonise, project, cut and cap, remesh, distances, patches, checks.
//!
//! f = 0 on the wall, f > 0 in the lumen. The usual way is [`shell`]: [`polygonise`] of the field [`Bounded`] by the planes
//! at which the data end, from the contour points; [`cut`] of the raw mesh by those planes, with the field itself;
//! [`remesh`] with the planes, which lands every wall vertex on f = 0. Then [`check`], [`self_intersections`], [`quality`],
//! [`displacement`] and [`patches`]. [`project`] is for those who want the raw mesh on f = 0 without remeshing.

mod cap;
mod cut;
#[cfg(test)]
mod dent;
mod distance;
mod ends;
mod error;
mod fabric;
#[cfg(test)]
mod fields;
mod improve;
mod intersect;
mod land;
mod mesh;
mod patch;
#[cfg(test)]
mod phantoms;
mod polish;
mod polygonise;
mod quads;
mod quality;
mod remesh;
mod ring;
mod shell;
mod sizing;
mod sparse;
#[cfg(test)]
mod survey;
mod topology;
mod web;

pub use cap::Bounded;
pub use cut::{Cap, CutReport, cut};
pub use distance::{Displacement, displacement};
pub use ends::{Extended, Extension, ExtensionReport, extend, open};
pub use error::Error;
pub use intersect::self_intersections;
pub use land::{ProjectReport, project};
pub use mesh::{TriMesh, WALL};
pub use patch::{Patches, patches};
pub use polygonise::{PolygoniseReport, PolygoniseSettings, polygonise};
pub use quads::{QuadSettings, Quads, quads};
pub use quality::{Quality, quality};
pub use remesh::{RemeshReport, RemeshSettings, Sizing, remesh};
pub use shell::{Shell, openings, shell};
pub use topology::{Defect, DefectKind, Topology, check, topology};
