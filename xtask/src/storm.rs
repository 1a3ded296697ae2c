//! `cargo xtask storm` and `cargo xtask bench queue`: the queue under `kill -9`, and its speed.

use crate::{shell, tools};
use anyhow::Result;
use std::path::Path;

/// Kills of the short storm in the test command: about three minutes over both databases.
const SHORT: [&str; 6] = ["--kills", "120", "--jobs", "1500", "--minutes", "3"];

/// The whole storm on both databases (bars: 1,000 kills over 20,000 jobs on each).
pub(crate) fn run(kills: usize, jobs: usize, seed: u64) -> Result<()> {
    let program = tools::release_example("storm")?;
    let [kills, jobs, seed] = [kills.to_string(), jobs.to_string(), seed.to_string()];
    each(&program, &["--kills", &kills, "--jobs", &jobs, "--seed", &seed], true)
}

/// The short storm.
pub(crate) fn short(program: &Path) -> Result<()> {
    each(program, &SHORT, true)
}

/// The queue's speed on both databases.
pub(crate) fn bench(large: u64) -> Result<()> {
    each(&tools::release_example("queue_bench")?, &["--large", &large.to_string()], false)
}

fn each(program: &Path, arguments: &[&str], is_storm: bool) -> Result<()> {
    tools::postgres()?;
    for database in ["sqlite", "postgres"] {
        let mut run = shell::command(program);
        if is_storm {
            run.arg("run");
        }
        run.arg(database).args(arguments);
        shell::run(run)?;
    }
    Ok(())
}
