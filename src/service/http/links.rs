//! Short-lived links to a result, for another page's frame.

use super::jobs::job_of;
use super::problems::TraceId;
use crate::auth::{Principal, links};
use crate::config::Auth;
use crate::error::Problem;
use crate::media::rfc3339;
use crate::state::State;
use axum::Json;
use axum::extract::{Extension, Path, Query, State as Shared};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Life of a link without `seconds`.
const USUAL: u64 = 3600;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(create))
}

/// How long the link lives.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Life {
    /// Seconds, 1 to 86400; 3600 without.
    #[param(minimum = 1, maximum = 86400)]
    seconds: Option<u64>,
}

/// A link.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Link {
    /// Address of the result's view on this service, for a frame. Whoever has it sees the result until it ends.
    url: String,
    /// The same as a token: `Authorization: Bearer vsl_...` reads this job. Null for a service without keys.
    token: Option<String>,
    /// RFC 3339, UTC; null for a service without keys.
    expires_at: Option<String>,
}

/// Makes a link that shows this job's result for a short time, without a key.
#[utoipa::path(post, path = "/v1/jobs/{id}/links", operation_id = "create_link", tag = "results", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), Life), responses(
        (status = 201, description = "Made", body = Link),
        (status = 400, description = "A life out of range", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "Only a caller with an API key can make links", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
    Query(life): Query<Life>,
) -> Result<(StatusCode, Json<Link>), Problem> {
    let seconds = life.seconds.unwrap_or(USUAL);
    if !(1..=links::LONGEST).contains(&seconds) {
        let detail = format!("seconds must be 1 to {}.", links::LONGEST);
        return Err(Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail));
    }
    let (id, _) = job_of(&state, &who, &id).await?;
    let place = format!("/embed#/jobs/{id}");
    if state.config.auth == Auth::None {
        return Ok((StatusCode::CREATED, Json(Link { url: place, token: None, expires_at: None })));
    }
    let Some((token, expires)) = links::sign(state.queue.db(), &who, id, seconds).await? else {
        let detail = "Links are signed by an API key: make this call with one.";
        return Err(Problem::new(StatusCode::CONFLICT, "link.key", detail));
    };
    state.audit(&who, &trace.0, "link.create", &id.to_string()).await?;
    let expires_at = i64::try_from(expires).ok().and_then(|s| rfc3339(s.saturating_mul(1000)));
    // In the fragment, which no server and no log ever sees.
    Ok((StatusCode::CREATED, Json(Link { url: format!("{place}?link={token}"), token: Some(token), expires_at })))
}
