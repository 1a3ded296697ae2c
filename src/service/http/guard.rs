//! Security headers on every answer, and the Host check of a service without keys.

use crate::config::Auth;
use crate::error::Problem;
use crate::state::State;
use axum::extract::{Request, State as Shared};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};

/// Everything from this origin only, nothing inline.
const PAGE_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; \
    connect-src 'self' blob:; base-uri 'none'; form-action 'self'; frame-ancestors";
/// For answers that are not pages.
const DATA_POLICY: &str = "default-src 'none'; frame-ancestors 'none'; sandbox";

/// The policy of a page that these origins may show in a frame.
pub(super) fn page_policy(frame_ancestors: &[String]) -> String {
    match frame_ancestors {
        [] => format!("{PAGE_POLICY} 'none'"),
        some => format!("{PAGE_POLICY} {}", some.join(" ")),
    }
}

/// Adds what a browser needs to know; a handler's own policy stands.
pub(super) async fn headers(Shared(state): Shared<State>, request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    headers.entry(header::CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static(DATA_POLICY));
    headers.entry(header::CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    if state.config.tls.is_some() {
        headers.insert(header::STRICT_TRANSPORT_SECURITY, HeaderValue::from_static("max-age=31536000"));
    }
    for (name, value) in [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// A body is taken as it is: what inflates on the way in is decided by `artefact`'s limits alone (CVE-2026-5438).
pub(super) async fn plain(request: Request, next: Next) -> Response {
    let coded = request
        .headers()
        .get(header::CONTENT_ENCODING)
        .is_some_and(|v| !v.as_bytes().eq_ignore_ascii_case(b"identity"));
    if coded {
        return Problem::new(
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "content_encoding",
            "Send the body without Content-Encoding; a zip or a .nii.gz file is opened here.",
        )
        .with_header("accept-encoding", "identity")
        .into_response();
    }
    next.run(request).await
}

/// Without keys, only a Host that names this loopback listener is served: a page of a foreign name that resolves to
/// 127.0.0.1 (DNS rebinding) sends its own name here.
pub(super) async fn host(Shared(state): Shared<State>, request: Request, next: Next) -> Response {
    if state.config.auth == Auth::None {
        let named = request.headers().get(header::HOST).and_then(|v| v.to_str().ok());
        let named = named.or_else(|| request.uri().authority().map(|a| a.as_str()));
        if !named.is_some_and(|host| names_loopback(host, state.address.port())) {
            return Problem::new(
                StatusCode::MISDIRECTED_REQUEST,
                "host.refused",
                format!(
                    "Without keys this service answers only as localhost:{0} or 127.0.0.1:{0}.",
                    state.address.port()
                ),
            )
            .into_response();
        }
    }
    next.run(request).await
}

fn names_loopback(host: &str, port: u16) -> bool {
    let (name, sent) = match host.rsplit_once(':') {
        Some((name, digits)) if !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit()) => {
            (name, digits.parse().ok())
        }
        _ => (host, Some(80)),
    };
    sent == Some(port) && (name.eq_ignore_ascii_case("localhost") || name == "127.0.0.1" || name == "[::1]")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_loopback_names_with_the_port_pass() {
        for good in ["localhost:81", "127.0.0.1:81", "[::1]:81", "LOCALHOST:81"] {
            assert!(names_loopback(good, 81), "{good}");
        }
        for bad in
            ["evil.example:81", "localhost", "localhost:82", "localhost.evil.example:81", "", "[::1]", "127.0.0.1:"]
        {
            assert!(!names_loopback(bad, 81), "{bad}");
        }
    }
}
