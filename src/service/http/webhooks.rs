//! Webhooks of a tenant.

use super::problems::TraceId;
use crate::auth::Principal;
use crate::error::Problem;
use crate::media::rfc3339;
use crate::state::State;
use crate::webhooks;
use axum::Json;
use axum::extract::{Extension, Path, State as Shared};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(create, list)).routes(routes!(remove))
}

/// A webhook to add.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
struct NewWebhook {
    /// An https address in a public network.
    #[schema(example = "https://portal.example.org/vasculum")]
    url: String,
}

/// A webhook.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Webhook {
    /// UUID v7.
    id: String,
    /// Where messages go.
    url: String,
    /// RFC 3339, UTC.
    created_at: Option<String>,
    /// Signs the messages (Standard Webhooks); told only in the answer that made it.
    #[serde(skip_serializing_if = "Option::is_none")]
    secret: Option<String>,
}

/// Webhooks.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct WebhookList {
    /// Oldest first.
    items: Vec<Webhook>,
    /// Always null: there are few.
    next: Option<String>,
}

/// Adds a webhook: a message for every job that ends, signed as Standard Webhooks says, sent until it arrives.
#[utoipa::path(post, path = "/v1/webhooks", operation_id = "create_webhook", tag = "webhooks", security(("key" = [])),
    request_body = NewWebhook, responses(
        (status = 201, description = "Made; the secret is shown only this once", body = Webhook),
        (status = 409, description = "There are as many as a tenant may have", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The address is refused", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Json(new): Json<NewWebhook>,
) -> Result<Response, Problem> {
    webhooks::target(&state.config, &new.url).await?;
    let secret = webhooks::new_secret().map_err(Problem::internal)?;
    let db = state.queue.db();
    let Some(id) = webhooks::add(db, &who.tenant, &new.url, &secret).await? else {
        let detail =
            format!("There are {} webhooks already, the most of one tenant. Remove one first.", webhooks::MOST);
        return Err(Problem::new(StatusCode::CONFLICT, "webhook.many", detail));
    };
    state.audit(&who, &trace.0, "webhook.create", &id.to_string()).await?;
    let made = webhooks::list(db, &who.tenant).await?.into_iter().find(|row| row.id == id.to_string());
    let made = made.ok_or_else(|| Problem::not_found("webhook"))?;
    let location = format!("/v1/webhooks/{id}");
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(shape(made, Some(secret)))).into_response())
}

fn shape(row: webhooks::WebhookRow, secret: Option<String>) -> Webhook {
    Webhook { created_at: rfc3339(row.created_at), id: row.id, url: row.url, secret }
}

/// Lists the webhooks, without their secrets.
#[utoipa::path(get, path = "/v1/webhooks", operation_id = "list_webhooks", tag = "webhooks", security(("key" = [])), responses(
    (status = 200, description = "Webhooks", body = WebhookList)
))]
async fn list(Shared(state): Shared<State>, who: Principal) -> Result<Json<WebhookList>, Problem> {
    let rows = webhooks::list(state.queue.db(), &who.tenant).await?;
    Ok(Json(WebhookList { items: rows.into_iter().map(|row| shape(row, None)).collect(), next: None }))
}

/// Removes a webhook and the messages that wait for it.
#[utoipa::path(delete, path = "/v1/webhooks/{id}", operation_id = "delete_webhook", tag = "webhooks", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Webhook")), responses(
        (status = 204, description = "Removed"),
        (status = 404, description = "No such webhook", body = Problem, content_type = "application/problem+json")
    ))]
async fn remove(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
) -> Result<StatusCode, Problem> {
    let id = Uuid::parse_str(&id).map_err(|_| Problem::not_found("webhook"))?;
    if !webhooks::remove(state.queue.db(), &who.tenant, id).await? {
        return Err(Problem::not_found("webhook"));
    }
    state.audit(&who, &trace.0, "webhook.erase", &id.to_string()).await?;
    Ok(StatusCode::NO_CONTENT)
}
