//! `cargo xtask storm` and `cargo xtask bench queue`: the queue under `kill -9`, and its speed.

use crate::{shell, tools};
use anyhow::Result;

/// Kills of the short storm in the test command: about three minutes over both databases.
const SHORT: [&str; 6] = ["--kills", "120", "--jobs", "1500", "--minutes", "3"];

/// The whole storm on both databases (bars: 1,000 kills over 20,000 jobs on each).
pub(crate) fn run(kills: usize, jobs: usize, seed: u64) -> Result<()> {
    each("storm", &["--kills", &kills.to_string(), "--jobs", &jobs.to_string(), "--seed", &seed.to_string()], true)
}

/// The short storm.
pub(crate) fn short() -> Result<()> {
    each("storm", &SHORT, true)
}

/// The queue's speed on both databases.
pub(crate) fn bench(large: u64) -> Result<()> {
    each("queue_bench", &["--large", &large.to_string()], false)
}

fn each(example: &str, arguments: &[&str], is_storm: bool) -> Result<()> {
    tools::postgres()?;
    let mut build = shell::command("cargo");
    build.args(["build", "--release", "--package", "service", "--example", example]);
    shell::run(build)?;
    for database in ["sqlite", "postgres"] {
        let mut run = shell::command(tools::target()?.join("release/examples").join(example));
        if is_storm {
            run.arg("run");
        }
        run.arg(database).args(arguments);
        shell::run(run)?;
    }
    Ok(())
}
