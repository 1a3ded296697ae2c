//! `cargo xtask test`: every check, in the order in which a failure costs least.

use crate::drawn::Stacks;
use crate::{drawn, shell, storm, surfaces, survey, tools};
use anyhow::{Context as _, Result, bail};
use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

/// Noise seeds of the demo scan that the test command reconstructs (the survey runs ten).
const SEEDS: u64 = 3;

/// Random vessels and scans, none of which may come out wrong without a word (the whole survey takes 1,000).
const DRAWN: u64 = 25;

/// A random scan whose graft runs within thick slices: its angles are wrong, and it must say so.
const BETWEEN_SLICES: u64 = 65;

/// The same with stacks that end anywhere.
const CUT: u64 = 8;

/// Random vessels whose surfaces another program judges (the whole survey takes 200).
const SURFACES: u64 = 20;

/// Of those, how many Gmsh and TetGen fill with tetrahedra (the whole survey: 50).
const FILLED: usize = 8;

/// Run all checks.
pub(crate) fn all() -> Result<()> {
    tools::compiler()?;
    tools::node()?;
    lint()?;
    tools::postgres()?;
    tools::openssl()?;
    let tests = tests()?;
    tools::release(&["survey", "storm"])?;
    let judged = judged()?;
    let mut checks: Vec<Check<'_>> = vec![
        // the longest first, in halves so that none is left alone at the end
        Box::new(|| drawn::run(&judged.binary, 1, DRAWN / 2, Stacks::Whole)),
        Box::new(|| storm::short(&tools::built_example("storm")?)),
        Box::new(|| survey::run(&judged.binary, 1, SEEDS)),
    ];
    checks.extend(browsers(&judged)?);
    checks.extend(tests);
    checks.push(Box::new(|| drawn::run(&judged.binary, 1 + DRAWN / 2, DRAWN - DRAWN / 2, Stacks::Whole)));
    checks.push(Box::new(|| drawn::run(&judged.binary, BETWEEN_SLICES, 1, Stacks::Whole)));
    checks.push(Box::new(|| drawn::run(&judged.binary, 1, CUT, Stacks::Cut)));
    checks.extend(judges(&judged)?);
    beside(checks)?;
    fs::remove_dir_all(&judged.work)?;
    eprintln!("xtask: all checks passed");
    Ok(())
}

type Check<'a> = Box<dyn FnOnce() -> Result<()> + Send + 'a>;

/// Checks at the same time: they start services and browsers and wait for them about as much as they work.
const BESIDE: usize = 3;

/// Run checks, some at a time; none is begun after one has failed.
fn beside(checks: Vec<Check<'_>>) -> Result<()> {
    let waiting = Mutex::new(VecDeque::from(checks));
    let take = || waiting.lock().ok()?.pop_front();
    let give_up = || waiting.lock().into_iter().for_each(|mut left| left.clear());
    let work = || {
        while let Some(check) = take() {
            check().inspect_err(|error| {
                eprintln!("xtask: {error:#}");
                give_up();
            })?;
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let workers = [(); BESIDE].map(|()| scope.spawn(work));
        workers.into_iter().try_for_each(|worker| worker.join().unwrap_or_else(|_| bail!("a check panicked")))
    })
}

fn lint() -> Result<()> {
    let mut format = shell::command("cargo");
    format.args(["fmt", "--all", "--check"]);
    shell::run(format)?;
    let mut clippy = shell::command("cargo");
    clippy.args(["clippy", "--workspace", "--all-targets", "--quiet", "--", "-D", "warnings"]);
    shell::run(clippy)
}

/// Every test of the workspace, built; each program of them is a check of its own, so that one that waits keeps none waiting.
fn tests() -> Result<Vec<Check<'static>>> {
    let mut build = shell::command("cargo");
    build.args(["test", "--workspace", "--no-run", "--quiet", "--message-format", "json-render-diagnostics"]);
    let (built, s3) = (shell::output(build)?, tools::s3()?);
    let mut checks: Vec<Check<'static>> = Vec::new();
    for line in built.lines() {
        let Some((program, folder)) = test_program(line)? else { continue };
        let mut test = Command::new(program);
        // Its lack is then a failure of the queue's tests, not a reason to skip them.
        test.arg("--quiet").current_dir(folder).env("VASCULUM_POSTGRES", "required").env("VASCULUM_S3S", &s3);
        checks.push(Box::new(|| shell::run_whole(test)));
    }
    if checks.is_empty() {
        bail!("cargo names no tests");
    }
    let mut documented = shell::command("cargo");
    documented.args(["test", "--workspace", "--doc", "--quiet"]);
    checks.push(Box::new(|| shell::run_whole(documented)));
    Ok(checks)
}

