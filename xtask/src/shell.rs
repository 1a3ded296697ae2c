//! Running programs: every command is shown before it runs, and a failure names it.

use anyhow::{Context, Result, bail};
use std::ffi::OsStr;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};

/// Commands that take this long tell it: the test command's time is a bar of its own.
const SLOW_S: u64 = 10;

/// The workspace's root.
pub(crate) fn root() -> Result<PathBuf> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    Ok(here.parent().context("xtask lies in the workspace")?.to_path_buf())
}

/// A command that runs in the workspace's root.
pub(crate) fn command(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(program);
    if let Ok(root) = root() {
        command.current_dir(root);
    }
    command
}

/// Show and run; an exit code other than 0 is an error.
pub(crate) fn run(mut command: Command) -> Result<()> {
    eprintln!("+ {}", words(&command));
    timed(&mut command, |command| command.status())
}

/// Show and run, and show what it wrote when it has ended: for commands that run beside others.
pub(crate) fn run_whole(mut command: Command) -> Result<()> {
    eprintln!("+ {}", words(&command));
    timed(&mut command, |command| {
        let output = command.stdin(Stdio::null()).output()?;
        let written = [output.stdout, output.stderr].concat();
        io::stderr().write_all(&[format!("- {}\n", words(command)).as_bytes(), &written].concat())?;
        Ok(output.status)
    })
}

/// Show and run; what it wrote for programs to read. What it has for people it shows.
pub(crate) fn output(mut command: Command) -> Result<String> {
    eprintln!("+ {}", words(&command));
    let mut written = Vec::new();
    timed(&mut command, |command| {
        let output = command.stderr(Stdio::inherit()).output()?;
        written = output.stdout;
        Ok(output.status)
    })?;
    Ok(String::from_utf8(written)?)
}

fn timed(command: &mut Command, run: impl FnOnce(&mut Command) -> io::Result<ExitStatus>) -> Result<()> {
    let started = std::time::Instant::now();
    let status = run(command).with_context(|| format!("cannot run {}", words(command)))?;
    let took = started.elapsed().as_secs();
    if took >= SLOW_S {
        eprintln!("xtask: that took {took} s ({})", words(command));
    }
    if !status.success() {
        bail!("{} ended with {status}", words(command));
    }
    Ok(())
}

/// Run quietly; whether it started and exited with 0.
pub(crate) fn succeeds(mut command: Command) -> bool {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}

/// Whether a program can be started.
pub(crate) fn has(program: &str) -> bool {
    let mut c = Command::new(program);
    c.arg("--version");
    succeeds(c)
}

fn words(command: &Command) -> String {
    let args = command.get_args().map(|a| a.to_string_lossy().into_owned());
    std::iter::once(command.get_program().to_string_lossy().into_owned()).chain(args).collect::<Vec<_>>().join(" ")
}
