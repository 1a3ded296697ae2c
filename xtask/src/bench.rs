//! `cargo xtask bench`: wall time, CPU time and memory of the whole reconstruction, stage by stage; single stages and the
//! whole beside others.

use crate::{shell, tools};
use anyhow::{Context, Result, ensure};
use serde_json::Value;
use std::fs;
use std::path::Path;

/// What `cargo xtask bench` measures.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub(crate) enum What {
    /// The whole reconstruction, stage by stage.
    Whole,
    /// Thinning beside gaara and scikit-image on the same volumes.
    Thinning,
    /// The implicit fit beside ferreus_rbf and scipy, and the sums beside the machine's rate of square roots.
    Fit,
    /// The remeshing of the benchmark anastomosis beside other programs on the same surface.
    Surface,
    /// Angles, areas, radii and centrelines beside VMTK's on the same scans, with both chains' times stage by stage.
    Accuracy,
    /// GET of a job by wrk, and the memory of 50 uploads at the same time.
    Service,
    /// Jobs per second of the queue on SQLite and PostgreSQL, with few and with many queued, and beside a queue library.
    Queue,
    /// From a result's address to its drawn wall in a browser without a GPU, and the heap over 50 results.
    Portal,
}

/// Thin the same volumes with our code, gaara and scikit-image, interleaved, and show medians and ratios.
pub(crate) fn thinning(repeat: usize) -> Result<()> {
    ensure!(repeat > 0, "at least one repetition");
    let ours = tools::release_example("thinning")?;
    let work = tools::target()?.join("bench-thinning");
    let mut bench = shell::command(tools::thinning_peers()?);
    bench.arg(shell::root()?.join("tests/bench/thinning.py"));
    bench.arg(ours).arg(&work).arg(repeat.to_string());
    shell::run(bench)
}

/// Fits of the same constraints by our code and its peers, each a process of its own, and the rates of the sums.
pub(crate) fn fit(repeat: usize) -> Result<()> {
    ensure!(repeat > 0, "at least one repetition");
    let built = tools::target()?.join("bench-fit");
    let mut build = shell::command("cargo");
    // the peer asks for a newer compiler than ours, and compiles with ours
    build.args(["build", "--release", "--ignore-rust-version", "--manifest-path"]);
    build.arg(shell::root()?.join("tests/bench/fit/Cargo.toml")).env("CARGO_TARGET_DIR", &built);
    shell::run(build)?;
    let mut bench = shell::command(tools::python()?);
    bench.arg(shell::root()?.join("tests/bench/fit.py"));
    bench.arg(built.join("release")).arg(built.join("work")).arg(repeat.to_string());
    shell::run(bench)
}

/// Ours and VMTK on the same simulated scans against the exact truth, `seeds` of each resolution, interleaved.
pub(crate) fn accuracy(seeds: usize) -> Result<()> {
    ensure!(seeds > 0, "at least one seed");
    let python = tools::vmtk()?;
    let ours = tools::release_binary()?;
    let mut bench = shell::command(python);
    bench.arg(shell::root()?.join("tests/bench/accuracy.py"));
    bench.arg(ours).arg(tools::target()?.join("bench-accuracy")).arg(seeds.to_string());
    shell::run(bench)
}

/// Rates and memory of the service, by wrk and by uploads at the same time.
pub(crate) fn service(binary: &Path) -> Result<()> {
    tools::wrk()?;
    let mut bench = shell::command(tools::python()?);
    bench.arg(shell::root()?.join("tests/bench/service.py")).args(["10", "500"]);
    bench.env("VASCULUM_ROOT", shell::root()?).env("VASCULUM_BIN", binary);
    shell::run(bench)
}

/// The first paint of walls of two sizes in headless Chromium, `visits` times each, and the page's heap.
pub(crate) fn portal(visits: usize) -> Result<()> {
    ensure!(visits > 0, "at least one visit");
    let binary = tools::release_binary()?;
    tools::browser()?;
    let mut bench = tools::node_script(&tools::node_packages()?, &shell::root()?.join("tests/bench/portal.mjs"))?;
    bench.arg(binary).arg(tools::target()?.join("bench-portal")).arg(visits.to_string());
    shell::run(bench)
}

/// Our remeshing and others' on one raw surface: quality, distance to the analytic vessel, time.
pub(crate) fn surface() -> Result<()> {
    let work = tools::target()?.join("bench-surface");
    fs::create_dir_all(&work)?;
    let mut ours = shell::command(tools::release_example("survey")?);
    ours.args(["0", "0"]).arg(&work);
    shell::run(ours)?;
    let python = tools::python()?;
    let mut pip = shell::command(&python);
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "pyacvd==0.4.0", "mmgpy==0.17.1"]);
    shell::run(pip)?;
    let mut peers = shell::command(&python);
    peers.arg(shell::root()?.join("tests/bench/surface.py")).env("SURFACES", &work);
    shell::run(peers)
}

/// Reconstruct the demo scan, and the same vessel in a field of a hospital's size, `repeat` times each and show medians.
pub(crate) fn run(binary: &Path, repeat: usize) -> Result<()> {
    ensure!(repeat > 0, "at least one repetition");
    let work = tools::target()?.join("bench-whole");
    for (title, size) in [("the demo scan", &[] as &[&str]), ("512 x 512 x 40", &["--size", "512", "--slices", "40"])] {
        if work.exists() {
            fs::remove_dir_all(&work)?;
        }
        let scan = work.join("scan");
        let mut phantom = shell::command(binary);
        phantom.args(["phantom", "anastomosis", "--out"]).arg(&scan).args(size);
        shell::run(phantom)?;
        let mut runs = Vec::new();
        for k in 0..repeat {
            let out = work.join(format!("out{k}"));
            let mut run = shell::command(binary);
            run.arg("run").arg(scan.join("dicom")).arg("--plan").arg(scan.join("plan.json")).arg("--out").arg(&out);
            ensure!(shell::succeeds(run), "the reconstruction failed");
            runs.push(serde_json::from_slice::<Value>(&fs::read(out.join("provenance.json"))?)?);
        }
        println!("{title}");
        show(&runs)?;
        fs::remove_dir_all(&work)?;
    }
    Ok(())
}

fn show(runs: &[Value]) -> Result<()> {
    let stages = runs[0]["stages"].as_array().context("provenance has stages")?;
    println!("{:<14} {:>9} {:>9}", "stage", "wall s", "CPU s");
    for (k, stage) in stages.iter().enumerate() {
        let median_of = |name: &str| median(runs.iter().filter_map(|r| r["stages"][k][name].as_f64()).collect());
        let name = stage["stage"].as_str().unwrap_or("?");
        println!("{name:<14} {:>9.2} {:>9.2}", median_of("wall_s"), median_of("cpu_s"));
    }
    let whole = |name: &str| median(runs.iter().filter_map(|r| r[name].as_f64()).collect());
    println!("{:<14} {:>9.2} {:>9.2}", "whole", whole("wall_s"), whole("cpu_s"));
    println!("peak memory {:.0} MiB (medians of {})", whole("peak_memory_bytes") / 1_048_576.0, runs.len());
    Ok(())
}

pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
