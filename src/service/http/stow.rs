//! STOW-RS (DICOM PS3.18, 10.5): a PACS or a viewer sends the instances of a series, and the series becomes a job.
//!
//! Senders cut a series into requests as they like (Orthanc: 10 instances each), so a request is no job: the first one of
//! a series makes it, each further one adds to it, and it begins when nothing more has come for
//! [`crate::Config::stow_quiet_seconds`] (docs/adr/0067). Instances are de-identified in memory one by one; what is
//! refused is named in FailedSOPSequence and the rest is taken. A file is named by a digest of its SOPInstanceUID: sent
//! again, an instance takes its own place.

use super::multipart::Budget;
use super::problems::TraceId;
use crate::auth::Principal;
use crate::config::Instance;
use crate::error::Problem;
use crate::queue::{Grown, JobRow, NewJob};
use crate::state::State;
use crate::store::{Input, Store, digest};
use axum::extract::{DefaultBodyLimit, Extension, Path, Request, State as Shared};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Most instances of one request.
const MOST_PARTS: usize = 8192;
/// How often a request looks again when others grow the same job at the same time.
const ROUNDS: usize = 64;
/// RFC 2046 allows 70 characters; Orthanc 1.10 sends 73 (two UUIDs), and its series were refused for that.
const LONGEST_BOUNDARY: usize = 200;
const DICOM: &str = "application/dicom";
const DICOM_JSON: &str = "application/dicom+json";

/// Failure reasons of PS3.18, table 10.5.3-3, and of PS3.4.
mod reason {
    pub(super) const OUT_OF_RESOURCES: u16 = 0xa700;
    pub(super) const OTHER_STUDY: u16 = 0xa900;
    pub(super) const CANNOT_UNDERSTAND: u16 = 0xc000;
    pub(super) const PROCESSING: u16 = 0x0110;
    pub(super) const CLASS_NOT_SUPPORTED: u16 = 0x0122;
}

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    // The parts are counted as they arrive, against the configured size.
    OpenApiRouter::new().routes(routes!(store)).routes(routes!(store_study)).layer(DefaultBodyLimit::disable())
}

/// Stores instances; each series becomes a job.
///
/// The job of a series begins when nothing more of it has come for a while. `Location` is the job (of several series the
/// first), `Link: rel="related"` every job. The answer's private element (0009,1001) of creator VASCULUM is the job's
/// address, (0009,1002) in a failed item the code of the fault.
#[utoipa::path(post, path = "/dicomweb/studies", operation_id = "store_instances", tag = "dicomweb", security(("key" = [])),
    request_body(content = String, content_type = "multipart/related", description = "`type=\"application/dicom\"`: one part for each instance (PS3.10 file)"),
    responses(
        (status = 200, description = "All instances are taken (PS3.18: ReferencedSOPSequence)", body = Object, content_type = "application/dicom+json"),
        (status = 202, description = "Some are taken, the others are in FailedSOPSequence", body = Object, content_type = "application/dicom+json"),
        (status = 400, description = "The body is no multipart/related, or broke off", body = Problem, content_type = "application/problem+json"),
        (status = 406, description = "The answer is application/dicom+json only", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "No instance is taken: see FailedSOPSequence", body = Object, content_type = "application/dicom+json"),
        (status = 415, description = "Not multipart/related; type=\"application/dicom\"", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "The store is full", body = Problem, content_type = "application/problem+json")
    ))]
async fn store(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    request: Request,
) -> Result<Response, Problem> {
    taken(&state, &who, &trace, None, request).await
}

/// Stores instances of one study; each series becomes a job. Instances of another study are refused.
#[utoipa::path(post, path = "/dicomweb/studies/{study}", operation_id = "store_study", tag = "dicomweb", security(("key" = [])),
    params(("study" = String, Path, pattern = "^[0-9.]{1,64}$", description = "StudyInstanceUID of every instance")),
    request_body(content = String, content_type = "multipart/related", description = "As for /dicomweb/studies"),
    responses(
        (status = 200, description = "All instances are taken", body = Object, content_type = "application/dicom+json"),
        (status = 202, description = "Some are taken", body = Object, content_type = "application/dicom+json"),
        (status = 400, description = "The body is no multipart/related, or broke off; the study is no UID", body = Problem, content_type = "application/problem+json"),
        (status = 406, description = "The answer is application/dicom+json only", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "No instance is taken", body = Object, content_type = "application/dicom+json"),
        (status = 415, description = "Not multipart/related; type=\"application/dicom\"", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "The store is full", body = Problem, content_type = "application/problem+json")
    ))]
