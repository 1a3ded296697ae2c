//! The artefacts of the synthetic reconstruction, read back by means that are not the writers'.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use super::fixture::Fixture;
use super::geometry::{ContourLine, contours_vtp};
use super::vtp::reader::array;
use super::*;
use serde_json::Value;
use space::{FaultKind, Faulty, P3};

fn bytes<'a>(all: &'a [NamedBytes], name: &str) -> &'a [u8] {
    &all.iter().find(|a| a.name == name).unwrap().bytes
}

fn parsed(bytes: &[u8]) -> Value {
    serde_json::from_slice(bytes).unwrap()
}

fn keys(v: &Value) -> Vec<&str> {
    v.as_object().unwrap().keys().map(String::as_str).collect()
}

/// The names that contract.md gives, in its order, come first; additions may follow.
fn assert_begins(v: &Value, names: &str) {
    let wanted: Vec<&str> = names.split_whitespace().collect();
    assert_eq!(keys(v)[..wanted.len()], wanted[..]);
}

#[test]
fn result_json_has_every_member_of_the_contract_in_order() {
    let f = Fixture::new();
    let v = parsed(&result_json(&f.reconstruction()).unwrap());
    assert_eq!(
        keys(&v),
        [
            "schema",
            "frame",
            "units",
            "input",
            "segmentation",
            "implicit",
            "surface",
            "graph",
            "branches",
            "junctions",
            "warnings"
        ]
    );
    assert_eq!((v["schema"].as_str(), v["frame"].as_str()), (Some("vasculum/result/1"), Some("LPS")));
    assert_eq!(v["units"], serde_json::json!({"length": "mm", "angle": "deg"}));
    assert_begins(&v["input"], "slices missing_slices spacing_mm digest");
    assert_begins(&v["segmentation"], "threshold psf_sigma_px contours lumens");
    assert_begins(&v["segmentation"]["lumens"][0], "slice count");
    assert_begins(&v["implicit"], "constraints smoothing residual_max_mm residual_rms_mm condition offset_mm");
    assert_begins(
        &v["surface"],
        "vertices triangles area_mm2 volume_mm3 min_angle_deg watertight euler components max_error_mm displacement_px",
    );
    assert_begins(&v["surface"]["displacement_px"], "min max rms");
    assert_begins(&v["graph"], "nodes edges cycles");
    assert_begins(&v["graph"]["nodes"][0], "id kind position radius_mm");
    assert_begins(&v["graph"]["edges"][0], "id nodes branch length_mm");
    assert_begins(
        &v["branches"][0],
        "id role from_node to_node length_mm tortuosity direction diameter_mm samples helix",
    );
    assert_begins(
        &v["branches"][0]["samples"],
        "abscissa_mm position radius_inscribed_mm radius_area_mm radius_hydraulic_mm area_mm2 perimeter_mm \
         curvature_per_mm in_junction open",
    );
    assert_begins(
        &v["branches"][2]["helix"],
        "radius_mm pitch_mm curvature_per_mm torsion_per_mm torsion_band95 rms_mm handedness",
    );
    assert_begins(&v["junctions"][0], "node medial_point axes_point plane_normal crotch_mm angles vmtk");
    assert_begins(&v["junctions"][0]["angles"][0], "name value band95 window_diameters by_distance");
    assert_begins(&v["junctions"][0]["angles"][0]["by_distance"], "diameters value");
    assert_begins(&v["junctions"][0]["vmtk"], "in_plane out_of_plane");
    assert_begins(&v["warnings"][0], "code message where");
}

