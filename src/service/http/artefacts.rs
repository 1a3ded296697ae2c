//! What a job made: the list, each file with ranges and entity tags, and the result in the form that is asked for.

use super::jobs::job_of;
use super::problems::TraceId;
use super::range::{self, Asked};
use super::shapes::{Artefact, ArtefactList};
use crate::auth::Principal;
use crate::error::Problem;
use crate::media::{self, FORMS, Form, base64};
use crate::queue::{ArtefactRow, JobRow, JobState};
use crate::state::State;
use axum::Json;
use axum::body::Body;
use axum::extract::{Extension, Path, Query, State as Shared};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(list)).routes(routes!(artefact)).routes(routes!(result))
}

/// Lists the artefacts; empty before the job has succeeded.
#[utoipa::path(get, path = "/v1/jobs/{id}/artefacts", operation_id = "list_artefacts", tag = "results", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job")), responses(
        (status = 200, description = "Artefacts", body = ArtefactList),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")
    ))]
async fn list(
    Shared(state): Shared<State>,
    who: Principal,
    Path(id): Path<String>,
) -> Result<Json<ArtefactList>, Problem> {
    let (id, _) = job_of(&state, &who, &id).await?;
    let rows = state.queue.artefacts(id).await?;
    Ok(Json(ArtefactList { items: rows.into_iter().map(|row| Artefact::new(id, row)).collect(), next: None }))
}

/// Reads an artefact, whole or in part. Its ETag is its digest.
#[utoipa::path(get, path = "/v1/jobs/{id}/artefacts/{name}", operation_id = "read_artefact", tag = "results", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), ("name" = String, Path, description = "Artefact"),
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "ETag seen before")),
    responses(
        (status = 200, description = "The file", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 206, description = "A part of it", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 304, description = "Unchanged"),
        (status = 404, description = "No such job or artefact", body = Problem, content_type = "application/problem+json"),
        (status = 416, description = "No byte of it is in the range", body = Problem, content_type = "application/problem+json")
    ))]
async fn artefact(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path((id, name)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (id, _) = job_of(&state, &who, &id).await?;
    let row = state.queue.artefact(id, &name).await?.ok_or_else(|| Problem::not_found("artefact"))?;
    state.audit(&who, &trace.0, "artefact.read", &format!("{id}/{name}")).await?;
    send(&state, &row, &headers).await
}

/// Which form.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
struct Wanted {
    /// `json`, `glb`, `vtp`, `stl`, `csv` or `html` (or a media type); goes before Accept.
    #[param(
        pattern = "^(json|glb|gltf|vtp|vtk|stl|csv|html|application/json|model/gltf-binary|application/x-vtk[+]xml|model/stl|text/csv|text/html)$"
    )]
    format: Option<String>,
}

/// Reads the result in the form of `?format=` or Accept.
#[utoipa::path(get, path = "/v1/jobs/{id}/result", operation_id = "read_result", tag = "results", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), Wanted), responses(
        (status = 200, description = "The result", content(
            (Object = "application/json"), (Vec<u8> = "model/gltf-binary"), (String = "application/x-vtk+xml"),
            (Vec<u8> = "model/stl"), (String = "text/csv"), (String = "text/html")
        )),
        (status = 404, description = "No such job, or not made by it", body = Problem, content_type = "application/problem+json"),
        (status = 406, description = "No such form; `errors` lists those there are", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The job has no result (yet)", body = Problem, content_type = "application/problem+json")
    ))]
async fn result(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
    Query(wanted): Query<Wanted>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (id, job) = job_of(&state, &who, &id).await?;
    let accept = headers.get(header::ACCEPT).and_then(|v| v.to_str().ok()).unwrap_or("");
    let form = match &wanted.format {
        Some(word) => media::form_of(word),
        None => media::negotiate(accept, FORMS),
    };
    let form = form.ok_or_else(not_acceptable)?;
    if job.state != JobState::Succeeded {
        return Err(no_result(&job));
    }
    let row = state.queue.artefact(id, form.artefact).await?;
    let row = row.ok_or_else(|| Problem::not_found(&format!("artefact {}", form.artefact)))?;
    state.audit(&who, &trace.0, "artefact.read", &format!("{id}/{}", row.name)).await?;
    let mut response = send(&state, &row, &headers).await?;
    response.headers_mut().insert(header::VARY, HeaderValue::from_static("accept"));
    Ok(response)
}

fn not_acceptable() -> Problem {
    let forms = |f: &Form| serde_json::json!({"code": "form", "message": f.media_type, "where": {"format": f.words}});
    let types: Vec<&str> = FORMS.iter().map(|f| f.media_type).collect();
    Problem::new(
        StatusCode::NOT_ACCEPTABLE,
        "not_acceptable",
        format!("The result can be had as {}.", types.join(", ")),
    )
    .with_errors(FORMS.iter().map(forms).collect())
}

