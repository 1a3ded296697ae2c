//! Jobs: create, list, read, cancel, retry, erase.

use super::problems::TraceId;
use super::range;
use super::shapes::{Job, JobList};
use super::taking;
use crate::auth::Principal;
use crate::error::Problem;
use crate::queue::submit::LARGEST_PRIORITY;
use crate::queue::{JobRow, JobState, NewJob, Page, Submitted};
use crate::state::State;
use crate::store::Store;
use axum::Json;
use axum::extract::{DefaultBodyLimit, Extension, Path, Query, Request, State as Shared};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::Deserialize;
use std::time::Duration;
use tokio::time::Instant;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Longest long poll, seconds.
const LONGEST_WAIT: u64 = 60;
/// More than a day of waiting is a mistake, not a wish.
const LONGEST_ASKED: u64 = 86_400;
/// Longest page.
const LONGEST_PAGE: i64 = 200;
/// Page without `limit`.
const USUAL_PAGE: i64 = 50;
/// Longest Idempotency-Key, bytes.
const LONGEST_KEY: usize = 255;
/// How long DELETE waits for a running job to end.
const ERASE_WAIT: Duration = Duration::from_secs(5);
/// Between looks at the table while waiting, for changes of other processes.
const POLL: Duration = Duration::from_secs(1);

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new()
        // The parts are counted as they arrive, against the configured size.
        .merge(OpenApiRouter::new().routes(routes!(create)).layer(DefaultBodyLimit::disable()))
        .routes(routes!(list))
        .routes(routes!(read, erase))
        .routes(routes!(cancel))
        .routes(routes!(cancel_all))
        .routes(routes!(retry))
}

/// The id of a path: whatever is not a UUID is no job.
pub(super) fn job_id(text: &str) -> Result<Uuid, Problem> {
    Uuid::parse_str(text).map_err(|_| Problem::not_found("job"))
}

/// The caller's job.
pub(super) async fn job_of(state: &State, who: &Principal, id: &str) -> Result<(Uuid, JobRow), Problem> {
    let id = job_id(id)?;
    let row = state.queue.job(&who.tenant, id).await?.ok_or_else(|| Problem::not_found("job"))?;
    Ok((id, row))
}

/// The parts of an upload.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the multipart body in the OpenAPI document")]
struct SubmitForm {
    /// plan.json.
    #[schema(value_type = Option<Object>)]
    plan: Option<String>,
    /// Files: a zip, DICOM files, one volume, or grey slices with a plan that gives their geometry.
    #[schema(value_type = Vec<String>, format = Binary, min_items = 1)]
    input: Vec<Vec<u8>>,
}

/// How to take the upload.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Taking {
    /// `true`: read and check only; nothing is stored and no job is made.
    validate: Option<bool>,
    /// -100 to 100; one step is worth a minute of waiting. 0 without.
    #[param(minimum = -100, maximum = 100)]
    priority: Option<i64>,
}

/// What a check of an upload found.
#[derive(Debug, serde::Serialize, utoipa::ToSchema)]
struct Checked {
    /// Always true: faults are a problem.
    valid: bool,
    /// What would be stored.
    input: super::shapes::InputShape,
    /// What was understood: `input` (format, slices, rows, columns, spacing, corners), `segmentation` (null where it was
    /// refused, with `refusal` saying why), `warnings`, and `slices` (as slices.json, its `image` a data URI).
    #[schema(value_type = Option<Object>)]
    understood: serde_json::Value,
}

/// A 200 of a sent scan.
#[derive(utoipa::ToSchema)]
#[serde(untagged)]
#[allow(dead_code, reason = "describes the answer in the OpenAPI document")]
enum Taken {
    /// The job.
    Job(Box<Job>),
    /// With `validate`.
    Checked(Checked),
}

