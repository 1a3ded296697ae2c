//! The outermost layer: trace id, span, metrics, and every error as a problem with `instance` and `trace_id`.

use crate::error::Problem;
use crate::state::State;
use crate::telemetry;
use crate::traces::{Parent, random};
use axum::body::{Body, to_bytes};
use axum::extract::{MatchedPath, Request, State as Shared};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use std::time::{Instant, SystemTime};
use tracing::Instrument as _;

/// The answer's header with the trace id.
pub(crate) const TRACE_HEADER: HeaderName = HeaderName::from_static("x-trace-id");
/// Longest plain error text kept, bytes.
const LONGEST_TEXT: usize = 4096;

/// Trace id of a request, 32 hex digits; an extension of the request.
#[derive(Clone, Debug)]
pub(crate) struct TraceId(pub String);

/// Marks an answer of an error's status whose body is what its standard says, and no problem.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Whole;

/// The layer.
pub(crate) async fn layer(Shared(state): Shared<State>, mut request: Request, next: Next) -> Response {
    let (begun, at) = (Instant::now(), SystemTime::now());
    let parent = trace_of(request.headers());
    let trace = parent.trace.clone();
    let path = request.uri().path().to_owned();
    let method = request.method().clone();
    let route = request.extensions().get::<MatchedPath>().map_or("other", |m| m.as_str()).to_owned();
    request.extensions_mut().insert(TraceId(trace.clone()));
    let span = tracing::info_span!("request", %method, route = %route, trace_id = %trace);
    let mut response = next.run(request).instrument(span).await;
    let failed = response.status().is_client_error() || response.status().is_server_error();
    if failed && response.extensions_mut().remove::<Whole>().is_none() {
        response = told(response, &path, &trace).await;
    }
    if let Ok(value) = HeaderValue::from_str(&trace) {
        response.headers_mut().insert(TRACE_HEADER, value);
    }
    state.traces.request(&parent, at, method.as_str(), &route, response.status().as_u16());
    let status = response.status().as_u16().to_string();
    metrics::counter!(telemetry::REQUESTS, "method" => method.to_string(), "route" => route.clone(), "status" => status)
        .increment(1);
    metrics::histogram!(telemetry::DURATION, "route" => route).record(begun.elapsed().as_secs_f64());
    response
}

/// The trace of a W3C `traceparent`, or one of its own.
fn trace_of(headers: &HeaderMap) -> Parent {
    let sent = headers.get("traceparent").and_then(|v| v.to_str().ok()).and_then(Parent::of);
    // Without random bytes the trace is all zeros: a request is not refused for that.
    sent.unwrap_or_else(|| Parent { trace: random::<16>(), span: String::new(), sampled: true })
}

/// The response as a problem, its own headers kept.
async fn told(response: Response, path: &str, trace: &str) -> Response {
    let (mut parts, body) = response.into_parts();
    let mut problem = match parts.extensions.remove::<Problem>() {
        Some(problem) => problem,
        None => plain(parts.status, body).await,
    };
    path.clone_into(&mut problem.instance);
    trace.clone_into(&mut problem.trace_id);
    let mut told = problem.into_response();
    for name in [header::ALLOW, header::CONTENT_RANGE, header::WWW_AUTHENTICATE] {
        if let Some(value) = parts.headers.remove(&name) {
            told.headers_mut().insert(name, value);
        }
    }
    told
}

/// A problem of an answer that the framework gave as plain text.
async fn plain(status: StatusCode, body: Body) -> Problem {
    let text = to_bytes(body, LONGEST_TEXT).await.unwrap_or_default();
    let said = String::from_utf8_lossy(&text);
    let (code, detail) = match status {
        StatusCode::NOT_FOUND => ("not_found", "There is nothing at this address. See /openapi.json."),
        StatusCode::METHOD_NOT_ALLOWED => ("method", "This address does not take that method. See the Allow header."),
        StatusCode::PAYLOAD_TOO_LARGE => ("too_large", "The body is larger than this call takes."),
        StatusCode::UNSUPPORTED_MEDIA_TYPE => ("media_type", "This call does not take that Content-Type."),
        StatusCode::NOT_ACCEPTABLE => ("not_acceptable", "Nothing here fits the Accept header."),
        s if s.is_server_error() => ("internal", "The service met a fault of its own."),
        _ => ("bad_request", "The request cannot be understood."),
    };
    let detail =
        if said.is_empty() || status.is_server_error() { detail.to_owned() } else { format!("{detail} {said}") };
    Problem::new(status, code, detail)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trace_of_the_caller_is_kept_and_nonsense_is_not() {
        let mut headers = HeaderMap::new();
        let id = "4bf92f3577b34da6a3ce929d0e0e4736";
        headers.insert("traceparent", format!("00-{id}-00f067aa0ba902b7-01").parse().unwrap());
        assert_eq!(trace_of(&headers).trace, id);
        headers.insert("traceparent", "00-<script>-x-01".parse().unwrap());
        assert_eq!(trace_of(&headers).trace.len(), 32);
    }
}
