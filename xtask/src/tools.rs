//! What the build and the tests need, installed into the project's own `.tools` folder where that is possible.
//!
//! A stamp with the list of packages makes a second run immediate.

use crate::shell;
use anyhow::{Context, Result, bail};
use std::fs;
use std::path::{Path, PathBuf};

/// Programs that judge our files; versions are pinned so that a green run stays green.
const PYTHON_PACKAGES: &[&str] = &[
    "numpy",
    "scipy<2",
    "vtk==9.5.2",
    "networkx==3.6.1",
    "pydicom==3.0.2",
    "nibabel==5.4.2",
    "SimpleITK==2.5.7",
    "pillow==13.0.0",
    "pylibjpeg==2.1.0",
    "pylibjpeg-libjpeg==2.5.0",
    "pylibjpeg-openjpeg==2.6.0",
    "pyjpegls==1.5.1",
    "python-gdcm==3.2.6",
    "openapi-spec-validator==0.7.2",
    "jsonschema<5",
    "PyYAML",
    "pymeshlab==2025.7.post1",
    "schemathesis==4.32.5",
    "kubernetes-validate==1.37.0",
    "podman-compose==1.6.0",
    "dicomweb-client==0.61.2",
    "requests<3",
    "boto3==1.44.8",
    "openapi-python-client==0.29.1",
    "gmsh==4.15.2",
    "tetgen==0.8.4",
    "meshio==5.3.5",
];
/// Programs that `cargo xtask bench thinning` runs beside ours; only measured against, never linked.
const THINNING_PACKAGES: &[&str] = &["numpy", "gaara==0.11.0", "scikit-image==0.26.0"];
/// VMTK, measured against on the same scans, and the reader of the scans.
const VMTK_PACKAGES: &[&str] = &["vmtk==1.5.2", "numpy", "nibabel==5.4.2"];
/// The oldest Python that VMTK's package is made for.
const VMTK_PYTHON: [u32; 2] = [3, 12];
const NODE_PACKAGES: &[&str] = &[
    "gltf-validator@2.0.0-dev.3.10",
    "playwright-core@1.65.1",
    "tus-js-client@4.3.1",
    "axe-core@4.14.1",
    "openapi-typescript@7.13.0",
    "openapi-fetch@0.17.0",
    "typescript@5.9.3",
    "@types/node@20",
];

/// Build the release binary (with the portal) and give its path.
pub(crate) fn release_binary() -> Result<PathBuf> {
    release(&[])?;
    built_binary()
}

/// Build one of the examples, optimised, and give its path.
pub(crate) fn release_example(name: &str) -> Result<PathBuf> {
    release(&[name])?;
    built_example(name)
}

/// Build the release binary (with the portal) and these examples.
///
/// Always over the whole workspace: cargo unites the features of what it builds together, so that a selection by package
/// would compile the dependencies again, with other features, and again when the next selection comes.
pub(crate) fn release(examples: &[&str]) -> Result<()> {
    compiler()?;
    node()?;
    let mut build = shell::command("cargo");
    build.args(["build", "--release", "--workspace", "--bins"]);
    for example in examples {
        build.args(["--example", example]);
    }
    shell::run(build)
}

/// Where the release binary lies once it is built.
pub(crate) fn built_binary() -> Result<PathBuf> {
    Ok(target()?.join("release/vasculum"))
}

/// Where an example lies once it is built.
pub(crate) fn built_example(name: &str) -> Result<PathBuf> {
    Ok(target()?.join("release/examples").join(name))
}

/// Cargo's target folder.
pub(crate) fn target() -> Result<PathBuf> {
    match std::env::var_os("CARGO_TARGET_DIR") {
        Some(dir) => Ok(shell::root()?.join(dir)),
        None => Ok(shell::root()?.join("target")),
    }
}

