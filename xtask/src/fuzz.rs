//! `cargo xtask fuzz`: every reader of files against changed files, each in a process of its own under a limit on its
//! memory.

use crate::{shell, tools};
use anyhow::{Context, Result, bail};
use std::fs;
use std::path::PathBuf;

const READERS: [&str; 6] = ["dicom", "nifti", "metaimage", "nrrd", "pictures", "archive"];
/// Address space of a reader whose limits admit 8 MiB of files and 2^20 pixels, KiB: the program itself maps 100 MiB.
const ADDRESS_SPACE_KIB: u64 = 640 << 10;

/// Fuzz each reader for some minutes; a panic, a hang or an allocation beyond the limit is an error, and its case is
/// kept in the target folder.
pub(crate) fn run(minutes: f64, seed: u64) -> Result<()> {
    let mut build = shell::command("cargo");
    // over the whole workspace, as the tests are built: the dependencies keep their features
    build.args(["build", "--workspace", "--example", "fuzz"]);
    shell::run(build)?;
    let folder = tools::target()?.join("fuzz");
    fs::create_dir_all(&folder)?;
    let program = tools::target()?.join("debug/examples/fuzz");
    let seconds = (60.0 * minutes).ceil() as u64;
    let mut failed = Vec::new();
    for reader in READERS {
        let mut fuzz = shell::command("sh");
        // the shell sets the limit, then becomes the program; `timeout` ends a case that hangs
        let script = format!("ulimit -v {ADDRESS_SPACE_KIB}; exec timeout {} \"$@\"", seconds + 60);
        fuzz.args(["-c", &script, "sh"]).arg(&program);
        fuzz.args([reader, &seconds.to_string(), &seed.to_string()]).arg(&folder);
        if reader == "dicom" {
            fuzz.args(compressed_scans());
        }
        if let Err(e) = shell::run(fuzz).with_context(|| format!("{reader} (see {})", folder.display())) {
            failed.push(format!("{e:#}"));
        }
    }
    if failed.is_empty() { Ok(()) } else { bail!(failed.join("\n")) }
}

/// pydicom's own files, where the tests have installed it: compressed frames of every kind.
fn compressed_scans() -> Option<PathBuf> {
    let python = tools::folder().ok()?.join("venv/bin/python");
    let mut ask = std::process::Command::new(python);
    ask.args(["-c", "import pydicom.data as d; print(d.DATA_ROOT + '/test_files')"]);
    let found = ask.output().ok().filter(|o| o.status.success())?;
    Some(PathBuf::from(String::from_utf8(found.stdout).ok()?.trim())).filter(|p| p.is_dir())
}