/// Sends a scan and makes a job. A 202 is given once the job is durable.
#[utoipa::path(post, path = "/v1/jobs", operation_id = "create_job", tag = "jobs", security(("key" = [])),
    params(Taking,
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, pattern = "^[!-~]+$", description = "The same key with the same input and plan gives the same job"),
        ("Prefer" = Option<String>, Header, description = "`wait=N`: answer when the job has ended, or after N seconds")
    ),
    request_body(content((SubmitForm = "multipart/form-data"), (taking::Named = "application/json"))),
    responses(
        (status = 202, description = "Accepted", body = Job),
        (status = 404, description = "No such upload or job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The upload is not whole yet, or the job's scan is erased", body = Problem, content_type = "application/problem+json"),
        (status = 423, description = "A call is still sending to the upload", body = Problem, content_type = "application/problem+json"),
        (status = 200, description = "Ended within the wait, or the key was used before; with `validate`, what was read", body = Taken),
        (status = 400, description = "The upload is broken", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "A limit was met", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Not multipart/form-data, or files that cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The scan or the plan is at fault", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "No memory for another upload now", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Query(taking): Query<Taking>,
    request: Request,
) -> Result<Response, Problem> {
    let priority = priority_of(taking.priority)?;
    let headers = request.headers().clone();
    let key = idempotency_key(&headers)?;
    let taking::Taken { plan, files, upload: resumable, parent, budget } = taking::take(&state, &who, request).await?;
    let (input, files) =
        tokio::task::spawn_blocking(move || (Store::describe(&files), files)).await.map_err(Problem::internal)?;
    let id = Uuid::now_v7();
    let bytes: u64 = input.files.iter().map(|f| f.bytes).sum();
    if taking.validate == Some(true) {
        let count = i64::try_from(input.files.len()).map_err(Problem::internal)?;
        let bytes = i64::try_from(bytes).map_err(Problem::internal)?;
        let input = super::shapes::InputShape { files: count, bytes, digest: input.digest };
        let understood = taking::understood(&state, files, plan).await?;
        return Ok(Json(Checked { valid: true, input, understood }).into_response());
    }
    let job = NewJob {
        id,
        tenant: who.tenant.clone(),
        priority,
        memory_mb: crate::worker::expected_mb(bytes),
        plan,
        input_digest: input.digest.clone(),
        input_files: i64::try_from(input.files.len()).map_err(Problem::internal)?,
        input_bytes: i64::try_from(bytes).map_err(Problem::internal)?,
        trace_id: trace.0.clone(),
        idempotency_key: key,
        parent,
    };
    let submitted = store_and_submit(&state, &job, &input, files).await;
    drop(budget);
    let (mut row, replayed) = match submitted? {
        Submitted::New(row) => (*row, false),
        Submitted::Replayed(row) => (*row, true),
        Submitted::Mismatch(row) => return Err(mismatch(&row)),
    };
    if !replayed {
        row.sent_by = state.audit_sent(&who, &trace.0, &row.id).await?;
    }
    if let Some(id) = resumable {
        crate::uploads::used(state.queue.db(), &who.tenant, id).await?;
    }
    let waited = preferred_wait(&headers);
    let row = wait(&state, &who, row, waited, |row| row.state.is_final()).await?;
    Ok(accepted(row, waited, replayed))
}

/// A key that belongs to another request.
pub(super) fn mismatch(row: &JobRow) -> Problem {
    Problem::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "idempotency.mismatch",
        format!("This Idempotency-Key was used for another scan or plan (job {}). Take a new key.", row.id),
    )
}

/// A priority within its bounds.
pub(super) fn priority_of(asked: Option<i64>) -> Result<i64, Problem> {
    let priority = asked.unwrap_or(0);
    if (-LARGEST_PRIORITY..=LARGEST_PRIORITY).contains(&priority) {
        return Ok(priority);
    }
    let detail = format!("The priority must be {} to {LARGEST_PRIORITY}.", -LARGEST_PRIORITY);
    Err(Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail))
}

/// The input goes into the store first, so that a committed job never lacks it.
async fn store_and_submit(
    state: &State,
    job: &NewJob,
    input: &crate::store::Input,
    files: Vec<crate::config::NamedBytes>,
) -> Result<Submitted, Problem> {
    if let Err(error) = state.store.put_input(job.id, input, files).await {
        // The sweep takes what a store that fails does not erase.
        let _ = state.store.erase_job(job.id).await;
        return Err(error.into());
    }
    match state.queue.submit(job).await {
        Ok(submitted @ Submitted::New(_)) => Ok(submitted),
        Ok(other) => {
            state.store.erase_job(job.id).await?;
            Ok(other)
        }
        Err(error) => in_doubt(state, job, error).await,
    }
}

