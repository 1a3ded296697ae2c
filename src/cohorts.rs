//! `cohort`: the tables of many finished reconstructions together.

use crate::arguments::Cohort;
use crate::jobs::report;
use crate::terminal::say;
use artefact::cohort::{Filter, Row, Table, csv, document, plot, spreads};
use pipeline::Failure;
use serde_json::Value;
use service::Problem;
use service::cohort::{Source, Wanted};
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
            say!("{text}");
            ExitCode::SUCCESS
        }
        Err(failure) => report(&failure, a.json),
    }
}

fn made(a: &Cohort) -> Result<String, Failure> {
    let filter = Filter {
        names: a.name.clone(),
        quantities: a.quantity.clone(),
        kinds: a.kind.clone(),
        branches: a.branch.clone(),
        without_warnings: a.without_warnings,
    };
    let mut all = Table::default();
    for folder in &a.input {
        let file = if folder.is_dir() { folder.join("result.json") } else { folder.clone() };
        let bytes = std::fs::read(&file).map_err(|e| Failure::unreadable(&file, &e))?;
        let result: Value = serde_json::from_slice(&bytes)
            .map_err(|e| Failure::unreadable(&file, &std::io::Error::new(std::io::ErrorKind::InvalidData, e)))?;
        let kind = if result["variant"].is_null() { "reconstruction" } else { "variant" };
        if a.job_kind.as_ref().is_none_or(|wanted| wanted == kind) {
            all.add(&name(folder), None, &result, &filter);
        }
    }
    if let Some(out) = &a.out {
        written(out, &all).map_err(|e| Failure::internal(format!("{} cannot be written: {e}", out.display())))?;
    }
    if a.json {
        let text = serde_json::to_string(&document(&all)).map_err(Failure::internal)?;
        return Ok(format!("{text}\n"));
    }
    Ok(table(&all.rows))
}

/// A job is called after its folder.
fn name(folder: &Path) -> String {
    let named = if folder.is_dir() { Some(folder) } else { folder.parent() };
    let full: PathBuf = named.and_then(|f| f.canonicalize().ok()).unwrap_or_else(|| folder.to_owned());
    full.file_name().map_or_else(|| folder.display().to_string(), |n| n.to_string_lossy().into_owned())
}

fn written(out: &Path, all: &Table) -> std::io::Result<()> {
    std::fs::create_dir_all(out)?;
    std::fs::write(out.join(CSV), csv(&all.rows))?;
    std::fs::write(out.join(JSON), serde_json::to_string_pretty(&document(all))? + "\n")?;
    std::fs::write(out.join(SVG), plot(&all.rows))
}

/// The service's table of many jobs, made by the same code.
pub(crate) struct OfJobs {
    filter: Filter,
    table: Table,
}

/// A table for `GET /v1/cohort`.
pub(crate) fn of_jobs(wanted: Wanted) -> Box<dyn service::cohort::Table> {
    let Wanted { names, quantities, kinds, branches, without_warnings } = wanted;
    let filter = Filter { names, quantities, kinds, branches, without_warnings };
    Box::new(OfJobs { filter, table: Table::default() })
}

impl service::cohort::Table for OfJobs {
    fn add(&mut self, source: &Source, result: &[u8]) -> Result<(), Problem> {
        let result: Value = serde_json::from_slice(result).map_err(Problem::internal)?;
        self.table.add(&source.job, source.created_at.clone(), &result, &self.filter);
        Ok(())
    }

    fn json(&self) -> Result<Vec<u8>, Problem> {
        serde_json::to_vec(&document(&self.table)).map_err(Problem::internal)
    }

    fn csv(&self) -> Result<Vec<u8>, Problem> {
        Ok(csv(&self.table.rows).into_bytes())
    }
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

#[cfg(test)]
mod tests {
    use artefact::cohort::{DEGREES, QUANTITIES};
    use service::cohort::Quantity;

    #[test]
    fn the_api_names_every_quantity() {
        let ours: Vec<&str> = QUANTITIES.iter().map(|(name, _)| *name).chain([DEGREES]).collect();
        let named: Vec<&str> = Quantity::ALL.iter().map(|q| q.as_str()).collect();
        assert_eq!(named, ours);
    }
}
