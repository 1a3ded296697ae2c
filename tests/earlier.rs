//! A run after an earlier one on the same scan gives the bytes of one that computes everything, in less time.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use tempfile::TempDir;

const BINARY: &str = env!("CARGO_BIN_EXE_vasculum");

fn vasculum(arguments: &[&str]) {
    let done = Command::new(BINARY).args(arguments).stdin(Stdio::null()).output().unwrap();
    assert!(done.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&done.stderr));
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

/// Every artefact but provenance.json, and how many results that tells to be recalled.
fn made(folder: &Path) -> (BTreeMap<String, Vec<u8>>, u64) {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let file = entry.unwrap().path();
        files.insert(file.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(file).unwrap());
    }
    let provenance: Value = serde_json::from_slice(&files.remove("provenance.json").unwrap()).unwrap();
    (files, provenance["recalled"].as_u64().unwrap())
}

struct Scans(TempDir);

impl Scans {
    fn new() -> Self {
        let scans = Self(TempDir::new().unwrap());
        for seed in ["1", "2"] {
            let small = ["--size", "160", "--pixel", "0.8", "--slices", "27", "--spacing", "2.5"];
            let out = scans.0.path().join(seed);
            vasculum(&[&["phantom", "anastomosis", "--seed", seed, "--out", path(&out)], &small[..]].concat());
        }
        scans
    }

    /// Runs a scan with its plan changed, and gives what was made.
    fn run(
        &self,
        (seed, out): (&str, &str),
        options: &[&str],
        change: impl FnOnce(&mut Value),
    ) -> (BTreeMap<String, Vec<u8>>, u64) {
        let (scan, folder) = (self.0.path().join(seed), self.0.path().join(out));
        let mut plan: Value = serde_json::from_slice(&std::fs::read(scan.join("plan.json")).unwrap()).unwrap();
        change(&mut plan);
        let file = self.0.path().join(format!("{out}.json"));
        std::fs::write(&file, plan.to_string()).unwrap();
        let dicom = scan.join("dicom");
        let call = ["run", path(&dicom), "--plan", path(&file), "--out", path(&folder)];
        vasculum(&[&call[..], options].concat());
        made(&folder)
    }
}

fn same(a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>) {
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in a {
        assert!(bytes == &b[name], "{name} differs");
    }
}

#[test]
fn other_roles_and_another_mesh_take_the_fit_from_the_earlier_run_and_nothing_else_is_taken() {
    let scans = Scans::new();
    let field = |plan: &mut Value| plan["outputs"] = json!(["field"]);
    let (first, recalled) = scans.run(("1", "first"), &[], field);
    assert_eq!((recalled, first.contains_key("field.bin")), (0, true));
    let corrected = |plan: &mut Value| {
        field(plan);
        let roles = &mut plan["roles"];
        let (proximal, distal) = (roles["proximal_mm"].take(), roles["distal_mm"].take());
        (roles["proximal_mm"], roles["distal_mm"]) = (distal, proximal);
        plan["surface"] = json!({"max_error_mm": 0.03});
    };
    let (whole, none) = scans.run(("1", "whole"), &["--threads", "1"], corrected);
    let earlier = scans.0.path().join("first");
    let (quick, some) = scans.run(("1", "quick"), &["--earlier", path(&earlier), "--threads", "3"], corrected);
    assert_eq!((none, some), (0, 4), "two fits, values far from and near the wall");
    same(&whole, &quick);
    assert!(quick["result.json"] != first["result.json"], "the roles are others");
    assert!(quick["field.bin"] == first["field.bin"], "what a third run would take is still there");

    let (other, recalled) = scans.run(("2", "other"), &["--earlier", path(&earlier)], |_| {});
    assert_eq!(recalled, 0, "another scan's results are others");
    assert!(!other.contains_key("field.bin"), "a small scan keeps nothing that was not asked for");
    let file = earlier.join("field.bin");
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, [&bytes[..20], &[0; 28][..], &bytes[48..]].concat()).unwrap();
    let (_, recalled) = scans.run(("1", "strange"), &["--earlier", path(&file)], |_| {});
    assert_eq!(recalled, 0, "another program's results may be others");
}
