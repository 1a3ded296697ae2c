//! The page, embedded in the binary: no file is read and nothing is fetched from elsewhere at run time.

use super::guard::PAGE_POLICY;
use crate::state::State;
use crate::store::digest;
use axum::Router;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;

/// The 3D view, bundled by build.rs (a small stand-in that says so when npm was missing then).
const VIEW3D: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/view3d.js"));

const FILES: &[(&str, &str, &[u8])] = &[
    ("/", "text/html; charset=utf-8", include_bytes!("../portal/index.html")),
    ("/portal/app.js", "text/javascript; charset=utf-8", include_bytes!("../portal/app.js")),
    ("/portal/api.js", "text/javascript; charset=utf-8", include_bytes!("../portal/api.js")),
    ("/portal/job.js", "text/javascript; charset=utf-8", include_bytes!("../portal/job.js")),
    ("/portal/plot.js", "text/javascript; charset=utf-8", include_bytes!("../portal/plot.js")),
    ("/portal/view3d.js", "text/javascript; charset=utf-8", VIEW3D),
    ("/portal/style.css", "text/css; charset=utf-8", include_bytes!("../portal/style.css")),
    ("/portal/icon.svg", "image/svg+xml", include_bytes!("../portal/icon.svg")),
];

/// Routes of the page.
pub(super) fn router() -> Router<State> {
    FILES.iter().fold(Router::new(), |router, (path, media_type, bytes)| {
        let tag = format!("\"{}\"", digest(bytes));
        router.route(path, get(move |headers: HeaderMap| async move { file(&headers, media_type, bytes, &tag) }))
    })
}

fn file(headers: &HeaderMap, media_type: &'static str, bytes: &'static [u8], tag: &str) -> Response {
    let seen = headers.get(header::IF_NONE_MATCH).and_then(|v| v.to_str().ok());
    let common = [
        (header::CONTENT_TYPE, media_type),
        (header::CONTENT_SECURITY_POLICY, PAGE_POLICY),
        (header::CACHE_CONTROL, "no-cache"),
        (header::ETAG, tag),
    ];
    if seen.is_some_and(|list| super::range::matches(list, tag)) {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    (common, bytes).into_response()
}
