//! `cargo xtask survey --surfaces N`: surfaces of random vessels before programs that we did not write.

use crate::{shell, tools};
use anyhow::{Result, ensure};
use std::fs;
use std::path::Path;

/// Mesh `count` random vessels twice each (uniform and by curvature) into a folder; a missed bar is an error.
pub(crate) fn meshes(program: &Path, folder: &Path, count: u64, first: u64) -> Result<()> {
    fs::create_dir_all(folder)?;
    let mut survey = shell::command(program);
    survey.args([count.to_string(), first.to_string()]).arg(folder);
    shell::run(survey)
}

/// Let Gmsh and TetGen fill the volumes of some of them.
pub(crate) fn volumes(folder: &Path, count: usize) -> Result<()> {
    let mut judge = shell::command(tools::volume_judges()?);
    judge.arg(shell::root()?.join("tests/bench/volumes.py")).arg(count.to_string()).env("SURFACES", folder);
    shell::run(judge)
}

/// Surfaces that Gmsh and TetGen fill, of a whole survey.
const FILLED: usize = 50;

/// The whole survey: our own bars, pymeshlab on every surface, Gmsh and TetGen on fifty.
pub(crate) fn run(count: u64, first: u64) -> Result<()> {
    ensure!(count > 0, "a survey of no vessel proves nothing");
    let folder = tools::target()?.join("survey-surfaces");
    if folder.exists() {
        fs::remove_dir_all(&folder)?;
    }
    meshes(&tools::release_example("survey")?, &folder, count, first)?;
    let mut judge = shell::command(tools::python()?);
    judge.arg(shell::root()?.join("tests/python/test_surfaces.py")).env("SURFACES", &folder);
    shell::run(judge)?;
    volumes(&folder, FILLED)?;
    fs::remove_dir_all(&folder)?;
    Ok(())
}
