//! Is it alive, is it ready, what is it: calls without a key, for monitors.

use crate::config::Auth;
use crate::db::Scope;
use crate::error::Problem;
use crate::state::State;
use crate::telemetry;
use axum::Json;
use axum::extract::State as Shared;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::Serialize;
use std::time::Duration;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// A part that takes longer does not count as well.
const PATIENCE: Duration = Duration::from_secs(2);

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new()
        .routes(routes!(healthz))
        .routes(routes!(readyz))
        .routes(routes!(metrics))
        .routes(routes!(version))
}

/// Says that the process answers.
#[utoipa::path(get, path = "/healthz", tag = "monitoring", responses(
    (status = 200, description = "Alive", content_type = "text/plain", body = String)
))]
async fn healthz() -> &'static str {
    "ok\n"
}

/// State of each part: `ok` or what is wrong.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Ready {
    /// The job table reads and writes.
    database: String,
    /// The artefact store takes an object.
    store: String,
    /// The data folder's disk has room.
    disk: String,
}

/// Tries database, store and disk for real.
#[utoipa::path(get, path = "/readyz", tag = "monitoring", responses(
    (status = 200, description = "Ready", body = Ready),
    (status = 503, description = "Not ready; `errors` says which part", body = Problem, content_type = "application/problem+json")
))]
async fn readyz(Shared(state): Shared<State>) -> Result<Json<Ready>, Problem> {
    let database = async {
        // Takes and gives back a write: a full disk or a read-only file shows here, and the readers answer too.
        state.queue.db().run(Scope::System, "DELETE FROM tenant WHERE id = ''", Vec::new()).await?;
        state.queue.db().row(Scope::System, "SELECT id FROM tenant LIMIT 1", Vec::new()).await
    };
    let database = tokio::time::timeout(PATIENCE, database).await;
    let store = tokio::time::timeout(PATIENCE, state.store.probe()).await;
    let free = disk_free(&state);
    let ready = Ready {
        database: if matches!(database, Ok(Ok(_))) { ok() } else { "the database does not take writes".to_owned() },
        store: if matches!(store, Ok(Ok(()))) { ok() } else { "the artefact store does not take writes".to_owned() },
        disk: if free >= state.config.min_free_disk { ok() } else { format!("only {free} bytes are free") },
    };
    let faults: Vec<_> = [("database", &ready.database), ("store", &ready.store), ("disk", &ready.disk)]
        .into_iter()
        .filter(|(_, said)| *said != "ok")
        .map(|(part, said)| serde_json::json!({"code": format!("ready.{part}"), "message": said, "where": {}}))
        .collect();
    if faults.is_empty() {
        return Ok(Json(ready));
    }
    Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "not_ready", "A part of the service is not well; see errors.")
        .with_errors(faults)
        .with_header("retry-after", "5"))
}

fn ok() -> String {
    "ok".to_owned()
}

/// Free space of the data folder's disk, bytes; 0 when it cannot be told.
pub(crate) fn disk_free(state: &State) -> u64 {
    rustix::fs::statvfs(&state.config.data_dir).map_or(0, |fs| fs.f_bavail.saturating_mul(fs.f_frsize))
}

/// Prometheus text.
#[utoipa::path(get, path = "/metrics", tag = "monitoring", responses(
    (status = 200, description = "Metrics, without anything of a patient", content_type = "text/plain", body = String)
))]
async fn metrics(Shared(state): Shared<State>) -> Result<Response, Problem> {
    let text = telemetry::scrape(&state).await?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

/// Name, version, and whether callers need a key.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Version {
    name: &'static str,
    version: &'static str,
    /// Whether the service asks for keys at all.
    keys: bool,
}

/// Says what runs here.
#[utoipa::path(get, path = "/version", tag = "monitoring", responses(
    (status = 200, description = "Version", body = Version)
))]
async fn version(Shared(state): Shared<State>) -> Json<Version> {
    let keys = state.config.auth == Auth::Required;
    Json(Version { name: "vasculum", version: env!("CARGO_PKG_VERSION"), keys })
}