#[test]
fn result_json_tells_the_values_that_it_was_given() {
    let f = Fixture::new();
    let v = parsed(&result_json(&f.reconstruction()).unwrap());
    assert_eq!(v["segmentation"]["psf_sigma_px"], Value::Null);
    assert_eq!(v["implicit"]["smoothing"], 3.1e-4);
    assert_eq!(v["graph"]["nodes"][0]["kind"], "junction");
    assert_eq!(v["graph"]["cycles"], 0);
    assert_eq!(v["branches"][0]["role"], "graft");
    assert_eq!(v["branches"][0]["helix"], Value::Null);
    assert_eq!(v["branches"][2]["helix"]["handedness"], "right");
    let angles = &v["junctions"][0]["angles"];
    assert_eq!((angles[0]["value"].as_f64(), angles[0]["name"].as_str()), (Some(45.4), Some("graft_proximal")));
    assert_eq!(angles[4]["value"], Value::Null);
    assert_eq!(angles[1]["by_distance"]["value"][0], Value::Null);
    assert_eq!(v["warnings"][0]["where"], serde_json::json!({"slice": 7}));
    assert_eq!(v["warnings"].as_array().unwrap().len(), 2);
    let area = v["branches"][0]["samples"]["area_mm2"][20].as_f64().unwrap();
    let radius = v["branches"][0]["samples"]["radius_area_mm"][20].as_f64().unwrap();
    assert!((area - std::f64::consts::PI * radius * radius).abs() < 1e-6);
    let (surface, mesh) = (&v["surface"], &f.mesh);
    assert_eq!(surface["vertices"].as_u64(), Some(mesh.vertices.len() as u64));
    assert!((surface["volume_mm3"].as_f64().unwrap() / mesh.volume() - 1.0).abs() < 1e-8);
}

#[test]
fn the_fixture_is_a_closed_surface_with_outward_normals() {
    let f = Fixture::new();
    let mut edges: Vec<(u32, u32)> =
        f.mesh.triangles.iter().flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]).collect();
    edges.sort_unstable();
    assert!(edges.iter().all(|&(a, b)| edges.binary_search(&(b, a)).is_ok()));
    assert!(f.mesh.volume() > 1000.0);
}

#[test]
fn a_number_that_is_not_finite_is_refused_with_its_path_and_as_our_own_fault() {
    let mut f = Fixture::new();
    f.morphometry.junctions[0].angles[1].value_deg = Some(f64::NAN);
    let Err(e) = write_all(&f.reconstruction()) else { panic!("a NaN angle was written") };
    let Error::NotFinite { artefact, path, .. } = &e else { panic!("{e}") };
    assert_eq!((*artefact, path.as_str()), ("result.json", "$.junctions[0].angles[1].value"));
    assert_eq!((e.kind(), e.code()), (FaultKind::Internal, "artefact.not_finite"));
    assert!(matches!(angles_csv(&f.reconstruction()), Err(Error::NotFinite { .. })));
}

#[test]
fn every_geometry_writer_refuses_a_vertex_that_is_not_finite() {
    let mut f = Fixture::new();
    f.mesh.vertices[5] = P3::new(0.0, f64::INFINITY, 0.0);
    let r = f.reconstruction();
    assert!(matches!(surface_vtp(&r), Err(Error::NotFinite { .. })));
    assert!(matches!(surface_glb(&r), Err(Error::NotFinite { .. })));
    assert!(matches!(surface_stl(r.surface.mesh), Err(Error::NotFinite { .. })));
}

#[test]
fn arrays_that_do_not_fit_together_are_refused() {
    let mut f = Fixture::new();
    f.displacement.pop();
    assert!(matches!(surface_vtp(&f.reconstruction()), Err(Error::Mismatch { what: "Displacement_mm", .. })));
    let mut f = Fixture::new();
    f.mesh.triangles[0][0] = u32::MAX;
    let r = f.reconstruction();
    for result in [
        surface_vtp(&r),
        surface_glb(&r),
        report_html(&r),
        surface_stl(r.surface.mesh),
        render::thumbnail(&r, PREVIEW_SIZE),
    ] {
        assert!(matches!(result, Err(Error::Mismatch { what: "vertex index", .. })));
    }
}

