//! Several plans on one job's scan or result: a series of variants, other roles, other settings, each a job of its own.
//!
//! A call of its own and not a form of `POST /v1/jobs`: its answer is a list, and a client that is generated from the
//! document should know beforehand which of the two it gets.

use super::jobs::{idempotency_key, job_of, mismatch, priority_of};
use super::multipart::LARGEST_PLAN;
use super::problems::TraceId;
use super::shapes::{Job, JobList};
use super::taking;
use crate::auth::Principal;
use crate::error::Problem;
use crate::queue::{JobRow, MOST_TOGETHER, NewJob, Several};
use crate::state::State;
use crate::store::Store;
use axum::Json;
use axum::extract::{DefaultBodyLimit, Extension, Path, Query, Request, State as Shared};
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use serde::Deserialize;
use serde_json::{Value, json};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(create)).layer(DefaultBodyLimit::max(LARGEST_PLAN))
}

/// What is to be made of the job.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct Plans {
    /// One plan.json for each new job, at most 100. A plan with `variant` changes the medial lines of the job's result; any
    /// other one reconstructs its scan again.
    #[schema(value_type = Vec<Object>, min_items = 1, max_items = 100)]
    plans: Vec<Value>,
}

/// How to take them.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Taking {
    /// -100 to 100, for all; one step is worth a minute of waiting. 0 without.
    #[param(minimum = -100, maximum = 100)]
    priority: Option<i64>,
}

/// Makes one job of each plan, on the scan or (variants) on the result of a job. All of them are accepted, or none.
#[utoipa::path(post, path = "/v1/jobs/{id}/plans", operation_id = "create_jobs", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job; it keeps its own result"), Taking,
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, pattern = "^[!-~]+$", description = "The same key with the same plans gives the same jobs")),
    request_body(content((Plans = "application/json"))),
    responses(
        (status = 202, description = "Accepted, all of them, in the order of the plans", body = JobList),
        (status = 200, description = "The key was used before: the jobs that it made", body = JobList),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The job has no result to change, or its scan is erased", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "Too many plans, or too much to copy", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Plans are at fault; `errors` names each with its number", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
    Query(taking): Query<Taking>,
    request: Request,
) -> Result<Response, Problem> {
    let priority = priority_of(taking.priority)?;
    let key = idempotency_key(request.headers())?;
    let (parent, row) = job_of(&state, &who, &id).await?;
    let plans = plans(&state, taking::json(request.into_body()).await?)?;
    let mut jobs = Vec::new();
    let stored = stored(&state, &who, parent, &row, plans, &mut jobs).await;
    for job in &mut jobs {
        (job.priority, job.trace_id, job.idempotency_key) = (priority, trace.0.clone(), key.clone());
    }
    if let Err(problem) = stored {
        dropped(&state, &jobs).await;
        return Err(problem);
    }
    let (rows, is_new) = match submitted(&state, &jobs).await? {
        Several::New(rows) => (rows, true),
        Several::Replayed(rows) => (rows, false),
        Several::Mismatch(row) => return Err(mismatch(&row)),
    };
    let mut items = Vec::new();
    for mut row in rows {
        if is_new {
            row.sent_by = state.audit_sent(&who, &trace.0, &row.id).await?;
        }
        items.push(Job::from(row));
    }
    let told = Json(JobList { items, next: None });
    if is_new {
        return Ok((StatusCode::ACCEPTED, [("retry-after", "2")], told).into_response());
    }
    Ok((StatusCode::OK, [("idempotency-replayed", "true")], told).into_response())
}