/// A program of tests and the folder that it wants to run in, where cargo's line tells of one.
fn test_program(line: &str) -> Result<Option<(PathBuf, PathBuf)>> {
    let told: serde_json::Value = serde_json::from_str(line)?;
    let (Some(program), Some(manifest)) = (told["executable"].as_str(), told["manifest_path"].as_str()) else {
        return Ok(None);
    };
    let folder = Path::new(manifest).parent().context("a manifest lies in a folder")?;
    Ok((told["profile"]["test"] == true).then(|| (program.into(), folder.into())))
}

/// What the judges get: the program, and one scan with its result.
struct Judged {
    binary: PathBuf,
    work: PathBuf,
    scan: PathBuf,
    out: PathBuf,
    surfaces: PathBuf,
    python: PathBuf,
    node: PathBuf,
}

/// Make what is judged, and install who judges it.
fn judged() -> Result<Judged> {
    let (binary, work) = (tools::built_binary()?, fresh_folder()?);
    let (scan, out) = (work.join("scan"), work.join("out"));
    let mut phantom = shell::command(&binary);
    phantom.args(["phantom", "anastomosis", "--seed", "1", "--out"]).arg(&scan);
    shell::run(phantom)?;
    let plan = work.join("plan.json");
    fs::write(&plan, with_patches(&fs::read(scan.join("plan.json"))?)?)?;
    let mut run = shell::command(&binary);
    run.arg("run").arg(scan.join("dicom")).arg("--plan").arg(&plan).arg("--out").arg(&out);
    shell::run(run)?;
    let surfaces = work.join("surfaces");
    surfaces::meshes(&tools::built_example("survey")?, &surfaces, SURFACES, 0)?;
    surfaces::volumes(&surfaces, FILLED)?;
    let python = tools::volume_judges()?;
    tools::deploy()?;
    tools::pacs()?;
    tools::strace()?;
    tools::groff()?;
    tools::jq()?;
    tools::browser()?;
    let node = tools::node_packages()?;
    Ok(Judged { binary, work, scan, out, surfaces, python, node })
}

fn fresh_folder() -> Result<PathBuf> {
    let work = tools::target()?.join("judges");
    if work.exists() {
        fs::remove_dir_all(&work)?;
    }
    fs::create_dir_all(&work)?;
    Ok(work)
}

/// Programs that we did not write read what we write.
fn judges(judged: &Judged) -> Result<Vec<Check<'_>>> {
    let mut checks: Vec<Check<'_>> = Vec::new();
    // The benches need programs of their own; here only that they can be read.
    let mut benches = shell::command(&judged.python);
    benches.args(["-m", "compileall", "-q", "tests/bench"]);
    checks.push(Box::new(|| shell::run_whole(benches)));
    for script in scripts("tests/python", "py")? {
        let mut judge = shell::command(&judged.python);
        judge
            .arg(script)
            .env("VASCULUM_ROOT", shell::root()?)
            .env("SURFACES", &judged.surfaces)
            // built with the tests
            .env("VASCULUM_JUDGED", tools::target()?.join("debug/examples/judged"))
            .env("VASCULUM_NODE", &judged.node)
            .env("VASCULUM_S3S", tools::s3()?);
        checks.push(Box::new(|| judge_one(judge, judged)));
    }
    Ok(checks)
}

/// The portal and the files for browsers, in a browser.
fn browsers(judged: &Judged) -> Result<Vec<Check<'_>>> {
    let mut checks: Vec<Check<'_>> = Vec::new();
    for script in scripts("tests/js", "mjs")? {
        let mut judge = tools::node_script(&judged.node, &script)?;
        judge.env("VASCULUM_WORK", &judged.work);
        checks.push(Box::new(|| judge_one(judge, judged)));
    }
    Ok(checks)
}

fn judge_one(mut judge: Command, judged: &Judged) -> Result<()> {
    judge.env("VASCULUM_BIN", &judged.binary).env("VASCULUM_OUT", &judged.out).env("VASCULUM_SCAN", &judged.scan);
    shell::run_whole(judge)
}

/// The same plan, asking for patches too.
fn with_patches(plan: &[u8]) -> Result<Vec<u8>> {
    let mut plan: serde_json::Value = serde_json::from_slice(plan)?;
    plan["outputs"] = serde_json::json!(["surface", "skeleton", "patches"]);
    Ok(serde_json::to_vec(&plan)?)
}

fn scripts(folder: &str, extension: &str) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(shell::root()?.join(folder))? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort();
    if found.is_empty() {
        bail!("no checks in {folder}");
    }
    Ok(found)
}
