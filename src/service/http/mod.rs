//! The network face: one router per resource, one layer that makes every error a problem, one place for headers.

mod admin;
mod artefacts;
mod cohort;
mod describe;
mod events;
mod examples;
mod guard;
mod health;
mod jobs;
mod links;
mod listen;
mod multipart;
mod order;
mod plans;
mod portal;
pub(crate) mod problems;
mod range;
mod session;
mod shapes;
mod stats;
mod stow;
mod taking;
mod uploads;
mod webhooks;
mod workers;

pub(crate) use health::disk_free;
pub(crate) use listen::listen;

use crate::state::State;
use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::{from_fn, from_fn_with_state};
use axum::routing::get;
use std::sync::Arc;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::compression::CompressionLayer;
use utoipa::OpenApi as _;
use utoipa_axum::router::OpenApiRouter;

/// Bodies of calls other than an upload, bytes.
const SMALL_BODY: usize = 64 << 10;

#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "Vasculum",
        description = "Reconstructs blood vessels and their bifurcations from stacks of MRI or CT slices. \
                       Every error is an RFC 9457 problem with a stable `code`."
    ),
    components(schemas(crate::error::Problem, crate::cohort::Quantity)),
    modifiers(&Keys),
    tags(
        (name = "jobs", description = "Send a scan, follow it, end it"),
        (name = "dicomweb", description = "Send a series from a PACS or a viewer (STOW-RS)"),
        (name = "results", description = "What a job made"),
        (name = "webhooks", description = "Be told when a job ends"),
        (name = "monitoring", description = "Is it well, and how busy is it"),
        (name = "administration", description = "Keys and retention of a tenant")
    )
)]
struct Document;

/// Adds the API key scheme.
struct Keys;

impl utoipa::Modify for Keys {
    fn modify(&self, api: &mut utoipa::openapi::OpenApi) {
        use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
        let bearer = HttpBuilder::new()
            .scheme(HttpAuthScheme::Bearer)
            .bearer_format("vsk_ API key, or a token (JWT) of the configured identity provider")
            .build();
        let components = api.components.get_or_insert_with(Default::default);
        components.add_security_scheme("key", SecurityScheme::Http(bearer));
    }
}

fn documented() -> OpenApiRouter<State> {
    OpenApiRouter::with_openapi(Document::openapi())
        .merge(jobs::router())
        .merge(order::router())
        .merge(plans::router())
        .merge(links::router())
        .merge(uploads::router())
        .merge(stow::router())
        .merge(events::router())
        .merge(artefacts::router())
        .merge(cohort::router())
        .merge(stats::router())
        .merge(workers::router())
        .merge(webhooks::router())
        .merge(admin::router())
        .merge(session::router())
        .merge(health::router())
}

/// The OpenAPI document of every documented route.
pub(crate) fn openapi() -> utoipa::openapi::OpenApi {
    let mut document = documented().into_openapi();
    describe::complete(&mut document);
    examples::illustrate(&mut document);
    document
}

/// The whole service as one router.
pub(crate) fn router(state: State) -> Router {
    let (api, mut document) = documented().split_for_parts();
    describe::complete(&mut document);
    examples::illustrate(&mut document);
    let document = Arc::new(document);
    let page = portal::router(&state.config.frame_ancestors).layer(CompressionLayer::new());
    let described = Router::new()
        .route("/openapi.json", get(move || async move { axum::Json(Arc::clone(&document)) }))
        .layer(CompressionLayer::new());
    api.merge(page)
        .merge(described)
        .fallback(|| async { crate::error::Problem::not_found("page") })
        .layer(DefaultBodyLimit::max(SMALL_BODY))
        .layer(CatchPanicLayer::custom(|_| {
            use axum::response::IntoResponse as _;
            crate::error::Problem::internal("a handler panicked").into_response()
        }))
        .layer(from_fn(listen::paced))
        .layer(from_fn(guard::plain))
        .layer(from_fn_with_state(state.clone(), guard::host))
        .layer(from_fn_with_state(state.clone(), guard::headers))
        .layer(from_fn_with_state(state.clone(), problems::layer))
        .with_state(state)
}