/// The plans as texts, each checked; the faults of all of them together.
fn plans(state: &State, body: Value) -> Result<Vec<String>, Problem> {
    let told = |e: serde_json::Error| {
        let detail = format!("Send {{\"plans\": [{{...}}, ...]}}: {e}.");
        Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "bad_request", detail)
    };
    let Plans { plans } = serde_json::from_value(body).map_err(told)?;
    if plans.is_empty() || plans.len() > MOST_TOGETHER {
        let detail = format!("One call takes 1 to {MOST_TOGETHER} plans; there are {}.", plans.len());
        let status = if plans.is_empty() { StatusCode::UNPROCESSABLE_ENTITY } else { StatusCode::PAYLOAD_TOO_LARGE };
        return Err(Problem::new(status, "plans.number", detail));
    }
    let texts: Vec<String> = plans.iter().map(Value::to_string).collect();
    let (mut first, mut errors) = (None, Vec::new());
    for (k, text) in texts.iter().enumerate() {
        let Err(problem) = (state.config.check_plan)(text.as_bytes()) else { continue };
        let whole = json!({"code": problem.code, "message": problem.detail, "where": {}});
        let faults = if problem.errors.is_empty() { vec![whole] } else { problem.errors.clone() };
        errors.extend(faults.into_iter().map(|mut fault| {
            let field = fault["where"]["field"].as_str().map_or(String::new(), |field| format!(".{field}"));
            fault["where"] = json!({"field": format!("plans[{k}]{field}")});
            fault
        }));
        first.get_or_insert((k, problem));
    }
    match first {
        None => Ok(texts),
        Some((k, problem)) => {
            let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::UNPROCESSABLE_ENTITY);
            let detail = format!("plans[{k}]: {}", problem.detail);
            Err(Problem::new(status, &problem.code, detail).with_errors(errors))
        }
    }
}

/// Puts the input of each plan into the store, one after the other, and tells the jobs to be accepted in `jobs`.
async fn stored(
    state: &State,
    who: &Principal,
    parent: Uuid,
    row: &JobRow,
    plans: Vec<String>,
    jobs: &mut Vec<NewJob>,
) -> Result<(), Problem> {
    let count = plans.len() as u64;
    for plan in plans {
        let taking::Taken { plan, files, budget, .. } = taking::of_job(state, parent, row, Some(plan)).await?;
        let (input, files) =
            tokio::task::spawn_blocking(move || (Store::describe(&files), files)).await.map_err(Problem::internal)?;
        let bytes = input.bytes();
        // Each job keeps a copy of its own, so that erasing one takes nothing from the others.
        if bytes.saturating_mul(count) > state.config.max_body {
            let detail = format!(
                "{count} jobs would keep {count} times {bytes} bytes, more than the {} that one call may bring; send \
                 fewer plans in one call.",
                state.config.max_body
            );
            return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "plans.too_large", detail));
        }
        let id = Uuid::now_v7();
        jobs.push(NewJob {
            id,
            tenant: who.tenant.clone(),
            priority: 0,
            memory_mb: crate::worker::expected_mb(bytes),
            plan,
            input_digest: input.digest.clone(),
            input_files: i64::try_from(input.files.len()).map_err(Problem::internal)?,
            input_bytes: i64::try_from(bytes).map_err(Problem::internal)?,
            trace_id: String::new(),
            idempotency_key: None,
            parent: Some(parent),
        });
        state.store.put_input(id, &input, files).await?;
        drop(budget);
    }
    Ok(())
}

/// The sweep takes what a store that fails does not erase.
async fn dropped(state: &State, jobs: &[NewJob]) {
    for job in jobs {
        let _ = state.store.erase_job(job.id).await;
    }
}

async fn submitted(state: &State, jobs: &[NewJob]) -> Result<Several, Problem> {
    let outcome = state.queue.submit_together(jobs).await;
    match outcome {
        Ok(new @ Several::New(_)) => Ok(new),
        Ok(other) => {
            dropped(state, jobs).await;
            Ok(other)
        }
        Err(error) => in_doubt(state, jobs, error).await,
    }
}

/// A commit that answers with an error may have happened all the same: see `jobs::in_doubt`. The first job tells of all.
async fn in_doubt(state: &State, jobs: &[NewJob], error: sqlx::Error) -> Result<Several, Problem> {
    let Some(first) = jobs.first() else { return Err(error.into()) };
    match state.queue.job(&first.tenant, first.id).await {
        Ok(Some(_)) => {
            let mut rows = Vec::new();
            for job in jobs {
                rows.extend(state.queue.job(&job.tenant, job.id).await?);
            }
            Ok(Several::New(rows))
        }
        Ok(None) => {
            dropped(state, jobs).await;
            Err(error.into())
        }
        Err(_) => Err(error.into()),
    }
}