/// A commit that answers with an error may have happened all the same: only a job that is certainly not in the table
/// loses its input. When the table cannot be asked, the input stays; the sweep takes it if no row names it.
async fn in_doubt(state: &State, job: &NewJob, error: sqlx::Error) -> Result<Submitted, Problem> {
    match state.queue.job(&job.tenant, job.id).await {
        Ok(Some(row)) => Ok(Submitted::New(row.into())),
        Ok(None) => {
            state.store.erase_job(job.id).await?;
            Err(error.into())
        }
        Err(_) => Err(error.into()),
    }
}

fn accepted(row: JobRow, waited: Option<Duration>, replayed: bool) -> Response {
    let status = if row.state.is_final() || replayed { StatusCode::OK } else { StatusCode::ACCEPTED };
    let location = format!("/v1/jobs/{}", row.id);
    let mut response = (status, [(header::LOCATION, location)], Json(Job::from(row))).into_response();
    let headers = response.headers_mut();
    if status == StatusCode::ACCEPTED {
        headers.insert(header::RETRY_AFTER, header::HeaderValue::from_static("2"));
    }
    if replayed {
        headers.insert("idempotency-replayed", header::HeaderValue::from_static("true"));
    }
    if let Some(value) = waited.and_then(|w| format!("wait={}", w.as_secs()).parse().ok()) {
        headers.insert("preference-applied", value);
    }
    response
}

pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, Problem> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    match value.to_str() {
        Ok(text) if (1..=LONGEST_KEY).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic()) => {
            Ok(Some(text.to_owned()))
        }
        _ => Err(Problem::new(
            StatusCode::BAD_REQUEST,
            "idempotency.key",
            format!("The Idempotency-Key must be 1 to {LONGEST_KEY} visible ASCII characters."),
        )),
    }
}

/// `Prefer: wait=N` (RFC 7240).
fn preferred_wait(headers: &HeaderMap) -> Option<Duration> {
    let prefers = headers.get_all("prefer").iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split([',', ';']));
    let seconds =
        prefers.filter_map(|p| p.trim().strip_prefix("wait=")?.trim_matches('"').parse::<u64>().ok()).next()?;
    Some(Duration::from_secs(seconds.min(LONGEST_WAIT)))
}

/// The job once `done`, or as it stands when the time is over or the service stops.
async fn wait(
    state: &State,
    who: &Principal,
    mut row: JobRow,
    time: Option<Duration>,
    done: impl Fn(&JobRow) -> bool,
) -> Result<JobRow, Problem> {
    let Some(time) = time else { return Ok(row) };
    let id = job_id(&row.id)?;
    let mut changes = state.queue.changes();
    let deadline = Instant::now() + time;
    loop {
        row = state.queue.job(&who.tenant, id).await?.ok_or_else(|| Problem::not_found("job"))?;
        if done(&row) || Instant::now() >= deadline || state.shutdown.is_cancelled() {
            return Ok(row);
        }
        tokio::select! {
            () = changed(&mut changes, id) => {}
            () = tokio::time::sleep_until(deadline.min(Instant::now() + POLL)) => {}
            () = state.shutdown.cancelled() => {}
        }
    }
}

/// Returns when this job may have changed.
pub(super) async fn changed(changes: &mut tokio::sync::broadcast::Receiver<Uuid>, id: Uuid) {
    use tokio::sync::broadcast::error::RecvError;
    loop {
        match changes.recv().await {
            Ok(other) if other != id => {}
            Ok(_) | Err(RecvError::Lagged(_)) => return,
            // The queue is gone: only the caller's own timer can wake it.
            Err(RecvError::Closed) => std::future::pending::<()>().await,
        }
    }
}

/// Which jobs to list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Listing {
    /// Only this state.
    state: Option<JobState>,
    /// Only jobs that take this one's scan or result.
    parent: Option<Uuid>,
    /// Only jobs older than this id (the `next` of a page holds it).
    before: Option<Uuid>,
    /// At most so many, 1 to 200; 50 without.
    #[param(minimum = 1, maximum = 200)]
    limit: Option<i64>,
}

