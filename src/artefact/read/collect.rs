//! Paths to named bytes: folders are walked in name order, archives opened, system files left out.

use super::archive::unzip;
use super::detect::{Kind, is_ignored, kind};
use super::{Error, Limits, NamedBytes};
use std::path::{Path, PathBuf};

/// Folders deeper than this are not walked (a link cycle would be endless).
const MAX_DEPTH: usize = 16;

/// The files behind some paths: a folder with all below it, a zip, files. Names are relative to the path given, so that
/// no path of this machine appears in a message.
///
/// # Errors
/// [`Error::Unreadable`], [`Error::Archive`], [`Error::TooLarge`].
pub fn collect(inputs: &[PathBuf], limits: &Limits) -> Result<Vec<NamedBytes>, Error> {
    let mut files = Vec::new();
    for input in inputs {
        let name = base_name(input);
        if input.is_dir() {
            walk(input, "", 0, limits, &mut files)?;
        } else {
            files.push(load(input, name, limits)?);
        }
    }
    expand(files, limits)
}

/// Archives replaced by their files; system files left out; the totals held against the limits.
///
/// # Errors
/// [`Error::Archive`], [`Error::TooLarge`].
pub(crate) fn expand(files: Vec<NamedBytes>, limits: &Limits) -> Result<Vec<NamedBytes>, Error> {
    let mut out = Vec::new();
    for file in files {
        if is_ignored(&file.name) {
            continue;
        }
        match kind(&file.bytes) {
            Kind::Zip => out.append(&mut unzip(&file, limits)?),
            _ => out.push(file),
        }
        let bytes: u64 = out.iter().map(|f| f.bytes.len() as u64).sum();
        let totals = [
            ("the number of files", out.len() as u64, limits.entries as u64),
            ("the decompressed size in bytes", bytes, limits.total_bytes),
        ];
        if let Some(&(what, value, limit)) = totals.iter().find(|(_, value, limit)| value > limit) {
            return Err(Error::TooLarge { file: None, what, value, limit });
        }
    }
    Ok(out)
}

fn base_name(path: &Path) -> String {
    path.file_name().map_or_else(|| "input".to_owned(), |n| n.to_string_lossy().into_owned())
}

fn unreadable(name: &str, e: &std::io::Error) -> Error {
    Error::Unreadable { file: name.to_owned(), reason: e.to_string() }
}

fn load(path: &Path, name: String, limits: &Limits) -> Result<NamedBytes, Error> {
    let size = std::fs::metadata(path).map_err(|e| unreadable(&name, &e))?.len();
    if size > limits.total_bytes {
        let (what, limit) = ("the size in bytes", limits.total_bytes);
        return Err(Error::TooLarge { file: Some(name), what, value: size, limit });
    }
    let bytes = std::fs::read(path).map_err(|e| unreadable(&name, &e))?;
    Ok(NamedBytes { name, bytes })
}

fn walk(folder: &Path, prefix: &str, depth: usize, limits: &Limits, files: &mut Vec<NamedBytes>) -> Result<(), Error> {
    let shown = if prefix.is_empty() { base_name(folder) } else { prefix.to_owned() };
    if depth > MAX_DEPTH {
        let (what, value, limit) = ("the depth of folders", depth as u64, MAX_DEPTH as u64);
        return Err(Error::TooLarge { file: Some(shown), what, value, limit });
    }
    let entries = std::fs::read_dir(folder).map_err(|e| unreadable(&shown, &e))?;
    let mut paths: Vec<PathBuf> =
        entries.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>().map_err(|e| unreadable(&shown, &e))?;
    paths.sort();
    for path in paths {
        let name = format!("{prefix}{}", base_name(&path));
        if is_ignored(&name) {
            continue;
        }
        if path.is_dir() {
            walk(&path, &format!("{name}/"), depth + 1, limits, files)?;
        } else {
            files.push(load(&path, name, limits)?);
            let total: u64 = files.iter().map(|f| f.bytes.len() as u64).sum();
            if files.len() > limits.entries || total > limits.total_bytes {
                let (what, limit) = ("the size of the folder in bytes", limits.total_bytes);
                return Err(Error::TooLarge { file: Some(shown), what, value: total, limit });
            }
        }
    }
    Ok(())
}
