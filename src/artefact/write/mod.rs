//! Types to result files. [`write_all`] makes every artefact of contract.md but provenance.json, byte for byte the same
//! from run to run and for any number of threads (nothing here runs in parallel, reads a clock or iterates a hash map);
//! [`provenance`] makes the one file that differs.
//!
//! Everything is made in memory before a byte is written, so that a fault in the last artefact leaves nothing behind.

mod arcs;
mod atlas;
mod csv;
pub mod dicom;
mod error;
mod geometry;
mod glb;
mod html;
mod json;
pub mod metaimage;
pub mod nifti;
mod plot;
pub mod png;
mod provenance;
pub mod render;
mod result;
mod sections;
mod slices;
mod stl;
mod style;
mod trees;
mod vtp;
mod vtu;

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod fixture;
#[cfg(test)]
mod tests;

pub use self::csv::angles_csv;
pub use atlas::{Atlas, contour_atlas, stack_atlas};
pub use error::Error;
pub use geometry::{mesh_vtp, skeleton_vtp, surface_vtp};
pub use glb::{gltf_position, surface_glb};
pub use html::report_html;
pub use json::DIGITS;
pub use provenance::{Provenance, StageTime, provenance};
pub use result::{result_json, skeleton_json};
pub use sections::sections_json;
pub use slices::slice_pictures;
pub use stl::surface_stl;
pub use trees::{skeleton_graphml, skeleton_swc};
pub use vtu::patches_vtu;

pub use crate::NamedBytes;
use crate::Reconstruction;
use crate::reconstruction::Quadrilaterals;

/// The numbers.
pub const RESULT_JSON: &str = "result.json";
/// The angles as a table.
pub const ANGLES_CSV: &str = "angles.csv";
/// The medial graph.
pub const SKELETON_JSON: &str = "skeleton.json";
/// The medial lines for VTK.
pub const SKELETON_VTP: &str = "skeleton.vtp";
/// The medial graph for graph programs, when asked for.
pub const SKELETON_GRAPHML: &str = "skeleton.graphml";
/// The medial lines as a tree, when asked for.
pub const SKELETON_SWC: &str = "skeleton.swc";
/// The cross-sections with their outlines, from which variants are made.
pub const SECTIONS_JSON: &str = "sections.json";
/// The surface for VTK.
pub const SURFACE_VTP: &str = "surface.vtp";
/// The surface and the medial lines for viewers.
pub const SURFACE_GLB: &str = "surface.glb";
/// The surface for everything else.
pub const SURFACE_STL: &str = "surface.stl";
/// The wall alone, its ends open, for programs that cap or extend themselves.
pub const SURFACE_OPEN_VTP: &str = "surface_open.vtp";
/// The surface with flow extensions, closed; caps carry the face ids of surface.vtp.
pub const SURFACE_EXTENDED_VTP: &str = "surface_extended.vtp";
/// The wall as quadrilaterals of high order, when asked for.
pub const PATCHES_VTU: &str = "patches.vtu";
/// The contours for VTK.
pub const CONTOURS_VTP: &str = "contours.vtp";
/// The page to read and print.
pub const REPORT_HTML: &str = "report.html";
/// The grey planes as tiles of one picture.
pub const SLICES_JPG: &str = "slices.jpg";
/// Where its tiles lie, and the contours on them.
pub const SLICES_JSON: &str = "slices.json";
/// Thumbnail.
pub const PREVIEW_PNG: &str = "preview.png";
/// Times, host and version.
pub const PROVENANCE_JSON: &str = "provenance.json";

/// Size of preview.png, pixels.
pub const PREVIEW_SIZE: [usize; 2] = [480, 360];

/// Media type of an artefact by its name.
pub fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("json") => "application/json",
        Some("csv") => "text/csv; charset=utf-8",
        Some("html") => "text/html; charset=utf-8",
        Some("png") => "image/png",
        Some("jpg") => "image/jpeg",
        Some("glb") => "model/gltf-binary",
        Some("stl") => "model/stl",
        Some("vtp" | "vtu") => "application/vnd.vtk+xml",
        Some("zip") => "application/zip",
        Some("xml" | "graphml") => "application/xml",
        Some("swc") => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

/// The artefacts that `outputs` of the plan ask for beyond [`write_all`]: `graphml`, `swc`, and `patches` where the wall could be
/// divided.
///
/// # Errors
/// [`Error::Loops`] for `swc` of a graph with loops; [`Error::NotFinite`].
pub fn write_asked(r: &Reconstruction<'_>, outputs: &[String]) -> Result<Vec<NamedBytes>, Error> {
    let asked = |name: &str| outputs.iter().any(|o| o == name);
    let mut files = Vec::new();
    if asked("graphml") {
        files.push(NamedBytes { name: SKELETON_GRAPHML.into(), bytes: skeleton_graphml(r)? });
    }
    if asked("swc") {
        files.push(NamedBytes { name: SKELETON_SWC.into(), bytes: skeleton_swc(r)? });
    }
    if let Quadrilaterals::Made(quads) = r.surface.quads {
        files.push(NamedBytes { name: PATCHES_VTU.into(), bytes: patches_vtu(quads)? });
    }
    Ok(files)
}

/// Every artefact but provenance.json, in this order: result.json, angles.csv, skeleton.json, skeleton.vtp, surface.vtp,
/// surface.glb, surface.stl, contours.vtp, sections.json, report.html, preview.png; slices.jpg and slices.json where there
/// are planes to show.
///
/// # Errors
/// [`Error::NotFinite`] for a number that is not finite, with its path; [`Error::Mismatch`] for arrays that do not fit
/// together; [`Error::TooLarge`] beyond a format's own limit; [`Error::Encode`].
pub fn write_all(r: &Reconstruction<'_>) -> Result<Vec<NamedBytes>, Error> {
    let contours = geometry::contour_lines(r.contours)?;
    let make = |name, bytes: Result<Vec<u8>, Error>| Ok(NamedBytes::new(name, bytes?));
    let mut files = vec![
        make(RESULT_JSON, result_json(r))?,
        make(ANGLES_CSV, angles_csv(r))?,
        make(SKELETON_JSON, skeleton_json(r))?,
        make(SKELETON_VTP, skeleton_vtp(r))?,
        make(SURFACE_VTP, surface_vtp(r))?,
        make(SURFACE_GLB, surface_glb(r))?,
        make(SURFACE_STL, surface_stl(r.surface.mesh))?,
        make(CONTOURS_VTP, geometry::contours_vtp(&contours))?,
        make(SECTIONS_JSON, sections_json(r))?,
        make(REPORT_HTML, report_html(r))?,
        make(PREVIEW_PNG, render::thumbnail(r, PREVIEW_SIZE))?,
    ];
    if let Some(atlas) = &r.atlas {
        files.push(NamedBytes::new(SLICES_JPG, atlas.jpeg.clone()));
        files.push(make(SLICES_JSON, atlas.json())?);
    }
    Ok(files)
}
