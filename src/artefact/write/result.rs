//! result.json and skeleton.json: the numbers, under the names and in the order of contract.md.
//!
//! Members beyond the contract are additions: `segmentation.axis` and `candidates`; `surface.max_angle_deg`,
//! `displacement_mm`, `patches`, `quads` (where asked for), `quality` and `caps` (with `boundary`, `oblique_deg` and `set_back_mm`); `graph.nodes[].cap`; `branches[].samples.tangent`, `shape` and the standard errors;
//! `branches[].diameter_band95`, `stenosis`, `helix.curvature_band95` and `enough`; `by_distance.residual_mm`; `junctions[].branches`;
//! `variant` where the result is a re-synthesis.
//! What could not be had is null.

use super::json::{Json, warning};
use super::{Error, RESULT_JSON, SKELETON_JSON};
use crate::Reconstruction;
use crate::plan::{self, VariantChange};
use crate::reconstruction::{CapFacts, Quadrilaterals, QualityFacts, Range};
use morphometry::{Angle, Branch, Helix, Junction, Section, Stenosis, VmtkAngles};
use skeleton::{MedialGraph, NodeKind};

/// result.json.
///
/// # Errors
/// [`Error::NotFinite`] with the JSON path.
pub fn result_json(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let m = r.morphometry;
    let mut members = vec![
        ("schema", "vasculum/result/1".into()),
        ("frame", "LPS".into()),
        ("units", Json::Object(vec![("length", "mm".into()), ("angle", "deg".into())])),
        ("input", input(r)),
        ("segmentation", segmentation(r)),
        ("implicit", implicit(r)),
        ("surface", surface(r)),
        ("graph", graph(r)),
        ("branches", Json::List(m.branches.iter().map(branch).collect())),
        ("junctions", Json::List(m.junctions.iter().map(junction).collect())),
        ("warnings", Json::List(r.all_warnings().into_iter().map(warning).collect())),
    ];
    if let Some(v) = &r.variant {
        members.push(("variant", Json::Object(vec![("changes", Json::List(v.changes.iter().map(change).collect()))])));
    }
    Json::Object(members).print(RESULT_JSON)
}

pub(super) fn input(r: &Reconstruction<'_>) -> Json {
    let i = &r.input;
    Json::Object(vec![
        ("slices", i.slices.into()),
        ("missing_slices", Json::list(i.missing_slices.iter().copied())),
        ("spacing_mm", i.spacing_mm.into()),
        ("digest", (&i.digest).into()),
    ])
}

fn segmentation(r: &Reconstruction<'_>) -> Json {
    let s = &r.segmentation;
    let lumen = |&[slice, count]: &[usize; 2]| Json::Object(vec![("slice", slice.into()), ("count", count.into())]);
    let candidates =
        s.candidates.iter().map(|c| Json::Object(vec![("score", c.score.into()), ("chosen", c.chosen.into())]));
    Json::Object(vec![
        ("threshold", s.threshold.into()),
        ("psf_sigma_px", s.psf_sigma_px.into()),
        ("contours", s.contours.into()),
        ("lumens", Json::List(s.lumens.iter().map(lumen).collect())),
        ("axis", (&s.axis).into()),
        ("candidates", Json::List(candidates.collect())),
    ])
}

fn implicit(r: &Reconstruction<'_>) -> Json {
    let f = &r.implicit;
    Json::Object(vec![
        ("constraints", f.constraints.into()),
        ("smoothing", f.smoothing.into()),
        ("residual_max_mm", f.residual_max_mm.into()),
        ("residual_rms_mm", f.residual_rms_mm.into()),
        ("condition", f.condition.into()),
        ("offset_mm", f.offset_mm.into()),
    ])
}

fn range(x: Range) -> Json {
    Json::Object(vec![("min", x.min.into()), ("max", x.max.into()), ("rms", x.rms.into())])
}

fn surface(r: &Reconstruction<'_>) -> Json {
    let s = &r.surface;
    let q = &s.quality;
    let patches = s.patches.map(|p| p.patch_id.iter().max().map_or(0, |&m| m as usize + 1));
    let mut members = vec![
        ("vertices", s.mesh.vertices.len().into()),
        ("triangles", s.mesh.triangles.len().into()),
        ("area_mm2", q.area_mm2.into()),
        ("volume_mm3", q.volume_mm3.into()),
        ("min_angle_deg", q.min_angle_deg.into()),
        ("watertight", q.watertight.into()),
        ("euler", q.euler.into()),
        ("components", q.components.into()),
        ("max_error_mm", q.max_error_mm.into()),
        ("displacement_px", range(q.displacement_px)),
        ("displacement_mm", range(q.displacement_mm)),
        ("max_angle_deg", q.max_angle_deg.into()),
        ("patches", patches.into()),
        ("caps", Json::List(q.caps.iter().map(cap).collect())),
        ("quality", quality(&q.report)),
    ];
    match s.quads {
        Quadrilaterals::Unasked => {}
        Quadrilaterals::Impossible => members.push(("quads", Json::Null)),
        Quadrilaterals::Made(q) => members.push(("quads", quads(q))),
    }
    Json::Object(members)
}

