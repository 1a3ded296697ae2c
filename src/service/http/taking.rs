//! What `POST /v1/jobs` is given, in its three forms: files in a multipart body, a finished upload, an earlier job's
//! scan with another plan. And the check of it, for those who want to see what would be understood before they send.

use super::jobs::job_of;
use super::multipart::{self, Budget, LARGEST_PLAN};
use super::uploads;
use crate::auth::Principal;
use crate::config::NamedBytes;
use crate::error::Problem;
use crate::intake::intake;
use crate::queue::submit::is_variant;
use crate::queue::{JobRow, JobState};
use crate::state::State;
use axum::body::{Body, to_bytes};
use axum::extract::{FromRequest as _, Multipart, Request};
use axum::http::{HeaderMap, StatusCode, header};
use serde::Deserialize;
use serde_json::Value;
use std::time::Duration;
use tokio::sync::Semaphore;
use uuid::Uuid;

/// A check reads the whole scan in this process: one at a time.
static CHECKS: Semaphore = Semaphore::const_new(1);
/// Longest wait for another check to end.
const CHECK_WAIT: Duration = Duration::from_secs(20);

/// A scan and its plan, de-identified and ready to be stored.
pub(super) struct Taken {
    /// plan.json text; `{}` without one.
    pub plan: String,
    /// Files with harmless names.
    pub files: Vec<NamedBytes>,
    /// The resumable upload that it came by.
    pub upload: Option<Uuid>,
    /// The earlier job whose scan or result it is.
    pub parent: Option<Uuid>,
    /// Memory held until the files are stored.
    pub budget: Budget,
}

/// An upload to make a job of.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct FromUpload {
    /// The last part of the upload's address.
    #[schema(pattern = "^[0-9a-f]{96}$")]
    upload: String,
    /// plan.json.
    #[schema(value_type = Option<Object>)]
    plan: Option<Value>,
}

/// An earlier job whose scan is to be reconstructed again.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct FromJob {
    /// The job; it keeps its own result.
    #[schema(value_type = Uuid)]
    job: String,
    /// plan.json; the earlier job's without. With `variant` the new job changes the medial lines of the earlier one's
    /// result and needs no scan.
    #[schema(value_type = Option<Object>)]
    plan: Option<Value>,
}

/// A JSON body of `POST /v1/jobs`.
#[derive(utoipa::ToSchema)]
#[serde(untagged)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document")]
pub(super) enum Named {
    /// By upload.
    Upload(FromUpload),
    /// By job.
    Job(FromJob),
}

/// Reads a body of any of the three forms.
///
/// # Errors
/// What multipart, uploads, the plan and the intake say; `job.no_input` for a job whose scan is erased.
pub(super) async fn take(state: &State, who: &Principal, request: Request) -> Result<Taken, Problem> {
    if !is_json(request.headers()) {
        let sent = multipart::read(state, form(state, who, request).await?).await?;
        let files = intake(&state.config, sent.files).await?;
        return Ok(Taken { plan: sent.plan, files, upload: None, parent: None, budget: sent.budget });
    }
    let body = json(request.into_body()).await?;
    if body.get("job").is_some() {
        let FromJob { job, plan } = read(body)?;
        let plan = plan_text(state, plan)?;
        let (id, row) = job_of(state, who, &job).await?;
        return of_job(state, id, &row, plan).await;
    }
    let named: FromUpload = read(body)?;
    let plan = plan_text(state, named.plan)?.unwrap_or_else(|| "{}".to_owned());
    let mut budget = Budget::default();
    let (file, id) = uploads::taken(state, who, &named.upload, &mut budget).await?;
    let files = intake(&state.config, vec![file]).await?;
    Ok(Taken { plan, files, upload: Some(id), parent: None, budget })
}

/// A small JSON body.
///
/// # Errors
/// `plan.too_large`, `bad_request`.
pub(super) async fn json(body: Body) -> Result<Value, Problem> {
    let bytes = to_bytes(body, LARGEST_PLAN).await.map_err(|_| {
        let detail = format!("The body is larger than {LARGEST_PLAN} bytes, the most that a plan may have.");
        Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "plan.too_large", detail)
    })?;
    serde_json::from_slice(&bytes).map_err(misread)
}

fn read<T: serde::de::DeserializeOwned>(body: Value) -> Result<T, Problem> {
    serde_json::from_value(body).map_err(misread)
}

