//! Reading an upload: parts counted and bounded before they are kept.
//!
//! The bytes stay in memory until they are de-identified, so the memory of all uploads together is a budget: a
//! request takes units of it as its parts arrive and gives them back when it ends; without units it is asked to come
//! again (503) instead of being killed for lack of memory.

use crate::config::NamedBytes;
use crate::error::Problem;
use crate::state::{State, UPLOAD_UNIT};
use axum::extract::multipart::{Field, Multipart, MultipartError};
use axum::http::StatusCode;
use tokio::sync::{OwnedSemaphorePermit, TryAcquireError};

/// Most parts of one upload (4096 slices and some sidecars).
const MOST_PARTS: usize = 8192;
/// Largest plan, bytes: a position for each of 4096 slices is below 100 kB; 1 MiB of nested lists took 70 MiB to read.
pub(super) const LARGEST_PLAN: usize = 512 << 10;

/// A read upload.
#[derive(Debug)]
pub(super) struct Upload {
    /// plan.json text; `{}` without one.
    pub plan: String,
    /// Files as sent.
    pub files: Vec<NamedBytes>,
    /// Memory held until the upload is stored.
    pub budget: Budget,
}

/// Units of the upload budget that a request holds.
#[derive(Debug, Default)]
pub(super) struct Budget {
    bytes: u64,
    permits: Vec<OwnedSemaphorePermit>,
}

impl Budget {
    /// Counts what was sent against the largest body.
    fn count(&mut self, state: &State, more: usize) -> Result<(), Problem> {
        self.bytes += more as u64;
        if self.bytes > state.config.max_body {
            return Err(Problem::new(
                StatusCode::PAYLOAD_TOO_LARGE,
                "upload.too_large",
                format!("The upload is larger than {} bytes, the most that this service takes.", state.config.max_body),
            ));
        }
        Ok(())
    }

    /// Takes what `more` bytes need.
    pub(super) fn grow(&mut self, state: &State, more: usize) -> Result<(), Problem> {
        self.count(state, more)?;
        while (self.permits.len() as u64) * UPLOAD_UNIT < self.bytes {
            match state.uploads.clone().try_acquire_owned() {
                Ok(permit) => self.permits.push(permit),
                Err(TryAcquireError::NoPermits | TryAcquireError::Closed) => {
                    return Err(Problem::new(
                        StatusCode::SERVICE_UNAVAILABLE,
                        "upload.busy",
                        "Other uploads take all the memory set aside for them. Send this one again in a moment.",
                    )
                    .with_header("retry-after", "10"));
                }
            }
        }
        Ok(())
    }
}

/// Reads every part.
///
/// # Errors
/// `upload.broken`, `upload.too_large`, `upload.busy`, `upload.part`, `upload.parts`, `plan.*`.
pub(super) async fn read(state: &State, mut form: Multipart) -> Result<Upload, Problem> {
    let mut upload = Upload { plan: "{}".to_owned(), files: Vec::new(), budget: Budget::default() };
    let mut plans = 0;
    // A client that is still sending sees a broken pipe instead of an early answer: what follows a refused plan is read
    // and dropped, within the same limit.
    let mut refused: Option<Problem> = None;
    let mut dropped = Budget::default();
    while let Some(field) = form.next_field().await.map_err(broken)? {
        match field.name() {
            Some("plan") => {
                plans += 1;
                match plan(state, field, &mut upload.budget).await {
                    Ok(text) => upload.plan = text,
                    Err(problem) => refused = refused.or(Some(problem)),
                }
            }
            Some("input") if refused.is_some() => skip(state, field, &mut dropped).await?,
            Some("input") => {
                if upload.files.len() == MOST_PARTS {
                    return Err(Problem::new(
                        StatusCode::PAYLOAD_TOO_LARGE,
                        "upload.parts",
                        format!("The upload has more than {MOST_PARTS} parts. Send the slices as one zip."),
                    ));
                }
                let name = field.file_name().map_or_else(|| format!("input-{:06}", upload.files.len()), str::to_owned);
                let bytes = collect(state, field, &mut upload.budget, usize::MAX).await?;
                upload.files.push((name, bytes));
            }
            other => return Err(unknown_part(other.unwrap_or(""))),
        }
    }
    if let Some(problem) = refused {
        return Err(problem);
    }
    if plans > 1 {
        return Err(Problem::new(StatusCode::BAD_REQUEST, "upload.part", "The upload has more than one part `plan`."));
    }
    Ok(upload)
}

/// Reads a part without keeping it.
async fn skip(state: &State, mut field: Field<'_>, dropped: &mut Budget) -> Result<(), Problem> {
    while let Some(chunk) = field.chunk().await.map_err(broken)? {
        dropped.count(state, chunk.len())?;
    }
    Ok(())
}

fn unknown_part(name: &str) -> Problem {
    let shown: String = name.chars().take(40).collect();
    Problem::new(
        StatusCode::BAD_REQUEST,
        "upload.part",
        format!("The upload has a part named `{shown}`. Name the parts `plan` (JSON) and `input` (files or a zip)."),
    )
}

async fn plan(state: &State, field: Field<'_>, budget: &mut Budget) -> Result<String, Problem> {
    let bytes = collect(state, field, budget, LARGEST_PLAN).await?;
    (state.config.check_plan)(&bytes)?;
    String::from_utf8(bytes).map_err(|e| {
        Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "plan.json", format!("The plan is not UTF-8 text: {e}."))
    })
}

async fn collect(state: &State, mut field: Field<'_>, budget: &mut Budget, most: usize) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    while let Some(chunk) = field.chunk().await.map_err(broken)? {
        budget.grow(state, chunk.len())?;
        if bytes.len() + chunk.len() > most {
            return Err(Problem::new(
                StatusCode::PAYLOAD_TOO_LARGE,
                "plan.too_large",
                format!("The plan is larger than {most} bytes."),
            ));
        }
        bytes.extend_from_slice(&chunk);
    }
    Ok(bytes)
}

fn broken(error: MultipartError) -> Problem {
    match error.status() {
        StatusCode::PAYLOAD_TOO_LARGE => Problem::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "upload.too_large",
            "The upload is larger than this service takes.",
        ),
        _ => Problem::new(
            StatusCode::BAD_REQUEST,
            "upload.broken",
            format!("The upload broke off or is not multipart/form-data: {}. Send it again.", error.body_text()),
        ),
    }
}