#[test]
fn sections_are_read_back_as_they_were_written() {
    let f = Fixture::new();
    let r = f.reconstruction();
    let (read, input) = crate::read::sections("sections.json", &sections_json(&r).unwrap()).unwrap();
    let tips: Vec<usize> = (0..r.graph.nodes.len()).filter(|&n| r.graph.nodes[n].cap.is_none()).collect();
    let wanted = morphometry::Model::of(r.morphometry, &tips, r.contours.pixel_mm);
    assert_eq!(input, r.input);
    assert_eq!((read.branches.len(), read.junctions.len()), (wanted.branches.len(), wanted.junctions.len()));
    for (a, b) in read.branches.iter().zip(&wanted.branches) {
        assert_eq!((a.id, a.role, a.nodes), (b.id, b.role, b.nodes));
        for (a, b) in a.sections.iter().zip(&b.sections) {
            assert!(a.position.distance(b.position) < 1e-6 && a.tangent.angle_to(b.tangent) < 1e-7);
            assert_eq!(a.outline.is_some(), b.outline.is_some());
            let radii = |s: &morphometry::ModelSection| s.outline.as_ref().map_or(Vec::new(), |o| o.radii_mm.clone());
            assert!(radii(a).iter().zip(radii(b)).all(|(x, y)| (x - y).abs() < 1e-7));
        }
    }
}

#[test]
fn a_damaged_sections_file_is_refused_with_what_is_wrong() {
    let f = Fixture::new();
    let text = String::from_utf8(sections_json(&f.reconstruction()).unwrap()).unwrap();
    for (from, to, what) in [
        ("vasculum/sections/1", "vasculum/sections/9", "schema"),
        ("\"pixel_mm\": ", "\"pixel_mm\": -", "pixel_mm"),
        ("\"role\": \"graft\"", "\"role\": \"wife\"", "role"),
        ("\"tangent\": [", "\"tangent\": [9.0, ", "sections.json"),
        ("\"radii_mm\": [", "\"radii_mm\": [-1.0, ", "radius"),
    ] {
        let damaged = text.replacen(from, to, 1);
        assert_ne!(damaged, text, "{from}");
        let error = crate::read::sections("sections.json", damaged.as_bytes()).unwrap_err().to_string();
        assert!(error.contains(what), "{what}: {error}");
    }
}

#[test]
fn all_artefacts_come_in_a_fixed_order_and_with_the_same_bytes() {
    let f = Fixture::new();
    let all = write_all(&f.reconstruction()).unwrap();
    let names: Vec<&str> = all.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "result.json",
            "angles.csv",
            "skeleton.json",
            "skeleton.vtp",
            "surface.vtp",
            "surface.glb",
            "surface.stl",
            "contours.vtp",
            "sections.json",
            "report.html",
            "preview.png"
        ]
    );
    assert_eq!(all, write_all(&Fixture::new().reconstruction()).unwrap());
    leave("", &all);
}

#[test]
fn angles_csv_is_one_tidy_table() {
    let f = Fixture::new();
    let text = angles_csv(&f.reconstruction()).unwrap();
    let mut reader = ::csv::Reader::from_reader(text.as_slice());
    assert_eq!(
        reader.headers().unwrap().iter().take(5).collect::<Vec<_>>(),
        ["junction", "angle", "kind", "distance_diameters", "value_deg"]
    );
    let rows: Vec<::csv::StringRecord> = reader.records().map(Result::unwrap).collect();
    assert_eq!(rows.len(), 5 + 4 * 25);
    let values: Vec<&::csv::StringRecord> = rows.iter().filter(|r| &r[2] == "value").collect();
    assert_eq!((&values[0][1], &values[0][4], &values[0][5], &values[0][8]), ("graft_proximal", "45.4", "44.8", "4.0"));
    assert_eq!(&values[4][4], "");
    assert_eq!(rows.iter().filter(|r| &r[2] == "by_distance" && r[4].is_empty()).count(), 4 * 2);
}

