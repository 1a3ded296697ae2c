//! Who works, and the audit: what operators and auditors look at.

use crate::audit;
use crate::auth::{Action, Principal};
use crate::error::Problem;
use crate::media::rfc3339;
use crate::state::State;
use axum::Json;
use axum::extract::{Query, State as Shared};
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(workers)).routes(routes!(audit_lines))
}

/// A process that works on jobs.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct WorkerShape {
    /// Its name as a holder of leases.
    id: String,
    /// Machine.
    host: String,
    /// Version of its binary.
    version: String,
    /// Jobs that it can run at the same time.
    slots: i64,
    /// Jobs that it runs.
    busy: i64,
    /// Memory that its jobs may take together, MiB.
    memory_mb: i64,
    /// What stands between its jobs and the network: `namespace, filter`, one of them, or `none`; null before its first job.
    isolation: Option<String>,
    /// RFC 3339, UTC.
    started_at: Option<String>,
    /// RFC 3339, UTC: its last word, at most 10 s ago when it is well.
    seen_at: Option<String>,
}

/// The workers seen within the last minute.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct WorkerList {
    /// By start.
    items: Vec<WorkerShape>,
    /// Always null: there are few.
    next: Option<String>,
}

/// Lists the workers of every machine.
#[utoipa::path(get, path = "/v1/workers", operation_id = "list_workers", tag = "monitoring", security(("key" = [])), responses(
    (status = 200, description = "Workers", body = WorkerList)
))]
async fn workers(Shared(state): Shared<State>, _who: Principal) -> Result<Json<WorkerList>, Problem> {
    let rows = state.queue.workers().await?;
    let shape = |row: crate::queue::WorkerRow| WorkerShape {
        started_at: rfc3339(row.started_at),
        seen_at: rfc3339(row.seen_at),
        id: row.id,
        host: row.host,
        version: row.version,
        slots: row.slots,
        busy: row.busy,
        memory_mb: row.memory_mb,
        isolation: row.isolation,
    };
    Ok(Json(WorkerList { items: rows.into_iter().map(shape).collect(), next: None }))
}

/// Where to begin.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct After {
    /// Only lines after this number (`next` of a page holds it).
    after: Option<i64>,
}

/// A page of the audit.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct AuditList {
    /// FHIR R4 AuditEvent resources of the caller's tenant, oldest first.
    #[schema(value_type = Vec<Object>)]
    items: Vec<serde_json::Value>,
    /// Address of the next page, or null.
    next: Option<String>,
}

/// Reads the audit of the caller's tenant (role auditor or admin).
#[utoipa::path(get, path = "/v1/audit", operation_id = "read_audit", tag = "monitoring", security(("key" = [])), params(After), responses(
    (status = 200, description = "Lines of the audit as FHIR AuditEvent", body = AuditList),
    (status = 403, description = "The role may not read it", body = Problem, content_type = "application/problem+json")
))]
async fn audit_lines(
    Shared(state): Shared<State>,
    who: crate::auth::Caller,
    Query(after): Query<After>,
) -> Result<Json<AuditList>, Problem> {
    let who = who.may(Action::Audit)?;
    let (items, last) = audit::fhir(state.queue.db(), Some(&who.tenant), after.after.unwrap_or(0)).await?;
    let next = (!items.is_empty()).then(|| format!("/v1/audit?after={last}"));
    Ok(Json(AuditList { items, next }))
}