/// Lists jobs, newest first.
#[utoipa::path(get, path = "/v1/jobs", operation_id = "list_jobs", tag = "jobs", security(("key" = [])), params(Listing), responses(
    (status = 200, description = "A page; `Link: rel=next` and `next` lead to the next one", body = JobList),
    (status = 400, description = "The query cannot be understood", body = Problem, content_type = "application/problem+json")
))]
async fn list(
    Shared(state): Shared<State>,
    who: Principal,
    Query(listing): Query<Listing>,
) -> Result<Response, Problem> {
    let limit = listing.limit.unwrap_or(USUAL_PAGE);
    if !(1..=LONGEST_PAGE).contains(&limit) {
        let detail = format!("The limit must be 1 to {LONGEST_PAGE}; it is {limit}.");
        return Err(Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail));
    }
    // One more than asked for tells whether there is a next page.
    let page = Page { state: listing.state, parent: listing.parent, before: listing.before, limit: limit + 1 };
    let mut rows = state.queue.jobs(&who.tenant, &page).await?;
    let more = i64::try_from(rows.len()).unwrap_or(i64::MAX) > limit;
    rows.truncate(usize::try_from(limit).unwrap_or(usize::MAX));
    let next = rows.last().filter(|_| more).map(|last| {
        let state = listing.state.map_or_else(String::new, |s| format!("&state={}", s.as_str()));
        let parent = listing.parent.map_or_else(String::new, |id| format!("&parent={id}"));
        format!("/v1/jobs?before={}&limit={limit}{state}{parent}", last.id)
    });
    let link = next.as_ref().and_then(|next| format!("<{next}>; rel=\"next\"").parse().ok());
    let mut response = Json(JobList { items: rows.into_iter().map(Job::from).collect(), next }).into_response();
    if let Some(link) = link {
        response.headers_mut().insert(header::LINK, link);
    }
    Ok(response)
}

/// How long to wait.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
struct Waiting {
    /// Seconds to wait for the job's end (with If-None-Match: for any change); 60 is the longest that is granted.
    #[param(minimum = 0, maximum = 86400)]
    wait: Option<u64>,
}

/// Reads a job.
#[utoipa::path(get, path = "/v1/jobs/{id}", operation_id = "read_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), Waiting,
        ("If-None-Match" = Option<String>, Header, description = "ETag seen before")),
    responses(
        (status = 200, description = "The job; its ETag changes with every visible change", body = Job),
        (status = 304, description = "Unchanged"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")
    ))]
async fn read(
    Shared(state): Shared<State>,
    who: Principal,
    Path(id): Path<String>,
    Query(waiting): Query<Waiting>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (_, row) = job_of(&state, &who, &id).await?;
    if waiting.wait.is_some_and(|seconds| seconds > LONGEST_ASKED) {
        let detail = format!("wait must be 0 to {LONGEST_ASKED} seconds.");
        return Err(Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail));
    }
    let seen = headers.get(header::IF_NONE_MATCH).and_then(|v| v.to_str().ok());
    let time = waiting.wait.map(|s| Duration::from_secs(s.min(LONGEST_WAIT)));
    let known = |row: &JobRow| seen.is_some_and(|list| range::matches(list, &tag(row)));
    let row = wait(&state, &who, row, time, |row| row.state.is_final() || (seen.is_some() && !known(row))).await?;
    let etag = [(header::ETAG, tag(&row)), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if known(&row) {
        return Ok((StatusCode::NOT_MODIFIED, etag).into_response());
    }
    Ok((etag, Json(Job::from(row))).into_response())
}

fn tag(row: &JobRow) -> String {
    format!("\"{}\"", row.revision)
}

/// Cancels a job. A queued one ends at once, a running one within two seconds; its scan is erased.
#[utoipa::path(post, path = "/v1/jobs/{id}/cancel", operation_id = "cancel_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job")), responses(
        (status = 200, description = "Cancelled", body = Job),
        (status = 202, description = "The worker was told", body = Job),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It has ended already", body = Problem, content_type = "application/problem+json")
    ))]
