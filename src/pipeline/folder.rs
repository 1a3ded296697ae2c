//! A folder that appears whole or not at all.

use crate::Failure;
use artefact::write::NamedBytes;
use space::FaultKind;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

/// Refuse, before any work is done, a folder that holds something else than an earlier result.
pub(crate) fn refuse_foreign(out: &Path) -> Result<(), Failure> {
    let Ok(mut entries) = fs::read_dir(out) else {
        return if out.exists() { Err(taken(out, "is not a folder")) } else { Ok(()) };
    };
    if entries.next().is_none() || out.join("provenance.json").is_file() {
        return Ok(());
    }
    Err(taken(out, "holds other files"))
}

fn taken(out: &Path, why: &str) -> Failure {
    let message = format!("the output {} {why}: name a new folder", out.display());
    Failure::new(FaultKind::Input, "output.taken", message)
}

/// Write all files beside the folder, then put them in its place with one rename (an earlier result is replaced).
pub(crate) fn publish(out: &Path, files: &[NamedBytes]) -> Result<(), Failure> {
    let partial = beside(out, "partial");
    let outcome = write_and_swap(out, &partial, files);
    if outcome.is_err() {
        let _ = fs::remove_dir_all(&partial);
    }
    outcome.map_err(|e| Failure::internal(format!("the output folder {} cannot be written: {e}", out.display())))
}

fn write_and_swap(out: &Path, partial: &Path, files: &[NamedBytes]) -> std::io::Result<()> {
    if partial.exists() {
        fs::remove_dir_all(partial)?;
    }
    fs::create_dir_all(partial)?;
    for file in files {
        fs::write(partial.join(&file.name), &file.bytes)?;
    }
    if !out.exists() {
        return fs::rename(partial, out);
    }
    let old = beside(out, "old");
    if old.exists() {
        fs::remove_dir_all(&old)?;
    }
    fs::rename(out, &old)?;
    fs::rename(partial, out)?;
    fs::remove_dir_all(&old)
}

fn beside(out: &Path, suffix: &str) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(out.file_name().unwrap_or_else(|| "out".as_ref()));
    name.push(format!(".{suffix}-{}", std::process::id()));
    out.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_foreign_folder_is_refused_and_an_earlier_result_replaced() {
        let base = std::env::temp_dir().join(format!("vasculum-folder-{}", std::process::id()));
        let out = base.join("out");
        fs::create_dir_all(&out).unwrap();
        fs::write(out.join("thesis.doc"), "mine").unwrap();
        assert_eq!(refuse_foreign(&out).unwrap_err().code, "output.taken");
        fs::remove_file(out.join("thesis.doc")).unwrap();
        let files = |text: &str| vec![NamedBytes::new("provenance.json", text)];
        publish(&out, &files("one")).unwrap();
        refuse_foreign(&out).unwrap();
        publish(&out, &files("two")).unwrap();
        assert_eq!(fs::read(out.join("provenance.json")).unwrap(), b"two");
        assert_eq!(fs::read_dir(&base).unwrap().count(), 1, "nothing is left beside the folder");
        fs::remove_dir_all(&base).unwrap();
    }
}