async fn store_study(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(study): Path<String>,
    request: Request,
) -> Result<Response, Problem> {
    if study.len() > 64 || !study.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
        return Err(bad("The study is no UID: at most 64 digits and dots."));
    }
    taken(&state, &who, &trace, Some(study), request).await
}

fn bad(detail: impl Into<String>) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail)
}

/// An instance that is kept, and where it came from.
struct Kept {
    names: [String; 2],
    file: (String, Vec<u8>),
}

/// What became of the parts of a request.
#[derive(Default)]
struct Sorted {
    /// By the digest of study and series.
    series: BTreeMap<String, Vec<Kept>>,
    failed: Vec<Value>,
}

async fn taken(
    state: &State,
    who: &Principal,
    trace: &TraceId,
    study: Option<String>,
    request: Request,
) -> Result<Response, Problem> {
    accepts(request.headers())?;
    let boundary = boundary(request.headers())?;
    let mut budget = Budget::default();
    let parts = parts(state, who, request, &boundary, &mut budget).await?;
    let receive = state.config.receive;
    let sorted = tokio::task::spawn_blocking(move || sorted(parts, receive, study.as_deref()));
    let Sorted { series, failed } = sorted.await.map_err(Problem::internal)?;
    let (mut stored, mut jobs) = (Vec::new(), Vec::new());
    for (series, kept) in series {
        let (names, files): (Vec<_>, Vec<_>) = kept.into_iter().map(|k| (k.names, k.file)).unzip();
        let row = gathered(state, who, trace, &series, files).await?;
        let href = format!("/v1/jobs/{}", row.id);
        stored.extend(names.iter().map(|[class, instance]| {
            let mut item = sop(class, instance);
            stated(&mut item, "00091001", "UR", &href);
            item
        }));
        jobs.push(href);
    }
    Ok(answer(stored, failed, &jobs))
}

fn accepts(headers: &HeaderMap) -> Result<(), Problem> {
    let wanted: Vec<&str> = headers.get_all(header::ACCEPT).iter().filter_map(|v| v.to_str().ok()).collect();
    let fits = |kind: &str| {
        let kind = kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        ["*/*", "application/*", DICOM_JSON, "application/json"].contains(&kind.as_str())
    };
    if wanted.is_empty() || wanted.iter().flat_map(|list| list.split(',')).any(fits) {
        return Ok(());
    }
    let detail = format!("The answer is {DICOM_JSON}; the Accept header must allow it.");
    Err(Problem::new(StatusCode::NOT_ACCEPTABLE, "not_acceptable", detail))
}

/// The boundary of a multipart/related body of DICOM instances.
fn boundary(headers: &HeaderMap) -> Result<String, Problem> {
    let sent = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let mut fields = sent.split(';').map(str::trim);
    let kind = fields.next().unwrap_or_default();
    let field = |name: &str| {
        sent.split(';').skip(1).find_map(|field| {
            let (key, value) = field.trim().split_once('=')?;
            key.trim().eq_ignore_ascii_case(name).then(|| value.trim().trim_matches('"').to_owned())
        })
    };
    let of_dicom = field("type").is_none_or(|kind| kind.eq_ignore_ascii_case(DICOM));
    if !kind.eq_ignore_ascii_case("multipart/related") || !of_dicom {
        let detail = "Send multipart/related; type=\"application/dicom\": one part for each instance.";
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media_type", detail));
    }
    let boundary = field("boundary").filter(|text| (1..=LONGEST_BOUNDARY).contains(&text.len()));
    boundary.ok_or_else(|| bad(format!("The Content-Type names no boundary of 1 to {LONGEST_BOUNDARY} characters.")))
}

