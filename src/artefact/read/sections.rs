//! sections.json back to a [`Model`]: what a re-synthesis starts from.

use super::Error;
use crate::reconstruction::InputFacts;
use morphometry::{Model, ModelBranch, ModelJunction, ModelSection, Role, SectionOutline};
use serde::Deserialize;
use space::{P3, V3};

/// `schema` of sections.json.
pub const SECTIONS_SCHEMA: &str = "vasculum/sections/1";
/// Largest file, bytes: an aorta with twenty branches takes 3 MB.
const MOST_BYTES: u64 = 64 << 20;
/// Rays of an outline.
const RAYS: [usize; 2] = [8, 1024];
/// Coordinates beyond 100 m and radii beyond 1 m are a mistake of units.
const FAR_MM: f64 = 1e5;
const WIDE_MM: f64 = 1e3;

#[derive(Deserialize)]
struct File {
    schema: String,
    frame: String,
    pixel_mm: f64,
    input: Input,
    branches: Vec<Branch>,
    junctions: Vec<Junction>,
}

#[derive(Deserialize)]
struct Input {
    slices: usize,
    missing_slices: Vec<usize>,
    spacing_mm: [f64; 3],
    digest: String,
}

#[derive(Deserialize)]
struct Branch {
    id: usize,
    role: String,
    nodes: [usize; 2],
    tip: [bool; 2],
    direction: Option<[f64; 3]>,
    sections: Vec<Section>,
}

#[derive(Deserialize)]
struct Section {
    position: [f64; 3],
    tangent: [f64; 3],
    outline: Option<Outline>,
}

#[derive(Deserialize)]
struct Outline {
    centre: [f64; 3],
    first: [f64; 3],
    radii_mm: Vec<f64>,
}

#[derive(Deserialize)]
struct Junction {
    node: usize,
    point: [f64; 3],
    plane_normal: Option<[f64; 3]>,
}

/// The model in a sections.json (`file` is its name for messages), and the scan that it came from.
///
/// # Errors
/// [`Error::TooLarge`]; [`Error::Malformed`] for what is no such file, or holds what cannot be: lines of fewer than two
/// sections, directions that are no unit vectors, radii that are not positive.
pub fn sections(file: &str, bytes: &[u8]) -> Result<(Model, InputFacts), Error> {
    let size = bytes.len() as u64;
    if size > MOST_BYTES {
        return Err(Error::TooLarge {
            file: Some(file.to_owned()),
            what: "its size in bytes",
            value: size,
            limit: MOST_BYTES,
        });
    }
    let malformed = |reason: String| Error::Malformed { file: file.to_owned(), reason };
    let read: File = serde_json::from_slice(bytes).map_err(|e| malformed(format!("it is no sections.json: {e}")))?;
    if read.schema != SECTIONS_SCHEMA || read.frame != "LPS" {
        return Err(malformed(format!(
            "its schema is {} in frame {}, wanted is {SECTIONS_SCHEMA} in LPS",
            read.schema, read.frame
        )));
    }
    if !(read.pixel_mm > 0.0 && read.pixel_mm <= WIDE_MM) {
        return Err(malformed(format!("pixel_mm is {}", read.pixel_mm)));
    }
    let branches = read.branches.iter().map(branch).collect::<Result<Vec<_>, _>>().map_err(malformed)?;
    let junctions = read.junctions.iter().map(junction).collect::<Result<Vec<_>, _>>().map_err(malformed)?;
    if branches.is_empty() {
        return Err(malformed("it has no branches".into()));
    }
    let i = read.input;
    let input =
        InputFacts { slices: i.slices, missing_slices: i.missing_slices, spacing_mm: i.spacing_mm, digest: i.digest };
    Ok((Model { pixel_mm: read.pixel_mm, branches, junctions }, input))
}

fn branch(b: &Branch) -> Result<ModelBranch, String> {
    let at = |e: String| format!("branch {}: {e}", b.id);
    let role = Role::named(&b.role).ok_or_else(|| at(format!("its role is {}", b.role)))?;
    if b.sections.len() < 2 {
        return Err(at("it has fewer than two sections".into()));
    }
    let direction = b.direction.map(unit).transpose().map_err(at)?;
    let section = |(k, s): (usize, &Section)| section(s).map_err(|e| at(format!("section {k}: {e}")));
    let sections = b.sections.iter().enumerate().map(section).collect::<Result<Vec<_>, _>>()?;
    Ok(ModelBranch { id: b.id, role, nodes: b.nodes, tip: b.tip, direction, sections })
}

fn section(s: &Section) -> Result<ModelSection, String> {
    let outline = s.outline.as_ref().map(outline).transpose()?;
    Ok(ModelSection { position: point(s.position)?, tangent: unit(s.tangent)?, outline })
}

fn outline(o: &Outline) -> Result<SectionOutline, String> {
    let n = o.radii_mm.len();
    if !(RAYS[0]..=RAYS[1]).contains(&n) {
        return Err(format!("its outline has {n} rays, {} to {} are read", RAYS[0], RAYS[1]));
    }
    if let Some(r) = o.radii_mm.iter().find(|r| !(**r > 0.0 && **r <= WIDE_MM)) {
        return Err(format!("a radius is {r} mm"));
    }
    Ok(SectionOutline { centre: point(o.centre)?, first: unit(o.first)?, radii_mm: o.radii_mm.clone() })
}

fn junction(j: &Junction) -> Result<ModelJunction, String> {
    let at = |e: String| format!("junction {}: {e}", j.node);
    let plane_normal = j.plane_normal.map(unit).transpose().map_err(at)?;
    Ok(ModelJunction { node: j.node, point: point(j.point).map_err(at)?, plane_normal })
}

fn point(p: [f64; 3]) -> Result<P3, String> {
    if p.iter().all(|x| x.abs() <= FAR_MM) { Ok(P3::from(p)) } else { Err(format!("a point is {p:?}")) }
}

/// Numbers are printed with nine digits: brought back to length 1 exactly.
fn unit(v: [f64; 3]) -> Result<V3, String> {
    let v = V3::from(v);
    let length = v.length();
    let near = (length - 1.0).abs() < 1e-6;
    v.normalised().filter(|_| near).ok_or_else(|| format!("a direction has length {length}"))
}
