//! RFC 9457 problem details: the one shape in which this service says no.
//!
//! A [`Problem`] carries what the client may read. The internal cause of a fault of our own goes to the log once, at
//! the place where it is turned into a problem, and never into the body. `instance` and `trace_id` are filled in by
//! the layer in [`crate::http::problems`], which also turns the plain answers of axum (404, 405, 413, 415, panics)
//! into this shape, so that no error leaves in another one.

use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use space::{FaultKind, Faulty, Place};

/// Media type of every error body.
pub const PROBLEM_JSON: &str = "application/problem+json";

/// An RFC 9457 problem. `errors` lists single faults, each with `code`, `message` and `where`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Problem {
    /// `urn:vasculum:problem:` followed by the code.
    #[serde(rename = "type", default)]
    pub type_uri: String,
    /// The HTTP status in words.
    #[serde(default)]
    pub title: String,
    /// The HTTP status.
    #[serde(default)]
    pub status: u16,
    /// What is wrong, with numbers, and what to do next.
    #[serde(default)]
    pub detail: String,
    /// The address that was asked for.
    #[serde(default)]
    pub instance: String,
    /// A stable machine code such as `contour.open`.
    #[serde(default)]
    pub code: String,
    /// Find this request in the log by it.
    #[serde(default)]
    pub trace_id: String,
    /// Single faults, each an object with `code`, `message` and `where`.
    #[serde(default)]
    #[schema(value_type = Vec<Object>)]
    pub errors: Vec<Value>,
    /// Headers that belong to the answer, such as `Retry-After`.
    #[serde(skip)]
    pub headers: Vec<(&'static str, String)>,
}

impl Problem {
    /// A problem of `status` with a stable `code` and a sentence for a person.
    pub fn new(status: StatusCode, code: &str, detail: impl Into<String>) -> Self {
        Self {
            type_uri: format!("urn:vasculum:problem:{code}"),
            title: status.canonical_reason().unwrap_or("Error").to_owned(),
            status: status.as_u16(),
            detail: detail.into(),
            instance: String::new(),
            code: code.to_owned(),
            trace_id: String::new(),
            errors: Vec::new(),
            headers: Vec::new(),
        }
    }

    /// A fault of our own: `cause` goes to the log, the client reads only that it was our fault.
    pub fn internal(cause: impl std::fmt::Display) -> Self {
        tracing::error!(cause = %cause, "internal fault");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            "The service met a fault of its own. Try again; if it stays, give the trace_id to the operator.",
        )
    }

    /// The problem of a typed fault of a domain crate: Input 422, Limit 413, Numeric 422, Cancelled 409, Internal 500.
    pub fn from_fault(fault: &dyn Faulty) -> Self {
        let status = match fault.kind() {
            FaultKind::Input | FaultKind::Numeric => StatusCode::UNPROCESSABLE_ENTITY,
            FaultKind::Limit => StatusCode::PAYLOAD_TOO_LARGE,
            FaultKind::Cancelled => StatusCode::CONFLICT,
            FaultKind::Internal => return Self::internal(fault),
        };
        let place = fault.place();
        let single =
            serde_json::json!({"code": fault.code(), "message": fault.to_string(), "where": place_json(&place)});
        Self::new(status, fault.code(), fault.to_string()).with_errors(vec![single])
    }

    /// The same with its single faults.
    #[must_use]
    pub fn with_errors(mut self, errors: Vec<Value>) -> Self {
        self.errors = errors;
        self
    }

    /// The same with a status that has no name in HTTP itself.
    #[must_use]
    pub fn with_status(mut self, status: u16) -> Self {
        self.status = status;
        let named = StatusCode::from_u16(status).ok().and_then(|s| s.canonical_reason());
        named.unwrap_or("Refused").clone_into(&mut self.title);
        self
    }

    /// The same with a header of the answer.
    #[must_use]
    pub fn with_header(mut self, name: &'static str, value: impl Into<String>) -> Self {
        self.headers.push((name, value.into()));
        self
    }

    /// A disk is full: 507, with the time after which it is worth trying again.
    pub fn storage_full(detail: &str) -> Self {
        Self::new(StatusCode::INSUFFICIENT_STORAGE, "storage.full", detail).with_header("retry-after", "60")
    }

    /// No such job, artefact or page, for this tenant.
    pub fn not_found(what: &str) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", format!("There is no such {what}, or it is not yours."))
    }

    /// The body's JSON text.
    pub fn body(&self) -> String {
        // A struct of strings and values cannot fail to serialise; an empty object would still be valid JSON.
        serde_json::to_string(self).unwrap_or_else(|_| "{}".to_owned())
    }
}

/// The `where` object of a fault: only the members that are known.
pub fn place_json(place: &Place) -> Value {
    let mut map = serde_json::Map::new();
    let mut put = |key: &str, value: Value| {
        map.insert(key.to_owned(), value);
    };
    if let Some(file) = &place.file {
        put("file", file.as_str().into());
    }
    if let Some(field) = &place.field {
        put("field", field.as_str().into());
    }
    for (key, value) in [("slice", place.slice), ("contour", place.contour), ("element", place.element)] {
        if let Some(n) = value {
            put(key, n.into());
        }
    }
    if let Some(p) = place.position {
        put("position", serde_json::json!([p.x(), p.y(), p.z()]));
    }
    Value::Object(map)
}

impl std::fmt::Display for Problem {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.code, self.detail)
    }
}

impl std::error::Error for Problem {}

impl From<sqlx::Error> for Problem {
    fn from(error: sqlx::Error) -> Self {
        let text = error.to_string();
        if FULL.iter().any(|words| text.contains(words)) {
            tracing::error!(cause = %text, "database full");
            return Self::storage_full("The disk of the database is full. Nothing was accepted; tell the operator.");
        }
        let away = crate::db::is_away(&error);
        let code = error.as_database_error().and_then(|e| e.code().map(|c| c.into_owned()));
        // Classes 08 and 57 of PostgreSQL: the connection broke, or the server is shutting down or starting.
        if away || code.is_some_and(|c| c.len() == 5 && (c.starts_with("08") || c.starts_with("57"))) {
            tracing::error!(cause = %text, "database away");
            return Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "database.away",
                "The database does not answer at the moment. Nothing was accepted; try again.",
            )
            .with_header("retry-after", "5");
        }
        Self::internal(error)
    }
}

/// What SQLite, PostgreSQL and the operating system say when a disk is full.
const FULL: &[&str] =
    &["database or disk is full", "No space left on device", "disk quota exceeded", "Disk quota exceeded"];

impl From<crate::store::Error> for Problem {
    fn from(error: crate::store::Error) -> Self {
        let text = format!("{:#}", anyhow::Error::new(error));
        if FULL.iter().any(|words| text.contains(words)) {
            tracing::error!(cause = %text, "store full");
            return Self::storage_full("The artefact store is full. Nothing was accepted; tell the operator.");
        }
        if text.starts_with("artefact store:") && !text.contains("not found") {
            tracing::error!(cause = %text, "store away");
            return Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "store.away",
                "The artefact store does not answer at the moment. Nothing was accepted; try again.",
            )
            .with_header("retry-after", "5");
        }
        Self::internal(text)
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = (status, [("content-type", PROBLEM_JSON)], self.body()).into_response();
        for (name, value) in &self.headers {
            if let Ok(value) = HeaderValue::from_str(value) {
                response.headers_mut().insert(HeaderName::from_static(name), value);
            }
        }
        response.extensions_mut().insert(self);
        response
    }
}
