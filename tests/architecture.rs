//! Keeps the arrows between the crates: who may import whom (ARCHITECTURE.md).
#![allow(clippy::unwrap_used, clippy::panic)]

use serde_json::Value;
use std::process::Command;

/// For each crate of ours the crates of ours that it may name in `[dependencies]`.
const ARROWS: &[(&str, &[&str])] = &[
    ("space", &[]),
    ("exec", &["space"]),
    ("imaging", &["space", "exec"]),
    ("implicit", &["space", "exec", "imaging"]),
    ("surface", &["space", "exec", "imaging", "implicit"]),
    ("skeleton", &["space", "exec", "imaging", "implicit"]),
    ("morphometry", &["space", "exec", "imaging", "implicit", "skeleton", "surface"]),
    ("phantom", &["space", "exec", "imaging"]),
    ("artefact", &["space", "exec", "imaging", "implicit", "surface", "skeleton", "morphometry"]),
    ("pipeline", &["space", "exec", "imaging", "implicit", "surface", "skeleton", "morphometry", "artefact"]),
    ("service", &["space", "artefact", "pipeline"]),
    ("vasculum", &["space", "exec", "artefact", "pipeline", "phantom", "service"]),
    ("xtask", &[]),
];

/// Crates that hold numbers only.
const DOMAIN: &[&str] = &["space", "exec", "imaging", "implicit", "surface", "skeleton", "morphometry", "phantom"];
/// What a domain crate never imports.
const FOREIGN: &[&str] =
    &["tokio", "axum", "sqlx", "rusqlite", "serde", "serde_json", "tracing", "image", "zip", "reqwest"];

fn packages() -> Vec<Value> {
    let out = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(out.status.success());
    let metadata: Value = serde_json::from_slice(&out.stdout).unwrap();
    metadata["packages"].as_array().unwrap().clone()
}

/// Names in `[dependencies]` (tests may use more).
fn dependencies(package: &Value) -> Vec<String> {
    let all = package["dependencies"].as_array().unwrap();
    all.iter().filter(|d| d["kind"].is_null()).map(|d| d["name"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn every_arrow_points_the_right_way() {
    let packages = packages();
    let ours: Vec<&str> = ARROWS.iter().map(|a| a.0).collect();
    assert_eq!(packages.len(), ours.len(), "a crate is missing from the table");
    for package in &packages {
        let name = package["name"].as_str().unwrap();
        let allowed = ARROWS.iter().find(|a| a.0 == name).unwrap_or_else(|| panic!("{name} is not in the table")).1;
        for dependency in dependencies(package) {
            let is_ours = ours.contains(&dependency.as_str());
            assert!(!is_ours || allowed.contains(&dependency.as_str()), "{name} must not import {dependency}");
        }
    }
}

#[test]
fn domain_crates_know_no_service_and_no_file_format() {
    for package in packages() {
        let name = package["name"].as_str().unwrap();
        if !DOMAIN.contains(&name) {
            continue;
        }
        for dependency in dependencies(&package) {
            assert!(!FOREIGN.contains(&dependency.as_str()), "{name} must not import {dependency}");
        }
    }
}

#[test]
fn domain_crates_read_no_file_no_environment_and_no_clock() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for name in DOMAIN {
        for entry in std::fs::read_dir(root.join(name)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_none_or(|e| e != "rs") || path.file_stem().is_some_and(|s| s == "tests") {
                continue;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]\nmod tests").next().unwrap();
            for word in ["std::fs", "std::net", "std::env", "std::time", "std::thread::spawn"] {
                assert!(!code.contains(word), "{} uses {word}", path.display());
            }
        }
    }
}
