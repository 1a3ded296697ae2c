//! What an administrator of a tenant sees and sets: its keys, how long results are kept, how many jobs run at once.
//! An admin key rules its own tenant only; other tenants are made on the machine (`vasculum key create --tenant`).

use super::problems::TraceId;
use crate::auth::keys::{self, KeyRow, NewKey};
use crate::auth::{Administrator, Role};
use crate::db::{Scope, args};
use crate::error::Problem;
use crate::media::rfc3339;
use crate::state::State;
use axum::Json;
use axum::extract::{Extension, Path, State as Shared};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Longest label of a key, characters.
const LONGEST_LABEL: usize = 100;
/// Most requests in a minute, bytes of an upload and jobs at the same time that can be asked for: more is no bound.
const MOST_REQUESTS: i64 = 1_000_000;
const MOST_BYTES: i64 = 1_000_000_000_000;
const MOST_RUNNING: i64 = 100_000;
/// Shortest and longest retention, days: a minute and a half, a century.
const KEPT_DAYS: std::ops::RangeInclusive<f64> = 0.001..=36_500.0;
const DAY_MS: f64 = 86_400_000.0;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(list, create)).routes(routes!(revoke)).routes(routes!(tenant, change))
}

/// A body's members: a list in their order, which serde would take for a struct, is refused.
type Members = serde_json::Map<String, serde_json::Value>;

fn read_body<T: serde::de::DeserializeOwned>(body: Members) -> Result<T, Problem> {
    serde_json::from_value(serde_json::Value::Object(body)).map_err(|e| {
        Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "bad_request", format!("The body cannot be understood: {e}."))
    })
}

/// A whole number from 1 to `most`, however JSON writes it (2.0 is 2).
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
fn whole(n: Option<f64>, most: i64) -> Result<Option<i64>, ()> {
    match n {
        Some(n) if n.fract() != 0.0 || !(1.0..=most as f64).contains(&n) => Err(()),
        n => Ok(n.map(|n| n as i64)),
    }
}

/// A key as it is listed: never the key itself.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct KeyShape {
    /// By it the key is revoked; the audit names it.
    id: String,
    /// `upload`, `read`, `admin` or `auditor`.
    role: String,
    /// What it is for.
    label: String,
    /// RFC 3339, UTC.
    created_at: Option<String>,
    /// RFC 3339, UTC; null while it is valid.
    revoked_at: Option<String>,
}

impl From<KeyRow> for KeyShape {
    fn from(row: KeyRow) -> Self {
        Self {
            created_at: rfc3339(row.created_at),
            revoked_at: row.revoked_at.and_then(rfc3339),
            id: row.id,
            role: row.role,
            label: row.label,
        }
    }
}

/// All keys of the tenant.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct KeyList {
    /// Oldest first.
    items: Vec<KeyShape>,
    /// Always null: there are few.
    next: Option<String>,
}

/// A key to make.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct WantedKey {
    /// What it is for.
    #[schema(pattern = "^[^\\u0000-\\u001f\\u007f-\\u009f]{1,100}$")]
    label: String,
    /// `upload`, `read`, `admin` or `auditor`.
    #[schema(pattern = "^(upload|read|admin|auditor)$")]
    role: String,
    /// Requests in a minute; no bound without.
    #[schema(value_type = Option<i64>, minimum = 1, maximum = 1_000_000)]
    requests_per_minute: Option<f64>,
    /// Largest upload, bytes; the service's own bound without.
    #[schema(value_type = Option<i64>, minimum = 1, maximum = 1_000_000_000_000_i64)]
    max_bytes: Option<f64>,
}

/// A new key, shown this once.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct MadeKey {
    /// `vsk_...`; it is not kept and cannot be shown again.
    key: String,
}

/// Lists the tenant's keys (role admin).
#[utoipa::path(get, path = "/v1/keys", operation_id = "list_keys", tag = "administration", security(("key" = [])), responses(
    (status = 200, description = "Keys", body = KeyList)
))]
async fn list(Shared(state): Shared<State>, Administrator(who): Administrator) -> Result<Json<KeyList>, Problem> {
    let rows = keys::list(state.queue.db()).await.map_err(Problem::internal)?;
    let own = rows.into_iter().filter(|key| key.tenant == who.tenant);
    Ok(Json(KeyList { items: own.map(KeyShape::from).collect(), next: None }))
}

/// Makes a key of the tenant (role admin).
#[utoipa::path(post, path = "/v1/keys", operation_id = "create_key", tag = "administration", security(("key" = [])),
    request_body = WantedKey, responses(
        (status = 201, description = "Made: this is the only time that it is shown", body = MadeKey),
        (status = 422, description = "A role that there is not, a label or a bound out of range", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    Administrator(who): Administrator,
    Json(body): Json<Members>,
) -> Result<(StatusCode, Json<MadeKey>), Problem> {
    let wanted: WantedKey = read_body(body)?;
    let odd = |detail: String| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "bad_request", detail);
    let role = Role::of(&wanted.role).ok_or_else(|| odd("The role must be upload, read, admin or auditor.".into()))?;
    if !(1..=LONGEST_LABEL).contains(&wanted.label.chars().count()) || wanted.label.chars().any(char::is_control) {
        return Err(odd(format!("The label must have 1 to {LONGEST_LABEL} characters, none of them a control.")));
    }
    let bound = |n: Option<f64>, most: i64, name: &str| {
        whole(n, most).map_err(|()| odd(format!("{name} must be a whole number from 1 to {most}.")))
    };
    let new = NewKey {
        label: wanted.label,
        role,
        tenant: who.tenant,
        requests_per_minute: bound(wanted.requests_per_minute, MOST_REQUESTS, "requests_per_minute")?,
        max_bytes: bound(wanted.max_bytes, MOST_BYTES, "max_bytes")?,
    };
    let key = keys::create(state.queue.db(), new).await.map_err(Problem::internal)?;
    Ok((StatusCode::CREATED, Json(MadeKey { key })))
}