/// The bytes of every part, counted as they arrive.
async fn parts(
    state: &State,
    who: &Principal,
    request: Request,
    boundary: &str,
    budget: &mut Budget,
) -> Result<Vec<Vec<u8>>, Problem> {
    let broken = |error: multer::Error| {
        let detail = format!("The body broke off or is not multipart/related: {error}. Send it again.");
        Problem::new(StatusCode::BAD_REQUEST, "upload.broken", detail)
    };
    let mut form = multer::Multipart::new(request.into_body().into_data_stream(), boundary);
    let (mut parts, mut total) = (Vec::new(), 0_u64);
    while let Some(mut field) = form.next_field().await.map_err(broken)? {
        if field.content_type().is_some_and(|kind| kind.essence_str() != DICOM) {
            let detail = "Every part must be application/dicom: a whole PS3.10 file.";
            return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media_type", detail));
        }
        if parts.len() == MOST_PARTS {
            let detail = format!("The request has more than {MOST_PARTS} instances: send it in several.");
            return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "upload.parts", detail));
        }
        let mut bytes = Vec::new();
        while let Some(chunk) = field.chunk().await.map_err(broken)? {
            total += chunk.len() as u64;
            if who.max_bytes.is_some_and(|most| total > most) {
                let detail = "The request is larger than this key may send.";
                return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "upload.too_large", detail));
            }
            budget.grow(state, chunk.len())?;
            bytes.extend_from_slice(&chunk);
        }
        parts.push(bytes);
    }
    if parts.is_empty() {
        return Err(bad("The request holds no instance."));
    }
    Ok(parts)
}

/// Reads every part; on a blocking thread.
fn sorted(parts: Vec<Vec<u8>>, receive: crate::config::Receive, study: Option<&str>) -> Sorted {
    let mut sorted = Sorted::default();
    for bytes in parts {
        let Instance { class, instance, study: own, series, file } = receive(&bytes);
        drop(bytes);
        let file = match file {
            Err(problem) => {
                sorted.failed.push(failure(&class, &instance, reason_of(&problem), &problem.code));
                continue;
            }
            Ok(_) if study.is_some_and(|wanted| wanted != own) => {
                sorted.failed.push(failure(&class, &instance, reason::OTHER_STUDY, "dicom.other_study"));
                continue;
            }
            Ok(_) if [&own, &series, &instance].iter().any(|uid| uid.is_empty()) => {
                sorted.failed.push(failure(&class, &instance, reason::CANNOT_UNDERSTAND, "dicom.no_uid"));
                continue;
            }
            Ok(file) => file,
        };
        // The names themselves are not kept: equal ones find each other by their digest.
        let name = |text: &str| digest(text.as_bytes()).split_off("sha256:".len());
        let file = (format!("image-{}.dcm", &name(&instance)[..32]), file);
        let place = sorted.series.entry(name(&format!("{own}\n{series}"))).or_default();
        place.push(Kept { names: [class, instance], file });
    }
    sorted
}

fn reason_of(problem: &Problem) -> u16 {
    match problem.code.as_str() {
        "input.no_images" => reason::CLASS_NOT_SUPPORTED,
        "input.too_large" => reason::OUT_OF_RESOURCES,
        "input.malformed" | "input.truncated" => reason::CANNOT_UNDERSTAND,
        _ => reason::PROCESSING,
    }
}

