//! Makes the portal's files in OUT_DIR, so that the source tree stays clean and the binary needs nothing at run time.
//!
//! With npm, esbuild bundles `portal/app` (and three.js and tus-js-client with it). Without npm, or without its registry,
//! the modules are taken as they are, with stand-ins for the two that need packages: the page then says that the 3D view
//! is missing and sends a scan in one piece; everything else is the same.

use std::error::Error;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// Modules that import packages, and what stands for them.
const STAND_INS: &[(&str, &str)] = &[
    ("view3d.js", "export const available = false;\nexport function open() {}\n"),
    ("tus.js", "export const available = false;\nexport class Upload {}\n"),
];
const PACKAGE: &[&str] = &["package.json", "package-lock.json", "build.mjs"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=../../migrations/sqlite");
    println!("cargo:rerun-if-changed=portal");
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let site = out.join("portal");
    if site.exists() {
        fs::remove_dir_all(&site)?;
    }
    fs::create_dir_all(&site)?;
    if let Err(error) = bundle(&out, &site) {
        println!("cargo:warning=the portal will lack its 3D view ({error}); install Node.js and npm and build again");
        plain(&site)?;
    }
    for name in ["index.html", "icon.svg", "text/en.json", "text/de.json"] {
        let name = Path::new(name);
        fs::copy(Path::new("portal").join(name), site.join(name.file_name().unwrap_or_default()))?;
    }
    let styles: Result<Vec<String>, _> = listed(Path::new("portal/style"))?.iter().map(fs::read_to_string).collect();
    fs::write(site.join("style.css"), styles?.concat())?;
    fs::write(out.join("portal_files.rs"), table(&site)?)?;
    Ok(())
}

fn bundle(out: &Path, site: &Path) -> Result<(), Box<dyn Error>> {
    let folder = out.join("portal-build");
    fs::create_dir_all(folder.join("app"))?;
    let lock = fs::read("portal/package-lock.json")?;
    // written last: a broken installation is made again
    let stamp = folder.join("installed.json");
    let installed = fs::read(&stamp).is_ok_and(|had| had == lock);
    for name in PACKAGE {
        fs::copy(Path::new("portal").join(name), folder.join(name))?;
    }
    for old in listed(&folder.join("app"))? {
        fs::remove_file(old)?;
    }
    for module in listed(Path::new("portal/app"))? {
        fs::copy(&module, folder.join("app").join(module.file_name().unwrap_or_default()))?;
    }
    if !installed {
        run(Command::new("npm").args(["ci", "--no-audit", "--no-fund", "--ignore-scripts"]).current_dir(&folder))?;
        fs::write(&stamp, lock)?;
    }
    run(Command::new("node").arg("build.mjs").arg(site).current_dir(&folder))
}

/// The modules without packages.
fn plain(site: &Path) -> Result<(), Box<dyn Error>> {
    for module in listed(Path::new("portal/app"))? {
        fs::copy(&module, site.join(module.file_name().unwrap_or_default()))?;
    }
    for (name, text) in STAND_INS {
        fs::write(site.join(name), text)?;
    }
    Ok(())
}

/// Files of a folder in name order.
fn listed(folder: &Path) -> Result<Vec<PathBuf>, Box<dyn Error>> {
    let entries: Result<Vec<_>, _> = fs::read_dir(folder)?.map(|entry| entry.map(|e| e.path())).collect();
    let mut files: Vec<PathBuf> = entries?.into_iter().filter(|path| path.is_file()).collect();
    files.sort();
    Ok(files)
}

/// The table of the page's files as Rust: name and bytes.
fn table(site: &Path) -> Result<String, Box<dyn Error>> {
    let mut text = String::from("&[\n");
    for file in listed(site)? {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        writeln!(text, "    ({name:?}, include_bytes!({:?})),", file.to_string_lossy())?;
    }
    text.push_str("]\n");
    Ok(text)
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