fn no_result(job: &JobRow) -> Problem {
    let detail = match job.state {
        JobState::Queued | JobState::Running => {
            format!("The job is {}; its result is there when it has succeeded.", job.state.as_str())
        }
        other => format!("The job is {}; it has no result. GET /v1/jobs/{} says why.", other.as_str(), job.id),
    };
    let problem = Problem::new(StatusCode::CONFLICT, "job.no_result_yet", detail);
    if job.state.is_final() { problem } else { problem.with_header("retry-after", "2") }
}

/// Sends an artefact with its validators, whole or in part.
async fn send(state: &State, row: &ArtefactRow, headers: &HeaderMap) -> Result<Response, Problem> {
    let tag = format!("\"{}\"", row.digest);
    let text = |name: header::HeaderName| headers.get(name).and_then(|v| v.to_str().ok());
    let size = u64::try_from(row.bytes).map_err(Problem::internal)?;
    // If-Range with another tag means that the part would belong to another file.
    let range = text(header::RANGE).filter(|_| text(header::IF_RANGE).is_none_or(|seen| seen == tag));
    let mut response = if text(header::IF_NONE_MATCH).is_some_and(|list| range::matches(list, &tag)) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        match range::asked(range, size) {
            Asked::Whole => body(state, row, 0..size, StatusCode::OK).await?,
            Asked::Part(part) => {
                let told = format!("bytes {}-{}/{size}", part.start, part.end - 1);
                let mut response = body(state, row, part, StatusCode::PARTIAL_CONTENT).await?;
                insert(&mut response, header::CONTENT_RANGE, &told);
                response
            }
            Asked::Unsatisfiable => {
                return Err(Problem::new(
                    StatusCode::RANGE_NOT_SATISFIABLE,
                    "range",
                    format!("The file has {size} bytes; the range begins beyond them."),
                )
                .with_header("content-range", format!("bytes */{size}")));
            }
        }
    };
    insert(&mut response, header::ETAG, &tag);
    insert(&mut response, header::ACCEPT_RANGES, "bytes");
    insert(&mut response, header::CACHE_CONTROL, "private, no-cache");
    if row.media_type.starts_with("text/html") {
        let policy = report_policy(&state.store.bytes(&row.object_key, &row.digest).await?);
        insert(&mut response, header::CONTENT_SECURITY_POLICY, &policy);
    }
    Ok(response)
}

async fn body(
    state: &State,
    row: &ArtefactRow,
    part: std::ops::Range<u64>,
    status: StatusCode,
) -> Result<Response, Problem> {
    let length = part.end - part.start;
    // A whole file is checked against its digest while it is sent; a part cannot be.
    let body = if u64::try_from(row.bytes).is_ok_and(|size| length == size && size > 0) {
        Body::from_stream(state.store.whole(&row.object_key, &row.digest).await?)
    } else {
        Body::from_stream(state.store.stream(&row.object_key, part).await?)
    };
    let mut response = (status, body).into_response();
    insert(&mut response, header::CONTENT_TYPE, &row.media_type);
    insert(&mut response, header::CONTENT_LENGTH, &length.to_string());
    insert(&mut response, header::CONTENT_DISPOSITION, &format!("inline; filename=\"{}\"", row.name));
    Ok(response)
}

fn insert(response: &mut Response, name: header::HeaderName, value: &str) {
    // Values are made of names, digests and numbers; one that is no header is left out.
    if let Ok(value) = HeaderValue::from_str(value) {
        response.headers_mut().insert(name, value);
    }
}

/// The report is one page with its style inside: its own style blocks are allowed by hash, scripts never.
fn report_policy(html: &[u8]) -> String {
    let text = String::from_utf8_lossy(html);
    let mut hashes = String::new();
    let mut rest: &str = &text;
    while let Some((_, after)) = rest.split_once("<style") {
        let Some((style, after)) = after.split_once('>').and_then(|(_, s)| s.split_once("</style>")) else { break };
        hashes.push_str(&format!(" 'sha256-{}'", base64(&Sha256::digest(style.as_bytes()))));
        rest = after;
    }
    let styles = if hashes.is_empty() { " 'none'".to_owned() } else { hashes };
    format!("default-src 'none'; img-src data:; style-src{styles}; frame-ancestors 'none'; sandbox")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_may_use_its_own_style_and_nothing_else() {
        let policy = report_policy(b"<style>a{}</style><p><style media=\"print\">b{}</style>");
        assert_eq!(policy.matches("sha256-").count(), 2);
        assert!(!policy.contains("unsafe"));
        assert!(report_policy(b"<p>").contains("style-src 'none'"));
    }
}