async fn cancel(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
) -> Result<Response, Problem> {
    let id = job_id(&id)?;
    let row = state.queue.cancel(&who.tenant, id).await?.ok_or_else(|| Problem::not_found("job"))?;
    state.audit(&who, &trace.0, "job.cancel", &id.to_string()).await?;
    match row.state {
        JobState::Cancelled => {
            state.forget(id).await;
            Ok(Json(Job::from(row)).into_response())
        }
        JobState::Succeeded | JobState::Failed => Err(Problem::new(
            StatusCode::CONFLICT,
            "job.finished",
            format!("The job has {} already; there is nothing to cancel. DELETE erases it.", row.state.as_str()),
        )),
        JobState::Queued | JobState::Running => Ok((StatusCode::ACCEPTED, Json(Job::from(row))).into_response()),
    }
}

/// Which jobs to cancel.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Filter {
    /// `queued` or `running`; both without.
    state: Option<JobState>,
    /// Only jobs created before this time (RFC 3339).
    #[param(format = DateTime)]
    created_before: Option<String>,
}

/// What a bulk cancel did.
#[derive(Debug, serde::Serialize, utoipa::ToSchema)]
struct CancelledAll {
    /// Jobs that are cancelled or whose workers were told.
    cancelled: usize,
}

/// Cancels every job that the filter names.
#[utoipa::path(post, path = "/v1/jobs/cancel", operation_id = "cancel_jobs", tag = "jobs", security(("key" = [])),
    params(Filter), responses(
        (status = 200, description = "Cancelled, or told their workers", body = CancelledAll),
        (status = 400, description = "The filter cannot be understood", body = Problem, content_type = "application/problem+json")
    ))]
async fn cancel_all(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Query(filter): Query<Filter>,
) -> Result<Json<CancelledAll>, Problem> {
    let before = match &filter.created_before {
        None => None,
        Some(text) => Some(crate::media::ms_of(text).ok_or_else(|| {
            let detail = "created_before must be a time of RFC 3339 such as 2026-11-24T20:00:00Z.";
            Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail)
        })?),
    };
    let ids = state.queue.cancel_all(&who.tenant, filter.state, before).await?;
    let mut is_there = true;
    for id in &ids {
        state.audit(&who, &trace.0, "job.cancel", &id.to_string()).await?;
        // A running one is erased by its worker. A store that does not answer is not waited for again.
        if is_there && state.queue.is_known(*id).await? == Some(JobState::Cancelled) {
            is_there = state.forget(*id).await;
        }
    }
    Ok(Json(CancelledAll { cancelled: ids.len() }))
}

/// Puts a failed job back into the queue with all its attempts.
#[utoipa::path(post, path = "/v1/jobs/{id}/retry", operation_id = "retry_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job")), responses(
        (status = 202, description = "Queued again", body = Job),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It has not failed", body = Problem, content_type = "application/problem+json")
    ))]
async fn retry(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
) -> Result<Response, Problem> {
    let (id, row) = job_of(&state, &who, &id).await?;
    match state.queue.retry(&who.tenant, id).await? {
        Some(row) => {
            state.audit(&who, &trace.0, "job.retry", &row.id).await?;
            Ok((StatusCode::ACCEPTED, Json(Job::from(row))).into_response())
        }
        None => Err(Problem::new(
            StatusCode::CONFLICT,
            "job.not_failed",
            format!(
                "Only a failed job can be retried; this one is {}. A cancelled job's scan is erased: send it again.",
                row.state.as_str()
            ),
        )),
    }
}

/// Erases a job with its scan, events and artefacts; a running one is cancelled first.
#[utoipa::path(delete, path = "/v1/jobs/{id}", operation_id = "erase_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job")), responses(
        (status = 204, description = "Erased"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")
    ))]
async fn erase(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
) -> Result<StatusCode, Problem> {
    let (id, row) = job_of(&state, &who, &id).await?;
    if !row.state.is_final() {
        let row = state.queue.cancel(&who.tenant, id).await?.ok_or_else(|| Problem::not_found("job"))?;
        // A worker that does not answer loses its lease with the row and drops its files by itself.
        wait(&state, &who, row, Some(ERASE_WAIT), |row| row.state.is_final()).await?;
    }
    // The tombstone comes first: an erasure that nobody can account for must not happen.
    state.audit(&who, &trace.0, "job.erase", &id.to_string()).await?;
    state.queue.erase(&who.tenant, id).await?;
    state.store.erase_job(id).await?;
    Ok(StatusCode::NO_CONTENT)
}