/// Adds files to the job that gathers this series, or begins one. When this returns, files and job are durable.
async fn gathered(
    state: &State,
    who: &Principal,
    trace: &TraceId,
    series: &str,
    files: Vec<(String, Vec<u8>)>,
) -> Result<JobRow, Problem> {
    let quiet_ms = i64::try_from(state.config.stow_quiet_seconds.saturating_mul(1000)).map_err(Problem::internal)?;
    let described = tokio::task::spawn_blocking(move || (joined(Vec::new(), &Store::describe(&files)), files));
    let (new, files) = described.await.map_err(Problem::internal)?;
    for _ in 0..ROUNDS {
        let Some(open) = state.queue.gathering(&who.tenant, series).await? else {
            let job = first(who, trace, &new)?;
            state.store.put_input(job.id, &new, files.clone()).await?;
            if let Some(row) = state.queue.begin_gathering(&job, series, quiet_ms).await? {
                state.audit(who, &trace.0, "job.create", &row.id).await?;
                return Ok(row);
            }
            state.store.erase_job(job.id).await?;
            continue;
        };
        let id = Uuid::parse_str(&open.id).map_err(Problem::internal)?;
        // Erased or begun between the two looks: the next round sees it.
        let Ok(held) = state.store.manifest(id, &open.input_digest).await else { continue };
        let whole = joined(held, &new);
        let grown = Grown {
            before: open.input_digest,
            digest: whole.digest.clone(),
            files: i64::try_from(whole.files.len()).map_err(Problem::internal)?,
            bytes: i64::try_from(whole.bytes()).map_err(Problem::internal)?,
            memory_mb: crate::worker::expected_mb(whole.bytes()),
        };
        state.store.put_input(id, &whole, files.clone()).await?;
        if let Some(row) = state.queue.grow(&who.tenant, id, &grown, quiet_ms).await? {
            state.audit(who, &trace.0, "job.grow", &row.id).await?;
            return Ok(row);
        }
    }
    Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "upload.busy", "Too many send to this series. Send again.")
        .with_header("retry-after", "2"))
}

fn first(who: &Principal, trace: &TraceId, input: &Input) -> Result<NewJob, Problem> {
    Ok(NewJob {
        id: Uuid::now_v7(),
        tenant: who.tenant.clone(),
        priority: 0,
        memory_mb: crate::worker::expected_mb(input.bytes()),
        plan: "{}".to_owned(),
        input_digest: input.digest.clone(),
        input_files: i64::try_from(input.files.len()).map_err(Problem::internal)?,
        input_bytes: i64::try_from(input.bytes()).map_err(Problem::internal)?,
        trace_id: trace.0.clone(),
        idempotency_key: None,
        parent: None,
    })
}

/// Both inputs as one, by name; of one name the newer counts.
fn joined(held: Vec<crate::store::InputFile>, new: &Input) -> Input {
    let all = held.into_iter().chain(new.files.iter().cloned());
    let by_name: BTreeMap<String, _> = all.map(|file| (file.name.clone(), file)).collect();
    Input::of(by_name.into_values().collect())
}

/// An item of a sequence of SOPs (PS3.18, F.2: the DICOM JSON model).
fn sop(class: &str, instance: &str) -> Value {
    let uid = |text: &str| if text.is_empty() { json!({"vr": "UI"}) } else { json!({"vr": "UI", "Value": [text]}) };
    json!({"00081150": uid(class), "00081155": uid(instance)})
}

fn failure(class: &str, instance: &str, reason: u16, code: &str) -> Value {
    let mut item = sop(class, instance);
    item["00081197"] = json!({"vr": "US", "Value": [reason]});
    stated(&mut item, "00091002", "LO", code);
    item
}

/// Adds one of our private elements, with their creator.
fn stated(item: &mut Value, tag: &str, vr: &str, value: &str) {
    item["00090010"] = json!({"vr": "LO", "Value": ["VASCULUM"]});
    item[tag] = json!({"vr": vr, "Value": [value]});
}

fn answer(stored: Vec<Value>, failed: Vec<Value>, jobs: &[String]) -> Response {
    let status = match (stored.is_empty(), failed.is_empty()) {
        (false, true) => StatusCode::OK,
        (false, false) => StatusCode::ACCEPTED,
        (true, _) => StatusCode::CONFLICT,
    };
    let mut body = json!({});
    for (tag, items) in [("00081199", stored), ("00081198", failed)] {
        if !items.is_empty() {
            body[tag] = json!({"vr": "SQ", "Value": items});
        }
    }
    let mut response = (status, [(header::CONTENT_TYPE, DICOM_JSON)], body.to_string()).into_response();
    let headers = response.headers_mut();
    if let Some(first) = jobs.first().and_then(|href| href.parse().ok()) {
        headers.insert(header::LOCATION, first);
    }
    for href in jobs {
        if let Ok(link) = HeaderValue::from_str(&format!("<{href}>; rel=\"related\"")) {
            headers.append(header::LINK, link);
        }
    }
    if status == StatusCode::CONFLICT {
        // The answer is what PS3.18 says; a problem in its place would hide which instance failed.
        response.extensions_mut().insert(super::problems::Whole);
    }
    response
}
