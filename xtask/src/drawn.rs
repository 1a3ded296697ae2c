//! `cargo xtask survey --count N`: random vessels and scans of them; none may come out wrong without a word.
//!
//! A scan is right when graph, angles and areas lie within three times the accuracy promised for its resolution. One that
//! is not must have been refused, or warned of; the survey fails when one is wrong and silent.

use crate::survey::{ANGLES, area_biases};
use crate::{shell, tools};
use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Three times the promise at .5 x .5 x 1.5 mm and SNR 20: degrees, percent of area.
const FINE: Bounds = Bounds { angle_deg: 0.9, area_percent: 2.4 };
/// The same at .7 x .7 x 3 mm and SNR 10, which stands for all scans coarser than that.
const COARSE: Bounds = Bounds { angle_deg: 2.4, area_percent: 6.0 };

/// Warnings that say nothing against an angle, an area or a graph: a vessel that leaves the images, an end that carries no flow
/// extension. Half the scans have one.
const NO_CAUSE: [&str; 4] = ["contours.at_border", "surface.oblique_end", "surface.short_end", "surface.defect"];

struct Bounds {
    angle_deg: f64,
    area_percent: f64,
}

/// How a scan ended.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum End {
    Right,
    Warned,
    Refused,
    Silent,
    Broken,
}

impl End {
    fn name(self) -> &'static str {
        match self {
            Self::Right => "right",
            Self::Warned => "wrong, with a warning",
            Self::Refused => "refused",
            Self::Silent => "WRONG AND SILENT",
            Self::Broken => "BROKEN",
        }
    }
}

/// Reconstruct `count` random scans; one that is wrong without a warning, or that ends in no stated fault, is an error.
pub(crate) fn run(binary: &Path, first: u64, count: u64) -> Result<()> {
    ensure!(count > 0, "a survey of no scan proves nothing");
    let mut ends: BTreeMap<End, u64> = BTreeMap::new();
    let mut bad = Vec::new();
    for seed in first..first + count {
        let (end, line) = scan(binary, seed).with_context(|| format!("seed {seed}"))?;
        println!("{seed:4} {}  {line}", end.name());
        *ends.entry(end).or_default() += 1;
        if end >= End::Silent {
            bad.push(format!("seed {seed}: {} {line}", end.name()));
        }
    }
    for (end, n) in &ends {
        println!("{}: {n} of {count}", end.name());
    }
    if !bad.is_empty() {
        bail!("{} scans came out wrong without a word:\n{}", bad.len(), bad.join("\n"));
    }
    println!("{count} passed, 0 failed");
    Ok(())
}

fn scan(binary: &Path, seed: u64) -> Result<(End, String)> {
    let work = tools::target()?.join(format!("survey-random-{seed}"));
    if work.exists() {
        fs::remove_dir_all(&work)?;
    }
    let (scan, out) = (work.join("scan"), work.join("out"));
    let mut phantom = shell::command(binary);
    phantom.args(["phantom", &format!("random-{seed}"), "--out"]).arg(&scan);
    ensure!(shell::succeeds(phantom), "no scan could be simulated");
    let mut run = shell::command(binary);
    run.args(["run", "--json"]).arg(scan.join("dicom")).arg("--plan").arg(scan.join("plan.json"));
    let ended = run.arg("--out").arg(&out).output().context("cannot start the reconstruction")?;
    let read = |path: &Path| -> Result<Value> { Ok(serde_json::from_slice(&fs::read(path)?)?) };
    let row = match ended.status.code() {
        Some(0) => judge(&read(&out.join("result.json"))?, &read(&scan.join("truth.json"))?)?,
        Some(2..=4) => (End::Refused, code(&ended.stderr)),
        other => (End::Broken, format!("exit {other:?} {}", String::from_utf8_lossy(&ended.stderr))),
    };
    if row.0 < End::Silent {
        fs::remove_dir_all(&work)?;
    }
    Ok(row)
}

/// The code of the problem on stderr, whose last line it is.
fn code(stderr: &[u8]) -> String {
    let text = String::from_utf8_lossy(stderr);
    let start = text.find('{').unwrap_or(0);
    let problem: Value = serde_json::from_str(&text[start..]).unwrap_or_default();
    problem["code"].as_str().map_or_else(|| text.trim().to_owned(), str::to_owned)
}

fn judge(result: &Value, truth: &Value) -> Result<(End, String)> {
    let bounds = bounds(truth);
    let mut wrong = graph_faults(result);
    let mut missing = Vec::new();
    let mut line = String::new();
    let angles = result["junctions"][0]["angles"].as_array().map(Vec::as_slice).unwrap_or_default();
    for name in ANGLES {
        let want = truth["angles"][name].as_f64().with_context(|| format!("truth has no {name}"))?;
        match angles.iter().find(|a| a["name"] == name).and_then(|a| a["value"].as_f64()) {
            Some(got) => {
                line += &format!("{:+.2} ", got - want);
                if (got - want).abs() > bounds.angle_deg {
                    wrong.push(format!("{name} {got:.2} for {want:.2}"));
                }
            }
            None => {
                line += "null ";
                missing.push(name);
            }
        }
    }
    for (role, bias) in area_biases(result, truth) {
        line += &format!("{role} {bias:+.1}% ");
        if bias.abs() > bounds.area_percent {
            wrong.push(format!("area of {role} {bias:+.1} %"));
        }
    }
    let warnings = result["warnings"].as_array().context("no list of warnings")?;
    let mut codes: Vec<&str> = warnings.iter().filter_map(|w| w["code"].as_str()).collect();
    codes.dedup();
    let warned = codes.iter().any(|c| !NO_CAUSE.contains(c));
    if !missing.is_empty() && !warned {
        wrong.push(format!("{} null without a word", missing.join(", ")));
    }
    let end = match (wrong.is_empty(), warned) {
        (true, _) => End::Right,
        (false, true) => End::Warned,
        (false, false) => End::Silent,
    };
    Ok((end, format!("{line}| {} | {}", wrong.join(", "), codes.join(" "))))
}

fn bounds(truth: &Value) -> &'static Bounds {
    let number = |name: &str| truth["scan"][name].as_f64().unwrap_or(f64::INFINITY);
    let fine = number("pixel_mm") <= 0.5 && number("slice_spacing_mm") <= 1.5;
    let quiet = truth["scan"]["snr"].as_f64().is_none_or(|snr| snr >= 20.0);
    if fine && quiet { &FINE } else { &COARSE }
}

fn graph_faults(result: &Value) -> Vec<String> {
    let mut faults = Vec::new();
    let nodes = result["graph"]["nodes"].as_array().map(Vec::as_slice).unwrap_or_default();
    let count = |kind: &str| nodes.iter().filter(|n| n["kind"] == kind).count();
    let (ends, junctions) = (count("end"), count("junction"));
    if (ends, junctions) != (3, 1) {
        faults.push(format!("{ends} ends and {junctions} junctions"));
    }
    let surface = &result["surface"];
    if surface["watertight"] != true || surface["euler"] != 2 || surface["components"] != 1 {
        let [w, e, c] = ["watertight", "euler", "components"].map(|k| surface[k].to_string());
        faults.push(format!("watertight {w}, Euler number {e}, {c} pieces"));
    }
    faults
}