/// The folder of the project's own tools.
pub(crate) fn folder() -> Result<PathBuf> {
    let dir = match std::env::var_os("VASCULUM_TOOLS") {
        Some(dir) => PathBuf::from(dir),
        None => shell::root()?.join(".tools"),
    };
    fs::create_dir_all(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
    Ok(dir)
}

/// SQLite is built from C.
pub(crate) fn compiler() -> Result<()> {
    if shell::has("cc") {
        return Ok(());
    }
    apt("a C compiler (SQLite is compiled from source)", &["build-essential"])
}

/// The portal is bundled by npm. Without its 3D view everything else works, so that a failure here is only said.
pub(crate) fn node() -> Result<()> {
    if shell::has("npm") {
        return Ok(());
    }
    if let Err(e) = apt("Node.js (the portal's 3D view is bundled with it)", &["nodejs", "npm"]) {
        eprintln!("xtask: {e:#}; the portal is built without its 3D view");
    }
    Ok(())
}

/// A database server for the queue's tests; they run it themselves, in a temporary folder, as a user that is not root.
pub(crate) fn postgres() -> Result<()> {
    let servers = fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    if servers.into_iter().any(|version| version.path().join("bin/initdb").exists()) {
        return Ok(());
    }
    apt("PostgreSQL (the queue is tested on it)", &["postgresql"])
}

/// Keys and certificates of the tests' own, and a client that trusts them.
pub(crate) fn openssl() -> Result<()> {
    if shell::has("openssl") && shell::has("curl") {
        return Ok(());
    }
    apt("OpenSSL and curl (the tests make keys and certificates and ask by them)", &["openssl", "curl"])
}

/// Programs that read the files of deploy/.
pub(crate) fn deploy() -> Result<()> {
    if shell::has("promtool") && PathBuf::from("/usr/sbin/nginx").exists() {
        return Ok(());
    }
    apt("Prometheus and nginx (they read the files of deploy/)", &["prometheus", "nginx-light"])
}

/// Python with the judges of volumes and the libraries that Gmsh wants though it opens no window; the path of its
/// interpreter.
pub(crate) fn volume_judges() -> Result<PathBuf> {
    let python = python()?;
    let mut load = shell::command(&python);
    load.args(["-c", "import gmsh, tetgen"]);
    if !shell::succeeds(load) {
        let libraries =
            ["libglu1-mesa", "libgl1", "libopengl0", "libxcursor1", "libxfixes3", "libxft2", "libxinerama1"];
        let packages = [&libraries[..], &["libxrender1", "libgomp1"]].concat();
        apt("libraries of Gmsh (it fills our surfaces with tetrahedra)", &packages)?;
    }
    Ok(python)
}

/// What reads JSON in a shell, for the guide's commands.
pub(crate) fn jq() -> Result<()> {
    if shell::has("jq") && shell::has("curl") {
        return Ok(());
    }
    apt("jq and curl (the guide's commands are run)", &["jq", "curl"])
}

/// What reads the manual.
pub(crate) fn groff() -> Result<()> {
    if shell::has("groff") {
        return Ok(());
    }
    apt("groff (it reads the pages of the manual)", &["groff-base"])
}

/// What asks a service as often as it can.
pub(crate) fn wrk() -> Result<()> {
    if shell::has("wrk") {
        return Ok(());
    }
    apt("wrk (it measures the rate of requests)", &["wrk"])
}

/// What writes down every write and sync of a process.
pub(crate) fn strace() -> Result<()> {
    if shell::has("strace") {
        return Ok(());
    }
    apt("strace (the database's file is looked at after each of its syncs)", &["strace"])
}

/// A PACS that sends by DICOMweb, and what feeds it. The package's own service is of no use here.
pub(crate) fn pacs() -> Result<()> {
    if PathBuf::from("/usr/sbin/Orthanc").exists() && shell::has("storescu") {
        return Ok(());
    }
    apt("Orthanc and dcmtk (they send a series by DICOMweb)", &["orthanc", "orthanc-dicomweb", "dcmtk"])
}

/// An S3 server that checks signatures and checksums, for the store's tests; its program.
pub(crate) fn s3() -> Result<PathBuf> {
    let root = folder()?.join("s3s");
    let program = root.join("bin/s3s-fs");
    if !program.exists() {
        let mut install = shell::command("cargo");
        install
            .args(["install", "s3s-fs", "--version", "0.14.1", "--features", "binary", "--locked", "--root"])
            .arg(&root);
        shell::run(install)?;
    }
    Ok(program)
}

/// Headless browser for the portal's test.
pub(crate) fn browser() -> Result<()> {
    if shell::has("chromium") {
        return Ok(());
    }
    apt("Chromium (the portal's pages are opened in it)", &["chromium"])
}

/// Python with the judges; the path of its interpreter.
pub(crate) fn python() -> Result<PathBuf> {
    if !shell::has("python3") || !python_has_venv() {
        apt("Python with venv (programs that judge our files)", &["python3", "python3-venv"])?;
    }
    environment("python3".as_ref(), "venv", PYTHON_PACKAGES)
}

/// Python with the peers of thinning; the path of its interpreter.
pub(crate) fn thinning_peers() -> Result<PathBuf> {
    if !shell::has("python3") || !python_has_venv() {
        apt("Python with venv (programs to measure against)", &["python3", "python3-venv"])?;
    }
    environment("python3".as_ref(), "venv-thinning", THINNING_PACKAGES)
}

/// Python with VMTK; the path of its interpreter.
///
/// # Errors
/// Where no Python of 3.12 or later is found: Debian 12 has none, so that none is installed from here.
pub(crate) fn vmtk() -> Result<PathBuf> {
    let [major, minor] = VMTK_PYTHON;
    let python = python_since(major, minor).with_context(|| {
        format!(
            "VMTK needs Python >= {major}.{minor} with venv: no python3 on PATH and none of pyenv's versions \
             ($PYENV_ROOT, ~/.pyenv) is one; install it, for instance by `pyenv install {major}.{minor}`"
        )
    })?;
    environment(&python, "venv-vmtk", VMTK_PACKAGES)
}

/// An interpreter of this version or later that can make environments: on PATH, or among pyenv's versions.
fn python_since(major: u32, minor: u32) -> Option<PathBuf> {
    let wanted = format!("import sys, venv, ensurepip; sys.exit(sys.version_info < ({major}, {minor}))");
    let on_path =
        std::iter::once("python3".into()).chain((minor..minor + 3).map(|m| format!("python{major}.{m}").into()));
    on_path.chain(pyenv_pythons()).find(|python: &PathBuf| {
        let mut c = shell::command(python);
        c.args(["-c", &wanted]);
        shell::succeeds(c)
    })
}

/// The interpreters below pyenv's versions folder, in name order.
fn pyenv_pythons() -> Vec<PathBuf> {
    let root = std::env::var_os("PYENV_ROOT").map(PathBuf::from);
    let root = root.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".pyenv")));
    let versions = root.and_then(|root| fs::read_dir(root.join("versions")).ok()).into_iter().flatten().flatten();
    let mut pythons: Vec<PathBuf> = versions.map(|version| version.path().join("bin/python3")).collect();
    pythons.sort();
    pythons
}

