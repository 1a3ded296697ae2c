//! `cargo xtask storm` and `cargo xtask bench queue`: the queue under `kill -9`, and its speed.

use crate::{bench, shell, tools};
use anyhow::{Result, anyhow};
use std::path::Path;
use std::process::Command;

const DATABASES: [&str; 2] = ["sqlite", "postgres"];

/// Kills of the short storm in the test command, on each database.
const SHORT: [&str; 6] = ["--kills", "120", "--jobs", "1500", "--minutes", "3"];

/// The whole storm on both databases (bars: 1,000 kills over 20,000 jobs on each).
pub(crate) fn run(kills: usize, jobs: usize, seed: u64) -> Result<()> {
    let program = tools::release_example("storm")?;
    let [kills, jobs, seed] = [kills.to_string(), jobs.to_string(), seed.to_string()];
    each(&program, &["--kills", &kills, "--jobs", &jobs, "--seed", &seed], true)
}

/// The short storm, on both databases at the same time: it waits more than it works.
pub(crate) fn short(program: &Path) -> Result<()> {
    tools::postgres()?;
    std::thread::scope(|scope| {
        let storms =
            DATABASES.map(|database| scope.spawn(move || shell::run(command(program, database, &SHORT, true))));
        storms.into_iter().try_for_each(|storm| storm.join().unwrap_or_else(|_| Err(anyhow!("a storm panicked"))))
    })
}

/// Jobs queued in the comparison with a queue library.
const QUEUED: &str = "8000";

/// Drains of each side of the comparison; the medians are compared.
const DRAINS: usize = 3;

/// The queue's speed on both databases, and beside a library's on SQLite.
pub(crate) fn bench(large: u64) -> Result<()> {
    let ours = tools::release_example("queue_bench")?;
    each(&ours, &["--large", &large.to_string()], false)?;
    let built = tools::target()?.join("bench-queue");
    let mut build = shell::command("cargo");
    build.args(["build", "--release", "--quiet", "--manifest-path"]);
    build.arg(shell::root()?.join("tests/bench/queue/Cargo.toml")).env("CARGO_TARGET_DIR", &built);
    shell::run(build)?;
    let (mut we, mut they) = (Vec::new(), Vec::new());
    for _ in 0..DRAINS {
        we.push(drained(command(&ours, "sqlite", &["--drain", QUEUED], false))?);
        let mut peer = shell::command(built.join("release/bench-queue-peer"));
        peer.arg(QUEUED);
        they.push(drained(peer)?);
    }
    let (we, they) = (bench::median(we), bench::median(they));
    println!("{QUEUED} queued no-op jobs on SQLite: {we:.0}/s, apalis 1.0 {they:.0}/s ({:.1} times)", we / they);
    Ok(())
}

fn drained(run: Command) -> Result<f64> {
    Ok(shell::output(run)?.trim().parse()?)
}

fn each(program: &Path, arguments: &[&str], is_storm: bool) -> Result<()> {
    tools::postgres()?;
    DATABASES.iter().try_for_each(|database| shell::run(command(program, database, arguments, is_storm)))
}

fn command(program: &Path, database: &str, arguments: &[&str], is_storm: bool) -> Command {
    let mut run = shell::command(program);
    if is_storm {
        run.arg("run");
    }
    run.arg(database).args(arguments);
    run
}
