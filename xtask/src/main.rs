//! `cargo xtask`: the project's own commands. `demo` and `test` are all that a new user needs.

mod bench;
mod check;
mod drawn;
mod fuzz;
mod shell;
mod storm;
mod surfaces;
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
    /// Reconstruct many simulated scans and compare them with the truth: ten noise seeds of the demo scan, or random vessels;
    /// or let other programs judge the surfaces of random vessels.
    Survey {
        /// Number of random vessels, each with a scan of its own resolution and noise.
        #[arg(long)]
        count: Option<u64>,
        /// Number of random vessels of whose surfaces other programs judge, without scans.
        #[arg(long, conflicts_with = "count")]
        surfaces: Option<u64>,
        /// Let the stacks of the random vessels end anywhere.
        #[arg(long, requires = "count")]
        cut: bool,
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
    /// Change valid files and read them again: no reader may panic, hang or allocate beyond its limits.
    Fuzz {
        /// Minutes for each reader.
        #[arg(long, default_value_t = 10.0)]
        minutes: f64,
        /// Seed of the changes.
        #[arg(long, default_value_t = 1)]
        seed: u64,
    },
    /// Time and memory, beside other programs where there are any.
    Bench {
        /// What is measured.
        #[arg(value_enum, default_value_t = bench::What::Whole)]
        what: bench::What,
        /// Repetitions (of `accuracy`: seeds of each resolution, of `portal`: visits); the medians are shown.
        #[arg(long, default_value_t = 5)]
        repeat: usize,
        /// Jobs queued in the large case of `queue`.
        #[arg(long, default_value_t = 1_000_000)]
        large: u64,
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
        Command::Survey { surfaces: Some(count), first, .. } => surfaces::run(count, first.saturating_sub(1)),
        Command::Survey { count: None, first, .. } => survey::run(&tools::release_binary()?, first, 10),
        Command::Survey { count: Some(count), first, cut, .. } => {
            let stacks = if cut { drawn::Stacks::Cut } else { drawn::Stacks::Whole };
            drawn::run(&tools::release_binary()?, first, count, stacks)
        }
        Command::Bench { what: bench::What::Whole, repeat, .. } => bench::run(&tools::release_binary()?, repeat),
        Command::Bench { what: bench::What::Thinning, repeat, .. } => bench::thinning(repeat),
        Command::Bench { what: bench::What::Fit, repeat, .. } => bench::fit(repeat),
        Command::Fuzz { minutes, seed } => fuzz::run(minutes, seed),
        Command::Bench { what: bench::What::Surface, .. } => bench::surface(),
        Command::Bench { what: bench::What::Accuracy, repeat, .. } => bench::accuracy(repeat),
        Command::Bench { what: bench::What::Service, .. } => bench::service(&tools::release_binary()?),
        Command::Bench { what: bench::What::Portal, repeat, .. } => bench::portal(repeat),
        Command::Bench { what: bench::What::Queue, large, .. } => storm::bench(large),
        Command::Storm { kills, jobs, seed } => storm::run(kills, jobs, seed),
    }
}

fn demo(seed: u64, keep: bool) -> Result<()> {
    // Without it the portal of `--keep` would lack its 3D view.
    tools::node()?;
    let binary = tools::release_binary()?;
    let out = shell::root()?.join("demo");
    let mut command = shell::command(&binary);
    command.args(["demo", "--seed", &seed.to_string(), "--out"]).arg(&out);
    if keep {
        command.arg("--keep");
    }
    shell::run(command)
}