/// Revokes a key of the tenant at once (role admin).
#[utoipa::path(delete, path = "/v1/keys/{id}", operation_id = "revoke_key", tag = "administration", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Key")), responses(
        (status = 204, description = "Revoked"),
        (status = 404, description = "No such valid key", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It is the key of this call", body = Problem, content_type = "application/problem+json")
    ))]
async fn revoke(
    Shared(state): Shared<State>,
    Administrator(who): Administrator,
    Path(id): Path<String>,
) -> Result<StatusCode, Problem> {
    if id == who.actor {
        let detail = "This call is made with that key. Revoke it with another one.";
        return Err(Problem::new(StatusCode::CONFLICT, "key.in_use", detail));
    }
    let db = state.queue.db();
    let rows = keys::list(db).await.map_err(Problem::internal)?;
    let own = rows.iter().any(|key| key.id == id && key.tenant == who.tenant && key.revoked_at.is_none());
    if !own || !keys::revoke(db, &id).await.map_err(Problem::internal)? {
        return Err(Problem::not_found("valid key"));
    }
    Ok(StatusCode::NO_CONTENT)
}

/// What holds for all jobs of the caller's tenant.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct TenantShape {
    /// Its name.
    id: String,
    /// Jobs that run at the same time; no bound when null.
    max_running: Option<i64>,
    /// Ended jobs are erased after so many days; never when null.
    retention_days: Option<f64>,
}

/// What shall hold.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct TenantWish {
    /// Jobs that run at the same time; no bound when null.
    #[schema(value_type = Option<i64>, minimum = 1, maximum = 100_000)]
    max_running: Option<f64>,
    /// Ended jobs are erased after so many days; never when null.
    #[schema(minimum = 0.001, maximum = 36500.0)]
    retention_days: Option<f64>,
}

/// Reads the caller's tenant (role admin).
#[utoipa::path(get, path = "/v1/tenant", operation_id = "read_tenant", tag = "administration", security(("key" = [])), responses(
    (status = 200, description = "The tenant", body = TenantShape)
))]
async fn tenant(Shared(state): Shared<State>, Administrator(who): Administrator) -> Result<Json<TenantShape>, Problem> {
    Ok(Json(read(&state, who.tenant).await?))
}

async fn read(state: &State, id: String) -> Result<TenantShape, Problem> {
    let sql = "SELECT max_running, retention_ms FROM tenant WHERE id = $1";
    let row = state.queue.db().row(Scope::System, sql, args![&id]).await?;
    let row = row.ok_or_else(|| Problem::not_found("tenant"))?;
    // Milliseconds of a century are exact in f64.
    #[allow(clippy::cast_precision_loss)]
    let retention_days = row.get::<Option<i64>>("retention_ms")?.map(|ms| ms as f64 / DAY_MS);
    Ok(TenantShape { max_running: row.get("max_running")?, retention_days, id })
}

/// Sets both values of the caller's tenant (role admin). Retention holds for jobs that end from now on.
#[utoipa::path(put, path = "/v1/tenant", operation_id = "change_tenant", tag = "administration", security(("key" = [])),
    request_body = TenantWish, responses(
        (status = 200, description = "The tenant", body = TenantShape),
        (status = 422, description = "A value out of range", body = Problem, content_type = "application/problem+json")
    ))]
async fn change(
    Shared(state): Shared<State>,
    Administrator(who): Administrator,
    Extension(trace): Extension<TraceId>,
    Json(body): Json<Members>,
) -> Result<Json<TenantShape>, Problem> {
    let wanted: TenantWish = read_body(body)?;
    let kept = wanted.retention_days.is_none_or(|days| KEPT_DAYS.contains(&days));
    let (Ok(max_running), true) = (whole(wanted.max_running, MOST_RUNNING), kept) else {
        let (least, most) = (KEPT_DAYS.start(), KEPT_DAYS.end());
        let detail = format!("max_running must be 1 to {MOST_RUNNING}, retention_days {least} to {most}.");
        return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "bad_request", detail));
    };
    // A float to integer cast saturates.
    #[allow(clippy::cast_possible_truncation)]
    let retention = wanted.retention_days.map(|days| (days * DAY_MS).round().max(1.0) as i64);
    state.audit(&who, &trace.0, "tenant.change", &who.tenant).await?;
    let sql = "UPDATE tenant SET max_running = $2, retention_ms = $3 WHERE id = $1";
    state.queue.db().run(Scope::System, sql, args![&who.tenant, max_running, retention]).await?;
    Ok(Json(read(&state, who.tenant).await?))
}
