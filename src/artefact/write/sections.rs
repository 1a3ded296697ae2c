//! sections.json: the tree as cross-sections along its medial lines, with their outlines. It holds all that a
//! re-synthesis needs ([`crate::read::sections`]), and what a reader wants who draws sections himself: outline point k of
//! a section is centre + radii_mm[k] (first cos a + (tangent x first) sin a) with a = 2 pi k / count.

use super::json::Json;
use super::{Error, SECTIONS_JSON};
use crate::Reconstruction;
use morphometry::{Branch, Junction, Section};
use skeleton::NodeKind;

/// sections.json.
///
/// # Errors
/// [`Error::NotFinite`] with the JSON path.
pub fn sections_json(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let m = r.morphometry;
    Json::Object(vec![
        ("schema", crate::read::SECTIONS_SCHEMA.into()),
        ("frame", "LPS".into()),
        ("units", Json::Object(vec![("length", "mm".into())])),
        ("pixel_mm", r.contours.pixel_mm.into()),
        ("input", super::result::input(r)),
        ("branches", Json::List(m.branches.iter().map(|b| branch(r, b)).collect())),
        ("junctions", Json::List(m.junctions.iter().map(junction).collect())),
    ])
    .print(SECTIONS_JSON)
}

fn branch(r: &Reconstruction<'_>, b: &Branch) -> Json {
    let tip = |n: usize| {
        let node = r.graph.nodes.get(n);
        Json::from(node.is_some_and(|n| n.kind == NodeKind::End && n.cap.is_none()))
    };
    let nodes = [b.from_node, b.to_node];
    Json::Object(vec![
        ("id", b.id.into()),
        ("role", b.role.name().into()),
        ("nodes", Json::list(nodes)),
        ("tip", Json::list(nodes.map(tip))),
        ("direction", b.direction.into()),
        ("sections", Json::List(b.sections.iter().map(section).collect())),
    ])
}

fn section(s: &Section) -> Json {
    let outline = s.outline.as_ref().filter(|_| !s.in_junction && !s.open).map(|o| {
        Json::Object(vec![
            ("centre", o.centre.into()),
            ("first", o.first.into()),
            ("radii_mm", Json::list(o.radii_mm.iter().copied())),
        ])
    });
    Json::Object(vec![
        ("abscissa_mm", s.abscissa_mm.into()),
        ("position", s.position.into()),
        ("tangent", s.tangent.into()),
        ("outline", outline.unwrap_or(Json::Null)),
    ])
}

fn junction(j: &Junction) -> Json {
    Json::Object(vec![
        ("node", j.node.into()),
        ("point", j.axes_point.unwrap_or(j.medial_point).into()),
        ("plane_normal", j.plane_normal.into()),
    ])
}
