//! The page, embedded in the binary: no file is read and nothing is fetched from elsewhere at run time.

use super::guard::page_policy;
use crate::state::State;
use crate::store::digest;
use axum::Router;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;

/// Name and bytes of each file of the page, from build.rs.
const FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/portal_files.rs"));

/// Routes of the page: `/`, `/embed` (the same for a frame of `frame_ancestors`) and `/portal/NAME`.
pub(super) fn router(frame_ancestors: &[String]) -> Router<State> {
    let serve = |router: Router<State>, path: &str, (name, bytes): (&str, &'static [u8]), policy: String| {
        let (tag, kind) = (format!("\"{}\"", digest(bytes)), media_type(name));
        router.route(path, get(move |headers: HeaderMap| async move { file(&headers, kind, bytes, &tag, &policy) }))
    };
    FILES.iter().fold(Router::new(), |router, &(name, bytes)| {
        if name != "index.html" {
            return serve(router, &format!("/portal/{name}"), (name, bytes), page_policy(&[]));
        }
        let router = serve(router, "/", (name, bytes), page_policy(&[]));
        serve(router, "/embed", (name, bytes), page_policy(frame_ancestors))
    })
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("json") => "application/json",
        _ => "image/svg+xml",
    }
}

fn file(headers: &HeaderMap, media_type: &'static str, bytes: &'static [u8], tag: &str, policy: &str) -> Response {
    let seen = headers.get(header::IF_NONE_MATCH).and_then(|v| v.to_str().ok());
    let common = [
        (header::CONTENT_TYPE, media_type),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::CACHE_CONTROL, "no-cache"),
        (header::ETAG, tag),
    ];
    if seen.is_some_and(|list| super::range::matches(list, tag)) {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    (common, bytes).into_response()
}
