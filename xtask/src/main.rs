//! `cargo xtask`: the project's own commands. `demo` and `test` are all that a new user needs.

mod bench;
mod check;
mod shell;
mod storm;
mod survey;
mod tools;

use anyhow::Result;
use clap::{Parser, Subcommand};
use std::process::ExitCode;

#[derive(Parser)]
#[command(about = "Vasculum's own commands", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Build, start the service, reconstruct a simulated scan through it, show the angles beside the truth.
    Demo {
        /// Noise seed of the simulated scan.
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Keep the service running afterwards (the default when a person is at the terminal).
        #[arg(long)]
        keep: bool,
    },
    /// Install what the tests need, then run every check.
    Test,
    /// Reconstruct many simulated scans and compare them with the truth.
    Survey {
        /// Number of noise seeds.
        #[arg(long, default_value_t = 10)]
        count: u64,
        /// First seed.
        #[arg(long, default_value_t = 1)]
        first: u64,
    },
    /// Kill server, workers, children and the database at random while jobs come in; then look at every promise.
    Storm {
        /// Kills on each database.
        #[arg(long, default_value_t = 1000)]
        kills: usize,
        /// Jobs on each database.
        #[arg(long, default_value_t = 20_000)]
        jobs: usize,
        /// Seed of the order of kills.
        #[arg(long, default_value_t = 1)]
        seed: u64,
    },
    /// Jobs per second of the queue on SQLite and PostgreSQL, with few and with many queued.
    BenchQueue {
        /// Jobs queued in the large case.
        #[arg(long, default_value_t = 1_000_000)]
        large: u64,
    },
    /// Time and memory of the whole reconstruction, stage by stage.
    Bench {
        /// Repetitions; the medians are shown.
        #[arg(long, default_value_t = 5)]
        repeat: usize,
    },
}

fn main() -> ExitCode {
    match run(Arguments::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("xtask: {e:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<()> {
    match command {
        Command::Demo { seed, keep } => demo(seed, keep),
        Command::Test => check::all(),
        Command::Survey { count, first } => survey::run(&tools::release_binary()?, first, count),
        Command::Storm { kills, jobs, seed } => storm::run(kills, jobs, seed),
        Command::BenchQueue { large } => storm::bench(large),
        Command::Bench { repeat } => bench::run(&tools::release_binary()?, repeat),
    }
}

fn demo(seed: u64, keep: bool) -> Result<()> {
    let binary = tools::release_binary()?;
    let out = shell::root()?.join("demo");
    let mut command = shell::command(&binary);
    command.args(["demo", "--seed", &seed.to_string(), "--out"]).arg(&out);
    if keep {
        command.arg("--keep");
    }
    shell::run(command)
}