/// A virtual environment of this interpreter with these packages; the path of its own interpreter.
fn environment(python: &Path, name: &str, packages: &[&str]) -> Result<PathBuf> {
    let venv = folder()?.join(name);
    let interpreter = venv.join("bin/python");
    let wanted = packages.join("\n");
    let stamp = venv.join("packages.txt");
    if fs::read_to_string(&stamp).is_ok_and(|have| have == wanted) {
        return Ok(interpreter);
    }
    let mut make = shell::command(python);
    make.args(["-m", "venv", "--clear"]).arg(&venv);
    shell::run(make)?;
    let mut install = shell::command(&interpreter);
    install.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]).args(packages);
    shell::run(install)?;
    fs::write(&stamp, wanted)?;
    Ok(interpreter)
}

fn python_has_venv() -> bool {
    let mut c = shell::command("python3");
    c.args(["-c", "import venv, ensurepip"]);
    shell::succeeds(c)
}

/// Node packages for the tests; the folder that holds `node_modules`.
pub(crate) fn node_packages() -> Result<PathBuf> {
    node()?;
    let dir = folder()?.join("node");
    fs::create_dir_all(&dir)?;
    let wanted = NODE_PACKAGES.join("\n");
    let stamp = dir.join("packages.txt");
    if fs::read_to_string(&stamp).is_ok_and(|have| have == wanted) {
        return Ok(dir);
    }
    fs::write(dir.join("package.json"), "{\"private\": true}\n")?;
    let mut install = shell::command("npm");
    install.args(["install", "--no-audit", "--no-fund", "--loglevel=error"]).args(NODE_PACKAGES).current_dir(&dir);
    shell::run(install)?;
    fs::write(&stamp, wanted)?;
    Ok(dir)
}

/// A script run by Node.js with the packages of that folder: modules resolve them from their own folder, so that a copy of the
/// script beside `node_modules` is run.
pub(crate) fn node_script(packages: &Path, script: &Path) -> Result<std::process::Command> {
    let copy = packages.join(script.file_name().unwrap_or_default());
    fs::copy(script, &copy)?;
    let mut command = shell::command("node");
    command.arg(copy);
    Ok(command)
}

/// Install Debian packages, as root or through sudo.
fn apt(what: &str, packages: &[&str]) -> Result<()> {
    eprintln!("xtask: installing {what}: {}", packages.join(" "));
    if !shell::has("apt-get") {
        bail!("{what} is missing and there is no apt-get: install {} by hand", packages.join(" "));
    }
    let mut whoami = std::process::Command::new("id");
    whoami.arg("-u");
    let root = whoami.output().is_ok_and(|o| o.stdout.starts_with(b"0"));
    for arguments in
        [vec!["update", "-qq"], [vec!["install", "-y", "-qq", "--no-install-recommends"], packages.to_vec()].concat()]
    {
        let mut command = shell::command(if root { "apt-get" } else { "sudo" });
        if !root {
            command.arg("apt-get");
        }
        command.args(arguments).env("DEBIAN_FRONTEND", "noninteractive");
        shell::run(command).with_context(|| format!("{what} could not be installed"))?;
    }
    Ok(())
}
