//! `cargo xtask survey`: the demo scan under many noise seeds against its truth.

use crate::{shell, tools};
use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// Largest error of an angle, degrees.
const ANGLE_DEG: f64 = 1.0;
/// Smallest angle of a triangle, degrees.
const TRIANGLE_DEG: f64 = 25.0;
/// Angles that are compared.
pub(crate) const ANGLES: [&str; 3] = ["graft_proximal", "graft_distal_planar", "distal_normal"];

/// Reconstruct `count` scans and compare; any scan beyond the bounds is an error.
pub(crate) fn run(binary: &Path, first: u64, count: u64) -> Result<()> {
    ensure!(count > 0, "a survey of no scan proves nothing");
    let mut faults = Vec::new();
    let mut inside = [[0, 0]; ANGLES.len()];
    println!("seed  {}  ends junctions  min angle  moved px  area bias %", ANGLES.join("  "));
    for seed in first..first + count {
        let row = scan(binary, seed).with_context(|| format!("seed {seed}"))?;
        println!("{seed:4}  {}", row.line);
        for (count, within) in inside.iter_mut().zip(&row.in_band) {
            count[0] += usize::from(*within == Some(true));
            count[1] += usize::from(within.is_some());
        }
        faults.extend(row.faults.into_iter().map(|f| format!("seed {seed}: {f}")));
    }
    for (name, [within, of]) in ANGLES.iter().zip(inside) {
        println!("{name}: truth inside the 95 % band in {within} of {of}");
    }
    if faults.is_empty() {
        println!("{count} passed, 0 failed");
        return Ok(());
    }
    bail!("{} bounds missed:\n{}", faults.len(), faults.join("\n"))
}

struct Row {
    line: String,
    faults: Vec<String>,
    /// Per angle whether the truth lies in its band; `None` without a band.
    in_band: Vec<Option<bool>>,
}

fn scan(binary: &Path, seed: u64) -> Result<Row> {
    let work = tools::target()?.join(format!("survey-{seed}"));
    if work.exists() {
        fs::remove_dir_all(&work)?;
    }
    let (scan, out) = (work.join("scan"), work.join("out"));
    let mut phantom = shell::command(binary);
    phantom.args(["phantom", "anastomosis", "--seed", &seed.to_string(), "--out"]).arg(&scan);
    ensure!(shell::succeeds(phantom), "no scan could be simulated");
    let mut run = shell::command(binary);
    run.arg("run").arg(scan.join("dicom")).arg("--plan").arg(scan.join("plan.json")).arg("--out").arg(&out);
    ensure!(shell::succeeds(run), "the reconstruction failed");
    let read = |path: &Path| -> Result<Value> { Ok(serde_json::from_slice(&fs::read(path)?)?) };
    let row = compare(&read(&out.join("result.json"))?, &read(&scan.join("truth.json"))?);
    fs::remove_dir_all(&work)?;
    row
}

fn compare(result: &Value, truth: &Value) -> Result<Row> {
    let mut faults = Vec::new();
    let mut line = String::new();
    let mut in_band = Vec::new();
    for name in ANGLES {
        let want = truth["angles"][name].as_f64().with_context(|| format!("truth has no {name}"))?;
        let angles = result["junctions"][0]["angles"].as_array().context("no junction")?;
        let angle = angles.iter().find(|a| a["name"] == name);
        let got = angle.and_then(|a| a["value"].as_f64());
        in_band.push(angle.and_then(|a| Some((a["band95"][0].as_f64()?..=a["band95"][1].as_f64()?).contains(&want))));
        match got {
            Some(got) => {
                line += &format!("{got:7.2} ({:+.2})  ", got - want);
                if (got - want).abs() > ANGLE_DEG {
                    faults.push(format!("{name} {got:.2} degrees, truth {want:.2}"));
                }
            }
            None => faults.push(format!("{name} has no value")),
        }
    }
    let nodes = result["graph"]["nodes"].as_array().context("no graph")?;
    let count = |kind: &str| nodes.iter().filter(|n| n["kind"] == kind).count();
    let (ends, junctions) = (count("end"), count("junction"));
    if (ends, junctions) != (3, 1) {
        faults.push(format!("{ends} ends and {junctions} junctions"));
    }
    let surface = &result["surface"];
    let number = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
    let moved = number(&surface["displacement_px"]["min"]).abs().max(number(&surface["displacement_px"]["max"]).abs());
    let least = number(&surface["min_angle_deg"]);
    if surface["watertight"] != true || surface["euler"] != 2 {
        faults.push(format!("watertight {}, Euler number {}", surface["watertight"], surface["euler"]));
    }
    if least.is_nan() || least < TRIANGLE_DEG {
        faults.push(format!("smallest triangle angle {least:.1} degrees"));
    }
    if moved.is_nan() || moved > 1.0 {
        faults.push(format!("smoothing moved the wall by {moved:.2} px"));
    }
    line += &format!("{ends} {junctions}  {least:5.1}  {moved:5.2}  {}", area_bias(result, truth));
    Ok(Row { line, faults, in_band })
}

/// Role and area bias in percent of every branch: median section outside the junction against the truth's radius.
pub(crate) fn area_biases(result: &Value, truth: &Value) -> Vec<(String, f64)> {
    let branches = result["branches"].as_array().map(Vec::as_slice).unwrap_or_default();
    let bias = |b: &Value| {
        let role = b["role"].as_str()?;
        let (diameter, radius) = (b["diameter_mm"].as_f64()?, truth["radii_mm"][role].as_f64()?);
        Some((role.to_owned(), 100.0 * ((0.5 * diameter / radius).powi(2) - 1.0)))
    };
    branches.iter().filter_map(bias).collect()
}

fn area_bias(result: &Value, truth: &Value) -> String {
    let shown = area_biases(result, truth).into_iter().map(|(role, bias)| format!("{role} {bias:+.2}"));
    shown.collect::<Vec<_>>().join(" ")
}