fn quality(r: &QualityFacts) -> Json {
    let q = &r.mesh;
    let worst =
        vec![("face", q.worst.into()), ("position", q.worst_at.into()), ("min_angle_deg", q.min_angle_deg.into())];
    Json::Object(vec![
        ("min_angle_deg", q.min_angle_deg.into()),
        ("mean_min_angle_deg", q.mean_min_angle_deg.into()),
        ("max_angle_deg", q.max_angle_deg.into()),
        ("max_aspect", q.max_aspect.into()),
        ("mean_aspect", q.mean_aspect.into()),
        ("max_skew", q.max_skew.into()),
        ("mean_skew", q.mean_skew.into()),
        ("vertex_max_mm", q.vertex_max_mm.into()),
        ("face_max_mm", q.face_max_mm.into()),
        ("face_rms_mm", q.face_rms_mm.into()),
        ("farthest_at", q.farthest_at.into()),
        ("hausdorff_unsmoothed_mm", r.hausdorff_mm.into()),
        ("volume_change_percent", (100.0 * r.volume_change).into()),
        ("worst", Json::Object(worst)),
    ])
}

fn quads(q: &surface::Quads) -> Json {
    Json::Object(vec![
        ("order", q.order.into()),
        ("patches", q.cells.len().into()),
        ("nodes", q.nodes.len().into()),
        ("poles", Json::list(q.poles.iter().copied())),
        ("separating_mm", q.separating_mm.into()),
        ("max_error_mm", q.max_error_mm.into()),
        ("max_error_at", q.farthest_at.into()),
        ("min_jacobian", q.least_jacobian.into()),
        ("min_sine", q.least_sine.into()),
    ])
}

fn cap(c: &CapFacts) -> Json {
    Json::Object(vec![
        ("face_id", c.face_id.into()),
        ("name", (&c.name).into()),
        ("boundary", (&c.boundary).into()),
        ("centroid", c.centroid.into()),
        ("normal", c.normal.into()),
        ("area_mm2", c.area_mm2.into()),
        ("oblique_deg", c.oblique_deg.into()),
        ("set_back_mm", c.set_back_mm.into()),
    ])
}

fn node(id: usize, n: &skeleton::Node) -> Json {
    let kind = match n.kind {
        NodeKind::Junction => "junction",
        NodeKind::End => "end",
    };
    Json::Object(vec![
        ("id", id.into()),
        ("kind", kind.into()),
        ("position", n.position.into()),
        ("radius_mm", n.radius_mm.into()),
        ("cap", n.cap.into()),
    ])
}

fn edge(r: &Reconstruction<'_>, id: usize, e: &skeleton::Edge) -> Vec<(&'static str, Json)> {
    let length = e.points.windows(2).fold(0.0, |s, p| s + p[0].distance(p[1]));
    let branch = r.morphometry.branches.iter().find(|b| b.id == id).map(|b| b.id);
    vec![("id", id.into()), ("nodes", Json::list(e.nodes)), ("branch", branch.into()), ("length_mm", length.into())]
}

fn graph(r: &Reconstruction<'_>) -> Json {
    let g = r.graph;
    Json::Object(vec![
        ("nodes", Json::List(g.nodes.iter().enumerate().map(|(i, n)| node(i, n)).collect())),
        ("edges", Json::List(g.edges.iter().enumerate().map(|(i, e)| Json::Object(edge(r, i, e))).collect())),
        ("cycles", g.cycles().into()),
    ])
}

