//! What belongs to a job beside its state: the plan that it follows and its place in the queue.

use super::jobs::{job_of, priority_of};
use super::problems::TraceId;
use super::shapes::Job;
use crate::auth::Principal;
use crate::error::Problem;
use crate::state::State;
use axum::Json;
use axum::extract::{Extension, Path, Query, State as Shared};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::Deserialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(plan)).routes(routes!(prioritise))
}

/// Reads the plan with which a job was sent; `{}` without one.
#[utoipa::path(get, path = "/v1/jobs/{id}/plan", operation_id = "read_plan", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job")), responses(
        (status = 200, description = "plan.json", body = Object, content_type = "application/json"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")
    ))]
async fn plan(Shared(state): Shared<State>, who: Principal, Path(id): Path<String>) -> Result<Response, Problem> {
    let (_, row) = job_of(&state, &who, &id).await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], row.plan).into_response())
}

/// A job's new place.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Place {
    /// -100 to 100; one step is worth a minute of waiting. 0 without.
    #[param(minimum = -100, maximum = 100)]
    priority: Option<i64>,
}

/// Changes the priority of a job that waits.
#[utoipa::path(post, path = "/v1/jobs/{id}/priority", operation_id = "prioritise_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), Place), responses(
        (status = 200, description = "The job", body = Job),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It does not wait any more", body = Problem, content_type = "application/problem+json"),
        (status = 400, description = "A priority out of range", body = Problem, content_type = "application/problem+json")
    ))]
async fn prioritise(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
    Query(place): Query<Place>,
) -> Result<Json<Job>, Problem> {
    let priority = priority_of(place.priority)?;
    let (id, row) = job_of(&state, &who, &id).await?;
    let moved = state.queue.prioritise(&who.tenant, id, priority).await?.ok_or_else(|| {
        let detail = format!("Only a job that waits can be moved; this one is {}.", row.state.as_str());
        Problem::new(StatusCode::CONFLICT, "job.not_queued", detail)
    })?;
    state.audit(&who, &trace.0, "job.prioritise", &moved.id).await?;
    Ok(Json(Job::from(moved)))
}
