//! Bundles the portal's 3D view (three.js) with esbuild into OUT_DIR, so that the source tree stays clean and the
//! binary needs nothing at run time. Without npm, or without its registry, the binary gets a stand-in and the page says that the
//! 3D view is missing; everything else of the page is plain files that need no build.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

const SOURCES: &[&str] = &["package.json", "package-lock.json", "build.mjs", "view3d.js"];
const STAND_IN: &str = "export const available = false;\nexport function show() {}\n";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=../../migrations/sqlite");
    for source in SOURCES {
        println!("cargo:rerun-if-changed=portal/{source}");
    }
    let out = PathBuf::from(env::var("OUT_DIR")?);
    if let Err(error) = bundle(&out) {
        println!("cargo:warning=the portal will lack its 3D view ({error}); install Node.js and npm and build again");
        fs::write(out.join("view3d.js"), STAND_IN)?;
    }
    Ok(())
}

fn bundle(out: &Path) -> Result<(), Box<dyn Error>> {
    let folder = out.join("portal-build");
    fs::create_dir_all(&folder)?;
    for source in SOURCES {
        fs::copy(Path::new("portal").join(source), folder.join(source))?;
    }
    run(Command::new("npm").args(["ci", "--no-audit", "--no-fund", "--ignore-scripts"]).current_dir(&folder))?;
    run(Command::new("node").arg("build.mjs").arg(out.join("view3d.js")).current_dir(&folder))
}

fn run(command: &mut Command) -> Result<(), Box<dyn Error>> {
    let output = command.output().map_err(|e| format!("{}: {e}", command.get_program().display()))?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no message").to_owned();
    Err(format!("{} failed: {last}", command.get_program().display()).into())
}
