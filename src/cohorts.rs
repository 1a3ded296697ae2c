//! `cohort`: the tables of many finished reconstructions together.

use crate::arguments::Cohort;
use crate::jobs::report;
use artefact::cohort::{Filter, Row, csv, document, plot, rows, spreads};
use pipeline::Failure;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Files of the folder that `--out` names.
const CSV: &str = "cohort.csv";
const JSON: &str = "cohort.json";
const SVG: &str = "cohort.svg";

/// Print the medians, or write all tables.
pub(crate) fn cohort(a: &Cohort) -> ExitCode {
    match made(a) {
        Ok(text) => {
            print!("{text}");
            ExitCode::SUCCESS
        }
        Err(failure) => report(&failure, a.json),
    }
}

fn made(a: &Cohort) -> Result<String, Failure> {
    let filter = Filter { names: a.name.clone(), quantities: a.quantity.clone(), without_warnings: a.without_warnings };
    let mut all = Vec::new();
    for folder in &a.input {
        let file = if folder.is_dir() { folder.join("result.json") } else { folder.clone() };
        let bytes = std::fs::read(&file).map_err(|e| Failure::unreadable(&file, &e))?;
        let result = serde_json::from_slice(&bytes)
            .map_err(|e| Failure::unreadable(&file, &std::io::Error::new(std::io::ErrorKind::InvalidData, e)))?;
        all.extend(rows(&name(folder), &result, &filter));
    }
    if let Some(out) = &a.out {
        written(out, &all).map_err(|e| Failure::internal(format!("{} cannot be written: {e}", out.display())))?;
    }
    Ok(if a.json { format!("{}\n", document(&all)) } else { table(&all) })
}

/// A job is called after its folder.
fn name(folder: &Path) -> String {
    let named = if folder.is_dir() { Some(folder) } else { folder.parent() };
    let full: PathBuf = named.and_then(|f| f.canonicalize().ok()).unwrap_or_else(|| folder.to_owned());
    full.file_name().map_or_else(|| folder.display().to_string(), |n| n.to_string_lossy().into_owned())
}

fn written(out: &Path, all: &[Row]) -> std::io::Result<()> {
    std::fs::create_dir_all(out)?;
    std::fs::write(out.join(CSV), csv(all))?;
    std::fs::write(out.join(JSON), format!("{:#}\n", document(all)))?;
    std::fs::write(out.join(SVG), plot(all))
}

/// Medians and quartiles in 80 columns.
fn table(all: &[Row]) -> String {
    let mut out = format!("{:<24}{:<23}{:>5}{:>9}{:>19}\n", "name", "quantity", "n", "median", "quartiles");
    for s in spreads(all) {
        let [_, q1, median, q3, _] = s.quantiles;
        let quartiles = format!("{q1:.3} .. {q3:.3}");
        let _ = writeln!(out, "{:<24}{:<23}{:>5}{median:>9.3}{quartiles:>19}", s.name, s.quantity, s.count);
    }
    out
}
