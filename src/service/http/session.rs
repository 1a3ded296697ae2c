//! The portal's session: its key as a cookie that scripts cannot read, so that downloads by a link work.

use crate::auth::{COOKIE, known};
use crate::config::Auth;
use crate::error::Problem;
use crate::state::State;
use axum::Json;
use axum::extract::State as Shared;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::Deserialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(read, begin, end))
}

/// A key to keep as a cookie.
#[derive(Deserialize, utoipa::ToSchema)]
struct Session {
    /// `vsk_...`
    key: String,
}

/// Begins a session of the portal: the key becomes a cookie of this origin.
#[utoipa::path(post, path = "/v1/session", operation_id = "begin_session", tag = "jobs", request_body = Session, responses(
    (status = 204, description = "The cookie is set"),
    (status = 401, description = "The key is unknown or revoked", body = Problem, content_type = "application/problem+json"),
    (status = 429, description = "The key has met its rate; see Retry-After", body = Problem, content_type = "application/problem+json")
))]
async fn begin(Shared(state): Shared<State>, Json(session): Json<Session>) -> Result<Response, Problem> {
    if state.config.auth == Auth::Required {
        known(&state, &session.key).await?;
    }
    // Behind our own TLS the cookie never goes over a plain line.
    let secure = if state.config.tls.is_some() { "; Secure" } else { "" };
    Ok(cookie(&format!("{COOKIE}={}; Path=/; HttpOnly; SameSite=Strict{secure}", session.key)))
}

/// Who calls.
#[derive(Debug, serde::Serialize, utoipa::ToSchema)]
struct Whoami {
    /// Whether the service asks for keys at all.
    keys: bool,
    /// The caller's tenant.
    tenant: String,
    /// `upload`, `read`, `admin` or `auditor`.
    role: String,
}

/// Tells who the caller is.
#[utoipa::path(get, path = "/v1/session", operation_id = "read_session", tag = "jobs", security(("key" = [])), responses(
    (status = 200, description = "The caller", body = Whoami)
))]
async fn read(Shared(state): Shared<State>, who: crate::auth::Caller) -> Result<Json<Whoami>, Problem> {
    let who = who.known();
    let keys = state.config.auth == Auth::Required;
    Ok(Json(Whoami { keys, role: who.role.as_str().to_owned(), tenant: who.tenant }))
}

/// Ends the session.
#[utoipa::path(delete, path = "/v1/session", operation_id = "end_session", tag = "jobs", responses((status = 204, description = "The cookie is gone")))]
async fn end() -> Response {
    cookie(&format!("{COOKIE}=; Path=/; HttpOnly; SameSite=Strict; Max-Age=0"))
}

fn cookie(text: &str) -> Response {
    (StatusCode::NO_CONTENT, [(header::SET_COOKIE, text)]).into_response()
}
