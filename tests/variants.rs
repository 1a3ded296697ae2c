//! Re-synthesis from a finished reconstruction: what was not changed stays, what was asked for is measured back.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;
use tempfile::TempDir;

const BINARY: &str = env!("CARGO_BIN_EXE_vasculum");

fn vasculum(arguments: &[&str]) -> Output {
    Command::new(BINARY).args(arguments).stdin(Stdio::null()).output().unwrap()
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn read(folder: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(folder.join("result.json")).unwrap()).unwrap()
}

/// A finished reconstruction of a scan without noise.
fn source() -> &'static Path {
    static SOURCE: OnceLock<TempDir> = OnceLock::new();
    let dir = SOURCE.get_or_init(|| {
        let dir = TempDir::new().unwrap();
        let (scan, out) = (dir.path().join("scan"), dir.path().join("out"));
        let made = vasculum(&["phantom", "anastomosis", "--snr", "100", "--seed", "3", "--out", path(&scan)]);
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let plan = scan.join("plan.json");
        let run = vasculum(&["run", path(&scan.join("dicom")), "--plan", path(&plan), "--out", path(&out)]);
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        dir
    });
    static OUT: OnceLock<std::path::PathBuf> = OnceLock::new();
    OUT.get_or_init(|| dir.path().join("out"))
}

fn varied(options: &[&str]) -> (TempDir, Output) {
    let dir = TempDir::new().unwrap();
    let out = dir.path().join("variants");
    let done = vasculum(&[&["vary", path(source()), "--out", path(&out)][..], options].concat());
    (dir, done)
}

fn one(options: &[&str]) -> Value {
    let (dir, done) = varied(options);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let folder = std::fs::read_dir(dir.path().join("variants")).unwrap().next().unwrap().unwrap().path();
    read(&folder)
}

fn angle(r: &Value, name: &str) -> f64 {
    let angles = r["junctions"][0]["angles"].as_array().unwrap();
    angles.iter().find(|a| a["name"] == name).unwrap()["value"].as_f64().unwrap()
}

fn branch<'a>(r: &'a Value, role: &str) -> &'a Value {
    r["branches"].as_array().unwrap().iter().find(|b| b["role"] == role).unwrap()
}

#[test]
fn without_a_change_angles_diameters_and_shape_stay() {
    let (a, b) = (read(source()), one(&[]));
    for name in ["graft_proximal", "graft_distal_planar", "distal_normal"] {
        let (was, is) = (angle(&a, name), angle(&b, name));
        assert!((was - is).abs() < 0.1, "{name}: {was} became {is}");
    }
    for role in ["graft", "proximal", "distal"] {
        let area = |r: &Value| branch(r, role)["diameter_mm"].as_f64().unwrap().powi(2);
        assert!((area(&b) / area(&a) - 1.0).abs() < 0.005, "{role}");
    }
    let count =
        |r: &Value, kind: &str| r["graph"]["nodes"].as_array().unwrap().iter().filter(|n| n["kind"] == kind).count();
    assert_eq!((count(&b, "end"), count(&b, "junction")), (3, 1));
    assert_eq!((&b["surface"]["watertight"], b["surface"]["euler"].as_i64()), (&Value::Bool(true), Some(2)));
    let codes: Vec<&Value> = b["warnings"].as_array().unwrap().iter().map(|w| &w["code"]).collect();
    assert!(codes.iter().any(|c| *c == "variant.synthetic"), "{codes:?}");
    assert!(b["junctions"][0]["angles"][0]["band95"].is_null(), "a synthetic vessel has no noise to give a band");
}

#[test]
fn asked_angles_are_measured_back() {
    for deg in [30.0, 60.0] {
        let r = one(&["--angle", &format!("graft={deg}")]);
        let got = angle(&r, "graft_proximal");
        assert!((got - deg).abs() <= 0.3, "asked {deg}, measured {got}");
        assert_eq!(r["variant"]["changes"][0]["angle_deg"].as_f64(), Some(deg));
    }
}

#[test]
fn an_asked_torsion_is_measured_back() {
    let r = one(&["--curvature", "graft=0.05", "--torsion", "graft=-0.03"]);
    let helix = &branch(&r, "graft")["helix"];
    let (curvature, torsion) = (helix["curvature_per_mm"].as_f64().unwrap(), helix["torsion_per_mm"].as_f64().unwrap());
    assert!((curvature / 0.05 - 1.0).abs() < 0.03 && (torsion / -0.03 - 1.0).abs() < 0.03, "{curvature} {torsion}");
    assert_eq!(helix["handedness"], "left");
}

#[test]
fn what_cannot_be_made_is_refused_and_nothing_is_left() {
    for (options, code) in [
        (&["--curvature", "graft=0.6"][..], "variant.folds"),
        (&["--angle", "graft=6"], "variant.collision"),
        (&["--angle", "host_a=60"], "plan.invalid"),
        (&["--straight", "7"], "variant.branch"),
    ] {
        let (dir, done) = varied(&[options, &["--json"]].concat());
        assert_eq!(done.status.code(), Some(2), "{options:?}");
        let problem = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(problem.contains(&format!("\"code\":\"{code}\"")), "{options:?}: {problem}");
        let left = std::fs::read_dir(dir.path().join("variants")).map_or(0, Iterator::count);
        assert_eq!(left, 0, "{options:?}");
    }
    let dir = TempDir::new().unwrap();
    std::fs::write(dir.path().join("sections.json"), "{\"schema\": 1}").unwrap();
    let done = vasculum(&["vary", path(dir.path()), "--out", path(&dir.path().join("o")), "--json"]);
    assert_eq!(done.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&done.stderr).contains("input.malformed"));
}
