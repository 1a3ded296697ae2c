//! `cargo xtask survey --count N`: random vessels and scans of them; none may come out wrong without a word.
//!
//! A scan is right when graph, angles and areas lie within three times the accuracy promised for its resolution. One that
//! is not must have been refused, or warned of; the survey fails when one is wrong and silent.
//!
//! With `--cut` each stack ends anywhere: up to half of its slices are left out at either side, so that branches end near
//! the junction or within it. A value may be missing there, and a graph has what is left; but no warning excuses a value
//! that is wrong by more than three times the promise and one and a half times its own band.

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
/// extension, a triangle in a sharp wedge. Half the scans have one.
const NO_CAUSE: [&str; 7] = [
    "contours.at_border",
    "ends.oblique",
    "ends.set_back",
    "surface.oblique_end",
    "surface.short_end",
    "surface.defect",
    "surface.tolerance",
];

struct Bounds {
    angle_deg: f64,
    area_percent: f64,
}

/// Where the stacks end.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stacks {
    /// Some diameters from the junction.
    Whole,
    /// Anywhere.
    Cut,
}

impl Stacks {
    fn name(self) -> &'static str {
        match self {
            Self::Whole => "random",
            Self::Cut => "cut",
        }
    }
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
pub(crate) fn run(binary: &Path, first: u64, count: u64, stacks: Stacks) -> Result<()> {
    ensure!(count > 0, "a survey of no scan proves nothing");
    let mut ends: BTreeMap<End, u64> = BTreeMap::new();
    let mut bad = Vec::new();
    for seed in first..first + count {
        let (end, line) = scan(binary, seed, stacks).with_context(|| format!("seed {seed}"))?;
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

fn scan(binary: &Path, seed: u64, stacks: Stacks) -> Result<(End, String)> {
    let work = tools::target()?.join(format!("survey-{}-{seed}", stacks.name()));
    if work.exists() {
        fs::remove_dir_all(&work)?;
    }
    let (scan, out) = (work.join("scan"), work.join("out"));
    let mut phantom = shell::command(binary);
    phantom.args(["phantom", &format!("random-{seed}"), "--out"]).arg(&scan);
    ensure!(shell::succeeds(phantom), "no scan could be simulated");
    let read = |path: &Path| -> Result<Value> { Ok(serde_json::from_slice(&fs::read(path)?)?) };
    let truth = read(&scan.join("truth.json"))?;
    if stacks == Stacks::Cut {
        let plan = shortened(read(&scan.join("plan.json"))?, &truth, seed, fs::read_dir(scan.join("dicom"))?.count())?;
        fs::write(scan.join("plan.json"), serde_json::to_vec_pretty(&plan)?)?;
    }
    let mut run = shell::command(binary);
    run.args(["run", "--json"]).arg(scan.join("dicom")).arg("--plan").arg(scan.join("plan.json"));
    let ended = run.arg("--out").arg(&out).output().context("cannot start the reconstruction")?;
    let row = match ended.status.code() {
        Some(0) if stacks == Stacks::Cut => judge_cut(&read(&out.join("result.json"))?, &truth)?,
        Some(0) => judge(&read(&out.join("result.json"))?, &truth)?,
        Some(2..=4) => (End::Refused, code(&ended.stderr)),
        other => (End::Broken, format!("exit {other:?} {}", String::from_utf8_lossy(&ended.stderr))),
    };
    if row.0 < End::Silent {
        fs::remove_dir_all(&work)?;
    }
    Ok(row)
}

/// Fewest slices that are left of a stack.
const LEFT: usize = 8;
/// Where a branch is named in a shortened stack, mm from the junction: nearer than the plan's own points, which may be cut off.
const NAMED_MM: f64 = 10.0;

/// The plan without up to half of the slices at either end, drawn from the seed.
fn shortened(mut plan: Value, truth: &Value, seed: u64, slices: usize) -> Result<Value> {
    // steps of an irrational number: even over the seeds, and unlike at the two ends
    let drawn = |factor: f64| ((seed as f64 * factor).fract() * 0.5 * slices as f64) as usize;
    let low = drawn(0.618_034);
    let high = (slices - drawn(0.754_878)).max(low + LEFT).min(slices);
    plan["segmentation"]["exclude_slices"] = (0..low).chain(high..slices).collect();
    for branch in truth["branches"].as_array().context("no branches")? {
        let name = format!("{}_mm", branch["role"].as_str().context("no role")?);
        let number = |field: &str, axis: usize| branch[field][axis].as_f64().context("no coordinate");
        let point = (0..3).map(|a| Ok(number("from", a)? + NAMED_MM * number("direction", a)?));
        plan["roles"][name] = point.collect::<Result<Vec<f64>>>()?.into();
    }
    Ok(plan)
}

/// Part of its band's half-width that a value may be off.
const OF_BAND: f64 = 1.5;

fn judge_cut(result: &Value, truth: &Value) -> Result<(End, String)> {
    let bounds = bounds(truth);
    let (mut wrong, mut line) = (Vec::new(), String::new());
    for junction in result["junctions"].as_array().context("no list of junctions")? {
        for angle in junction["angles"].as_array().context("no list of angles")? {
            let Some(want) = angle["name"].as_str().and_then(|name| truth["angles"][name].as_f64()) else { continue };
            let Some(got) = angle["value"].as_f64() else { continue };
            let band = |k: usize| angle["band95"][k].as_f64().unwrap_or(got);
            let room = bounds.angle_deg.max(OF_BAND * 0.5 * (band(1) - band(0)));
            line += &format!("{:+.2} ", got - want);
            if (got - want).abs() > room {
                wrong.push(format!("{} {got:.2} for {want:.2}", angle["name"]));
            }
        }
    }
    for (role, bias) in area_biases(result, truth) {
        line += &format!("{role} {bias:+.1}% ");
        if bias.abs() > bounds.area_percent {
            wrong.push(format!("area of {role} {bias:+.1} %"));
        }
    }
    let end = if wrong.is_empty() { End::Right } else { End::Silent };
    Ok((end, format!("{line}| {}", wrong.join(", "))))
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
    let moved = ["min", "max"].map(|end| surface["displacement_px"][end].as_f64().map_or(f64::INFINITY, f64::abs));
    if moved[0].max(moved[1]) > 1.0 {
        faults.push(format!("smoothing moved the wall by {moved:?} px"));
    }
    // a vessel that leaves across an edge of the volume has caps with sharp corners of their own
    let caps = result["surface"]["caps"].as_array().map_or(0, Vec::len);
    let least = surface["min_angle_deg"].as_f64().unwrap_or(0.0);
    if least < 30.0 && caps <= 3 {
        faults.push(format!("smallest triangle angle {least:.1} degrees"));
    }
    faults
}