/// A change as the plan asked for it.
fn change(c: &VariantChange) -> Json {
    let which = |b: &plan::Branch| match b {
        plan::Branch::Id(id) => Json::from(*id),
        plan::Branch::Role(name) => name.into(),
    };
    let members: [(&'static str, Json); 8] = [
        ("branch", which(&c.branch)),
        ("angle_deg", c.angle_deg.into()),
        ("to", c.to.as_ref().map_or(Json::Null, which)),
        ("curvature_factor", c.curvature_factor.into()),
        ("curvature_per_mm", c.curvature_per_mm.into()),
        ("torsion_per_mm", c.torsion_per_mm.into()),
        ("straight", c.straight.into()),
        ("planar", c.planar.into()),
    ];
    Json::Object(members.into_iter().filter(|(_, v)| *v != Json::Null).collect())
}

fn branch(b: &Branch) -> Json {
    Json::Object(vec![
        ("id", b.id.into()),
        ("role", b.role.name().into()),
        ("from_node", b.from_node.into()),
        ("to_node", b.to_node.into()),
        ("length_mm", b.length_mm.into()),
        ("tortuosity", b.tortuosity.into()),
        ("direction", b.direction.into()),
        ("diameter_mm", b.diameter_mm.into()),
        ("samples", samples(&b.sections)),
        ("helix", b.helix.map_or(Json::Null, helix)),
        ("diameter_band95", b.diameter_band95_mm.into()),
        ("stenosis", b.stenosis.map_or(Json::Null, stenosis)),
    ])
}

fn stenosis(s: Stenosis) -> Json {
    Json::Object(vec![("area_ratio", s.area_ratio.into()), ("abscissa_mm", s.abscissa_mm.into())])
}

fn samples(sections: &[Section]) -> Json {
    fn column<T: Into<Json>>(sections: &[Section], value: impl Fn(&Section) -> T) -> Json {
        Json::list(sections.iter().map(value))
    }
    Json::Object(vec![
        ("abscissa_mm", column(sections, |s| s.abscissa_mm)),
        ("position", column(sections, |s| s.position)),
        ("radius_inscribed_mm", column(sections, |s| s.radius_inscribed_mm)),
        ("radius_area_mm", column(sections, Section::radius_area_mm)),
        ("radius_hydraulic_mm", column(sections, Section::radius_hydraulic_mm)),
        ("area_mm2", column(sections, |s| s.area_mm2)),
        ("perimeter_mm", column(sections, |s| s.perimeter_mm)),
        ("curvature_per_mm", column(sections, |s| s.curvature_per_mm)),
        ("in_junction", column(sections, |s| s.in_junction)),
        ("open", column(sections, |s| s.open)),
        ("tangent", column(sections, |s| s.tangent)),
        ("shape", column(sections, |s| s.shape)),
        ("area_error_mm2", column(sections, |s| s.area_error_mm2)),
        ("curvature_error_per_mm", column(sections, |s| s.curvature_error_per_mm)),
    ])
}

fn helix(h: Helix) -> Json {
    let handedness = if h.torsion_per_mm > 0.0 {
        Json::from("right")
    } else if h.torsion_per_mm < 0.0 {
        Json::from("left")
    } else {
        Json::Null
    };
    Json::Object(vec![
        ("radius_mm", h.radius_mm.into()),
        ("pitch_mm", h.pitch_mm.into()),
        ("curvature_per_mm", h.curvature_per_mm.into()),
        ("torsion_per_mm", h.torsion_per_mm.into()),
        ("torsion_band95", h.torsion_band95.into()),
        ("rms_mm", h.rms_mm.into()),
        ("handedness", handedness),
        ("curvature_band95", h.curvature_band95.into()),
        ("enough", h.enough.name().into()),
    ])
}

fn junction(j: &Junction) -> Json {
    Json::Object(vec![
        ("node", j.node.into()),
        ("medial_point", j.medial_point.into()),
        ("axes_point", j.axes_point.into()),
        ("plane_normal", j.plane_normal.into()),
        ("crotch_mm", j.crotch_mm.into()),
        ("angles", Json::List(j.angles.iter().map(angle).collect())),
        ("vmtk", j.vmtk.as_ref().map_or(Json::Null, vmtk)),
        ("branches", Json::list(j.branches.iter().copied())),
    ])
}

fn angle(a: &Angle) -> Json {
    let by_distance = a.by_distance.as_ref().map_or(Json::Null, |d| {
        Json::Object(vec![
            ("diameters", Json::list(d.diameters.iter().copied())),
            ("value", Json::list(d.value_deg.iter().copied())),
            ("residual_mm", Json::list(d.residual_mm.iter().copied())),
        ])
    });
    Json::Object(vec![
        ("name", (&a.name).into()),
        ("value", a.value_deg.into()),
        ("band95", a.band95_deg.into()),
        ("window_diameters", a.window_diameters.into()),
        ("by_distance", by_distance),
    ])
}

fn vmtk(v: &VmtkAngles) -> Json {
    Json::Object(vec![
        ("in_plane", Json::list(v.in_plane_deg.iter().copied())),
        ("out_of_plane", Json::list(v.out_of_plane_deg.iter().copied())),
        ("inlet", v.inlet.into()),
    ])
}

/// skeleton.json: the medial graph as a node-link document (the layout of networkx.node_link_graph with
/// `edges="links"`: `nodes` with `id`, `links` with `source`, `target` and `key`, a multigraph because a vessel tree
/// may have parallel branches), with the points and the inscribed radius along every link.
///
/// # Errors
/// [`Error::NotFinite`] with the JSON path.
pub fn skeleton_json(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let g: &MedialGraph = r.graph;
    let links = g.edges.iter().enumerate().map(|(i, e)| {
        let mut members = vec![
            ("source", e.nodes[0].into()),
            ("target", e.nodes[1].into()),
            ("key", i.into()),
            ("role", r.role_of_edge(i).map(morphometry::Role::name).into()),
        ];
        members.extend(edge(r, i, e));
        members.push(("points", Json::list(e.points.iter().copied())));
        members.push(("radius_mm", Json::list(e.radius_mm.iter().copied())));
        Json::Object(members)
    });
    Json::Object(vec![
        ("schema", "vasculum/skeleton/1".into()),
        ("frame", "LPS".into()),
        ("units", Json::Object(vec![("length", "mm".into())])),
        ("directed", false.into()),
        ("multigraph", true.into()),
        ("graph", Json::Object(vec![("cycles", g.cycles().into())])),
        ("nodes", Json::List(g.nodes.iter().enumerate().map(|(i, n)| node(i, n)).collect())),
        ("links", Json::List(links.collect())),
    ])
    .print(SKELETON_JSON)
}