fn misread(error: serde_json::Error) -> Problem {
    let detail = format!("Send {{\"upload\": ID, \"plan\": {{...}}}} or {{\"job\": ID, \"plan\": {{...}}}}: {error}.");
    Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "bad_request", detail)
}

fn plan_text(state: &State, plan: Option<Value>) -> Result<Option<String>, Problem> {
    let text = plan.map(|plan| plan.to_string());
    text.as_deref().map_or(Ok(()), |text| (state.config.check_plan)(text.as_bytes()))?;
    Ok(text)
}

/// The scan of an earlier job, as it lies in the store (it was de-identified when it came), or for a variant the sections of
/// its result. Without a plan the earlier job's holds.
///
/// # Errors
/// `job.no_input`, `job.no_result`; the store's.
pub(super) async fn of_job(state: &State, id: Uuid, row: &JobRow, asked: Option<String>) -> Result<Taken, Problem> {
    if let Some(plan) = asked.as_ref().filter(|plan| is_variant(plan)) {
        return variant_of(state, id, plan.clone()).await;
    }
    let plan = asked.unwrap_or_else(|| row.plan.clone());
    if row.state == JobState::Cancelled {
        let detail = "A cancelled job's scan is erased: send the scan again.";
        return Err(Problem::new(StatusCode::CONFLICT, "job.no_input", detail));
    }
    let mut budget = Budget::default();
    budget.grow(state, usize::try_from(row.input_bytes).map_err(Problem::internal)?)?;
    let files = state.store.input(id, &row.input_digest).await?;
    Ok(Taken { plan, files, upload: None, parent: Some(id), budget })
}

/// The artefact from which variants of a result are made.
const SECTIONS: &str = "sections.json";

/// A variant is made from the sections of a finished job, not from its scan.
async fn variant_of(state: &State, job: Uuid, plan: String) -> Result<Taken, Problem> {
    let found = state.queue.artefact(job, SECTIONS).await?.ok_or_else(|| {
        let detail = "A variant is made from the sections.json of a job that has succeeded; this one has none.";
        Problem::new(StatusCode::CONFLICT, "job.no_result", detail)
    })?;
    let mut budget = Budget::default();
    budget.grow(state, usize::try_from(found.bytes).map_err(Problem::internal)?)?;
    let bytes = state.store.bytes(&found.object_key, &found.digest).await?;
    Ok(Taken { plan, files: vec![(SECTIONS.to_owned(), bytes.to_vec())], upload: None, parent: Some(job), budget })
}

/// Whether the body is JSON.
fn is_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    kind.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case("application/json"))
}

/// The multipart body; a Content-Length beyond the limit is refused before a byte is read.
async fn form(state: &State, who: &Principal, request: Request) -> Result<Multipart, Problem> {
    let length = request.headers().get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
    // Boundaries and part headers come on top of the parts' bytes.
    let most = who.max_bytes.unwrap_or(u64::MAX).min(state.config.max_body);
    // A key with a bound of its own must say how much it sends: what is not counted beforehand would be read in vain.
    if length.is_some_and(|n| n > most.saturating_add(1 << 20)) || (length.is_none() && who.max_bytes.is_some()) {
        return Err(Problem::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "upload.too_large",
            format!(
                "The upload is larger than {most} bytes (or does not say its length), the most that this key may send."
            ),
        ));
    }
    Multipart::from_request(request, state).await.map_err(|_| {
        Problem::new(
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "media_type",
            "Send multipart/form-data with parts `input` (files or a zip) and, if wanted, `plan` (JSON).",
        )
    })
}

/// What the configured reader understands of a scan; null without one.
///
/// # Errors
/// The reader's, as a job would fail with; `upload.busy` while others are checked.
pub(super) async fn understood(state: &State, files: Vec<NamedBytes>, plan: String) -> Result<Value, Problem> {
    let Ok(Ok(permit)) = tokio::time::timeout(CHECK_WAIT, CHECKS.acquire()).await else {
        let detail = "Other scans are being checked. Ask again in a moment, or send without a check.";
        let busy = Problem::new(StatusCode::SERVICE_UNAVAILABLE, "upload.busy", detail);
        return Err(busy.with_header("retry-after", "10"));
    };
    let check = state.config.check_scan;
    let understood = tokio::task::spawn_blocking(move || check(files, &plan)).await.map_err(Problem::internal)?;
    drop(permit);
    understood
}
