//! What happens to an upload between the network and the store.
//!
//! Everything here works on memory: names are made harmless and bytes de-identified before the first write, because
//! a file name, too, may carry a patient's. The heavy reading runs on a blocking thread, never on an async worker.

use crate::config::{Config, Instance, NamedBytes};
use crate::error::Problem;
use axum::http::StatusCode;
use std::collections::BTreeSet;

/// Longest file name kept, characters.
const LONGEST_NAME: usize = 100;

/// Reads the upload with the configured reader, then gives every file a harmless, unique name.
/// The order is that of the names, so that the same files in another order give the same input digest.
///
/// # Errors
/// What the reader says; `upload.empty` when nothing is left.
pub async fn intake(config: &Config, files: Vec<NamedBytes>) -> Result<Vec<NamedBytes>, Problem> {
    if files.is_empty() {
        return Err(empty());
    }
    let read = config.intake;
    let mut files = tokio::task::spawn_blocking(move || read(files)).await.map_err(Problem::internal)??;
    if files.is_empty() {
        return Err(empty());
    }
    files.sort_by(|a, b| a.0.cmp(&b.0));
    let names = harmless_names(files.iter().map(|(name, _)| name.as_str()));
    Ok(names.into_iter().zip(files).map(|(name, (_, bytes))| (name, bytes)).collect())
}

fn empty() -> Problem {
    Problem::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "upload.empty",
        "The upload holds no file. Send one or more parts named `input`: a zip, DICOM files, a volume or slices.",
    )
}

/// Takes no DICOM instance: the reader of a service that was given none.
pub fn no_instance(_bytes: &[u8]) -> Instance {
    let none = Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media_type", "This service reads no DICOM instances.");
    let [class, instance, study, series] = Default::default();
    Instance { class, instance, study, series, file: Err(none) }
}

/// Whether `bytes` are a JSON object: the least that any plan must be.
///
/// # Errors
/// `plan.json` with line and column.
pub fn json_object(bytes: &[u8]) -> Result<(), Problem> {
    let fault = |text: String| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "plan.json", text);
    match serde_json::from_slice::<serde_json::Value>(bytes) {
        Ok(serde_json::Value::Object(_)) => Ok(()),
        Ok(_) => Err(fault("The plan must be a JSON object such as {\"geometry\": {...}}.".to_owned())),
        Err(e) => Err(fault(format!("The plan is not JSON: {e}."))),
    }
}

/// Names without folders (a shared folder is dropped, others become part of the name), of letters, digits, `.`, `_`
/// and `-` only, never hidden, each once.
fn harmless_names<'a>(names: impl Iterator<Item = &'a str> + Clone) -> Vec<String> {
    let shared = shared_folder(names.clone());
    let mut taken = BTreeSet::new();
    names
        .enumerate()
        .map(|(i, name)| {
            let plain = harmless(name.get(shared..).unwrap_or(name));
            let unique = if taken.contains(&plain) || plain.is_empty() { format!("{i:06}_{plain}") } else { plain };
            taken.insert(unique.clone());
            unique
        })
        .collect()
}

/// Length of the folder prefix that all names have in common.
fn shared_folder<'a>(mut names: impl Iterator<Item = &'a str>) -> usize {
    let Some(first) = names.next() else { return 0 };
    let mut prefix = &first[..first.rfind('/').map_or(0, |i| i + 1)];
    for name in names {
        while !name.starts_with(prefix) {
            let parent = prefix.trim_end_matches('/').rfind('/').map_or(0, |i| i + 1);
            prefix = &prefix[..parent];
        }
    }
    prefix.len()
}

fn harmless(name: &str) -> String {
    let plain: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-') { c } else { '_' }).collect();
    let visible = plain.trim_start_matches(['.', '_', '-']);
    visible[visible.len().saturating_sub(LONGEST_NAME)..].trim_start_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_still_finds_its_raw_file() {
        let names = ["scan/a.mhd", "scan/a.raw"];
        assert_eq!(harmless_names(names.iter().copied()), ["a.mhd", "a.raw"]);
    }

    #[test]
    fn names_can_neither_climb_nor_hide_nor_collide() {
        let names = ["../../etc/passwd", ".hidden", "x/é", "x/ü", "x_ü"];
        let plain = harmless_names(names.iter().copied());
        assert_eq!(plain.iter().collect::<BTreeSet<_>>().len(), names.len());
        for name in plain {
            assert!(!name.is_empty() && !name.starts_with('.') && !name.contains('/'), "{name}");
        }
    }

    #[test]
    fn a_plan_must_be_an_object() {
        assert!(json_object(b"{}").is_ok());
        assert_eq!(json_object(b"[]").unwrap_err().code, "plan.json");
        assert_eq!(json_object(b"{").unwrap_err().status, 422);
    }
}