#[test]
fn skeleton_json_is_a_node_link_document() {
    let f = Fixture::new();
    let v = parsed(&skeleton_json(&f.reconstruction()).unwrap());
    assert_eq!((v["directed"].as_bool(), v["multigraph"].as_bool()), (Some(false), Some(true)));
    assert_eq!(v["nodes"].as_array().unwrap().len(), 4);
    let link = &v["links"][2];
    assert_eq!((link["source"].as_u64(), link["target"].as_u64()), (Some(3), Some(0)));
    assert_eq!(link["points"].as_array().unwrap().len(), link["radius_mm"].as_array().unwrap().len());
}

#[test]
fn surface_vtp_holds_the_mesh_and_the_contract_s_arrays() {
    let f = Fixture::new();
    let file = surface_vtp(&f.reconstruction()).unwrap();
    let (n, m) = (f.mesh.vertices.len(), f.mesh.triangles.len());
    let (kind, points) = array(&file, "Points").unwrap();
    assert_eq!((kind.as_str(), points.len()), ("Float64", 3 * n));
    assert_eq!(points[3..6], f.mesh.vertices[1].to_array());
    for name in ["Displacement_mm", "Displacement_px", "U", "V"] {
        assert_eq!(array(&file, name).unwrap().1.len(), n, "{name}");
    }
    for name in ["FaceId", "PatchId"] {
        assert_eq!(array(&file, name).unwrap().1.len(), m, "{name}");
    }
    let (_, normals) = array(&file, "Normals").unwrap();
    assert!(normals.chunks(3).all(|c| (c.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12));
}

#[test]
fn skeleton_vtp_follows_vmtk() {
    let f = Fixture::new();
    let file = skeleton_vtp(&f.reconstruction()).unwrap();
    let get = |name: &str| array(&file, name).unwrap().1;
    // Each branch is a tract inside the junction and one outside, which share a point.
    assert_eq!(get("Blanking"), [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]);
    assert_eq!(get("CenterlineIds"), [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]);
    assert_eq!(get("TractIds"), [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]);
    assert_eq!(get("GroupIds"), [3.0, 0.0, 3.0, 1.0, 3.0, 2.0]);
    let abscissas = get("Abscissas");
    assert_eq!(abscissas.len(), 3 * 42);
    // The distal edge is stored end first and must be turned round.
    let points = get("Points");
    let start = 3 * 2 * 42;
    assert_eq!(points[start..start + 3], f.graph.nodes[0].position.to_array());
    assert!((abscissas[125] - f.morphometry.branches[2].length_mm).abs() < 1e-9);
    let area = get("Area_mm2");
    assert!(area[0].is_nan());
    assert!((area[20] - f.morphometry.branches[0].sections[19].area_mm2.unwrap()).abs() < 1e-6);
    let torsion = get("Torsion");
    assert!(torsion[0].is_nan() && (torsion[125] - 0.09).abs() < 1e-12);
    assert_eq!(get("MaximumInscribedSphereRadius")[125], f.graph.edges[2].radius_mm[0]);
}

#[test]
fn a_graph_without_measures_is_still_written() {
    let mut f = Fixture::new();
    f.morphometry = morphometry::Morphometry::default();
    let all = write_all(&f.reconstruction()).unwrap();
    let file = bytes(&all, SKELETON_VTP);
    assert_eq!(array(file, "Blanking").unwrap().1, [0.0; 3]);
    assert!(array(file, "Torsion").is_none());
    assert_eq!(parsed(bytes(&all, RESULT_JSON))["graph"]["edges"][0]["branch"], Value::Null);
}

#[test]
fn contours_vtp_closes_its_lines() {
    let at = |i: usize| P3::new((i as f64).cos(), (i as f64).sin(), 3.0);
    let line = ContourLine {
        plane: 4,
        lumen: 1,
        hole: false,
        level: 118.0,
        standard_error_mm: 0.02,
        points: (0..5).map(at).collect(),
        on_border: vec![false, true, true, false, false],
    };
    let file = contours_vtp(&[line.clone(), ContourLine { plane: 5, ..line }]).unwrap();
    assert_eq!(array(&file, "connectivity").unwrap().1[..6], [0.0, 1.0, 2.0, 3.0, 4.0, 0.0]);
    assert_eq!(array(&file, "offsets").unwrap().1, [6.0, 12.0]);
    assert_eq!(array(&file, "Plane").unwrap().1, [4.0, 5.0]);
    assert_eq!(array(&file, "OnBorder").unwrap().1[..5], [0.0, 1.0, 1.0, 0.0, 0.0]);
    assert_eq!(array(&file, "Level").unwrap().1, [118.0; 2]);
    assert_eq!(array(&file, "StandardError_mm").unwrap().1, [0.02; 2]);
}

#[test]
fn stl_has_its_exact_size_and_outward_normals() {
    let f = Fixture::new();
    let file = surface_stl(&f.mesh).unwrap();
    assert_eq!(file.len(), 84 + 50 * f.mesh.triangles.len());
    assert!(!file.starts_with(b"solid"));
    let float = |at: usize| f64::from(f32::from_le_bytes(file[at..at + 4].try_into().unwrap()));
    let n = f.mesh.area_vector(7).normalised().unwrap();
    assert!((float(84 + 50 * 7) - n.x()).abs() < 1e-6);
    assert!((float(84 + 50 * 7 + 12) - f.mesh.corners(7)[0].x()).abs() < 1e-5);
}

#[test]
fn glb_is_in_metres_with_the_head_up() {
    let f = Fixture::new();
    let file = surface_glb(&f.reconstruction()).unwrap();
    assert_eq!(&file[..4], b"glTF");
    assert_eq!(u32::from_le_bytes(file[8..12].try_into().unwrap()) as usize, file.len());
    let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
    let v = parsed(&file[20..20 + length]);
    let names: Vec<&str> = v["nodes"].as_array().unwrap().iter().map(|n| n["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["surface", "graft", "proximal", "distal"]);
    assert_eq!(v["meshes"][0]["name"], "surface");
    assert_eq!(v["meshes"][0]["primitives"].as_array().unwrap().len(), 4);
    assert_eq!(v["meshes"][1]["primitives"][0]["mode"], 3);
    assert!(v["meshes"][0]["primitives"][0]["attributes"].get("_DISPLACEMENT_MM").is_some());
    // (x, y, z) LPS mm -> (x, z, -y) m
    assert_eq!(gltf_position(P3::new(1000.0, 2000.0, 3000.0)), [1.0, 3.0, -2.0]);
    let graft = v["meshes"][1]["primitives"][0]["attributes"]["POSITION"].as_u64().unwrap() as usize;
    let y = v["accessors"][graft]["max"][1].as_f64().unwrap();
    let highest = f.graph.edges[0].points.iter().map(|p| p.z()).fold(f64::MIN, f64::max);
    assert!((y - highest / 1000.0).abs() < 1e-7);
}

#[test]
fn the_report_is_self_contained_and_escapes_what_others_wrote() {
    let f = Fixture::new();
    let text = String::from_utf8(report_html(&f.reconstruction()).unwrap()).unwrap();
    for foreign in ["http:", "https:", "<script", "<link", "@import", "url("] {
        // The SVG name space is a name, nothing is fetched from it.
        assert!(!text.replace("http://www.w3.org/2000/svg", "").contains(foreign), "{foreign}");
    }
    assert!(text.contains("&#38; &#60;more&#62;"), "the warning is not escaped");
    for shown in
        ["45.4", "44.8 \u{2013} 46.0", "not measured, see the warnings", "graft to proximal", "watertight", "slice 14"]
    {
        assert!(text.contains(shown), "{shown}");
    }
    assert!(text.find("slice 7 is missing") < text.find("graft to proximal"), "warnings come first");
}

#[test]
fn a_vessel_tree_with_many_junctions_and_warnings_keeps_the_rest_countable() {
    let mut f = Fixture::new();
    let main = f.morphometry.junctions[0].clone();
    f.morphometry.junctions.extend((1..20).map(|node| morphometry::Junction {
        node,
        branches: vec![9],
        ..main.clone()
    }));
    let long = "the wall fades towards the end of the scan over 31.5 mm, the level was followed down to 0.42 of the \
                half-maximum; look at the contours of these slices before the lengths of the branches are used";
    let codes = ["a.b", "c.d", "e.f", "g.h", "i.j", "k.l", "m.n", "o.p"];
    let warning = |(k, &code): (usize, &&'static str)| space::Warning::new(code, long, space::Place::slice(k));
    f.warnings = codes.iter().enumerate().map(warning).collect();
    f.warnings.extend((8..11).map(|k| space::Warning::new("a.b", long, space::Place::slice(k))));
    let r = f.reconstruction();
    assert_eq!(r.main_junction().map(|j| j.node), Some(0));
    let text = String::from_utf8(report_html(&r).unwrap()).unwrap();
    assert!(text.contains("and 4 more in result.json"), "8 + 1 kinds of warnings, 5 shown");
    assert!(text.contains("3 more like it"), "warnings of one kind share a line");
    assert!(text.contains("5 more in angles.csv"), "20 junctions, 1 + 14 shown");
    leave("many", &[NamedBytes::new(REPORT_HTML, text.into_bytes())]);
}

/// For validators of other people (tests/js, tests/python): leaves the files where it is told to.
fn leave(folder: &str, all: &[NamedBytes]) {
    let Some(root) = std::env::var_os("VASCULUM_FIXTURE_OUT") else { return };
    let folder = std::path::Path::new(&root).join(folder);
    std::fs::create_dir_all(&folder).unwrap();
    for a in all {
        std::fs::write(folder.join(&a.name), &a.bytes).unwrap();
    }
}

#[test]
fn the_preview_is_a_png_on_which_the_vessel_is_seen() {
    let f = Fixture::new();
    let png = render::thumbnail(&f.reconstruction(), PREVIEW_SIZE).unwrap();
    let picture = image::load_from_memory(&png).unwrap().to_rgb8();
    assert_eq!([picture.width() as usize, picture.height() as usize], PREVIEW_SIZE);
    let drawn = picture.pixels().filter(|p| p.0 != [255; 3]).count() as f64 / (480.0 * 360.0);
    assert!((0.05..0.6).contains(&drawn), "{drawn} of the picture is drawn");
}

#[test]
fn provenance_lists_every_artefact_with_its_digest() {
    let f = Fixture::new();
    let all = write_all(&f.reconstruction()).unwrap();
    let stage =
        |name: &str, wall_s| StageTime { stage: name.to_owned(), wall_s, cpu_s: Some(wall_s), peak_bytes: None };
    let p = Provenance {
        version: "0.1.0".to_owned(),
        threads: 2,
        stages: vec![stage("read", 0.5), stage("fit", 1.5)],
        ..Provenance::default()
    };
    let v = parsed(&provenance(&p, &all).unwrap().bytes);
    assert_eq!(v["wall_s"], 2.0);
    assert_eq!(v["artefacts"].as_array().unwrap().len(), all.len());
    assert_eq!(v["artefacts"][0]["digest"], all[0].digest());
    assert_eq!(v["artefacts"][5]["media_type"], "model/gltf-binary");
    let empty = NamedBytes::new(RESULT_JSON, vec![]);
    assert_eq!(empty.digest(), "sha256:e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    let broken = Provenance { stages: vec![stage("fit", f64::NAN)], ..p };
    assert!(matches!(provenance(&broken, &all), Err(Error::NotFinite { .. })));
}
