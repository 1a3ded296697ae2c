//! Resumable uploads: tus 1.0 with creation, checksum, expiration and termination.
//!
//! A client makes an upload (POST), sends its bytes in one or more PATCH calls, asks after a break how much arrived (HEAD),
//! and names the upload in `POST /v1/jobs`. What arrived before a break is kept, unless a checksum was promised for it.

use super::multipart::Budget;
use super::problems::TraceId;
use crate::auth::Principal;
use crate::config::NamedBytes;
use crate::error::Problem;
use crate::media::base64_bytes;
use crate::state::State;
use crate::uploads::{self, FRAME, Partial, Ticket};
use axum::body::Body;
use axum::extract::{Extension, Path, Request, State as Shared};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use futures::StreamExt as _;
use ring::digest;
use std::io::ErrorKind;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

const VERSION: &str = "1.0.0";
const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
const PATCH_TYPE: &str = "application/offset+octet-stream";
/// Most bytes of a refused body that are read.
const DRAINED: usize = 16 << 20;
/// The status of tus for a checksum that does not fit.
const CHECKSUM_MISMATCH: u16 = 460;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(create, abilities)).routes(routes!(offset, append, remove))
}

/// The file of a finished upload, and the upload's id.
pub(super) async fn taken(
    state: &State,
    who: &Principal,
    address: &str,
    budget: &mut Budget,
) -> Result<(NamedBytes, uuid::Uuid), Problem> {
    let (ticket, length) = known(state, who, address).await?;
    budget.grow(state, usize::try_from(length).map_err(Problem::internal)?)?;
    let partial = opened(state, &ticket).await?;
    if partial.offset != length {
        let detail = format!("The upload has {} of {length} bytes: send the rest first.", partial.offset);
        return Err(Problem::new(StatusCode::CONFLICT, "upload.unfinished", detail));
    }
    let id = ticket.id;
    Ok((on_disk(move || partial.read()).await?, id))
}

/// Tells what this server's uploads can.
#[utoipa::path(options, path = "/v1/uploads", operation_id = "upload_abilities", tag = "jobs", responses(
    (status = 204, description = "Tus-Version, Tus-Extension, Tus-Max-Size and Tus-Checksum-Algorithm")
))]
async fn abilities(Shared(state): Shared<State>) -> Response {
    let most = state.config.max_body.to_string();
    let headers = [
        ("tus-version", VERSION),
        ("tus-extension", "creation,checksum,expiration,termination"),
        ("tus-checksum-algorithm", "sha1,sha256"),
        ("tus-max-size", most.as_str()),
    ];
    answer(StatusCode::NO_CONTENT, &headers)
}

/// Makes an upload; its address is in Location.
#[utoipa::path(post, path = "/v1/uploads", operation_id = "create_upload", tag = "jobs", security(("key" = [])),
    params(("Tus-Resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "1.0.0"),
        ("Upload-Length" = String, Header, pattern = "^[0-9]{1,10}$", description = "Size of the file, bytes"),
        ("Upload-Metadata" = Option<String>, Header, description = "`filename` and its name in base 64")),
    responses(
        (status = 201, description = "Made: Location and Upload-Expires"),
        (status = 400, description = "A header that tus asks for is missing or wrong", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "There are as many as a tenant may have", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "Another version of tus", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "Larger than this key may send", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "The disk has no room for it", body = Problem, content_type = "application/problem+json")
    ))]
async fn create(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    spoken(&headers)?;
    let length = number(&headers, "upload-length")?;
    let most = who.max_bytes.unwrap_or(u64::MAX).min(state.config.max_body);
    if length > most {
        return Err(too_large(most));
    }
    if super::health::disk_free(&state) < state.config.min_free_disk.saturating_add(length) {
        return Err(Problem::storage_full(
            "The disk has no room for this upload. Nothing was accepted; tell the operator.",
        ));
    }
    let ticket = Ticket::new().map_err(Problem::internal)?;
    let db = state.queue.db();
    if !uploads::add(db, &who.tenant, ticket.id, i64::try_from(length).map_err(Problem::internal)?).await? {
        let detail = format!("There are {} unfinished uploads already. Finish or DELETE one first.", uploads::MOST);
        return Err(Problem::new(StatusCode::CONFLICT, "upload.many", detail));
    }
    let (folder, made, name) = (uploads::folder(&state.config.data_dir), ticket.clone(), file_name(&headers));
    on_disk(move || Partial::create(&folder, &made, &name)).await?;
    state.audit(&who, &trace.0, "upload.create", &ticket.id.to_string()).await?;
    let expires = expiry(&state, &who, &ticket).await?;
    let location = format!("/v1/uploads/{}", ticket.text());
    Ok(answer(StatusCode::CREATED, &[("location", &location), ("upload-expires", &expires), ("upload-offset", "0")]))
}

/// Tells how much of an upload has arrived.
#[utoipa::path(head, path = "/v1/uploads/{id}", operation_id = "read_upload", tag = "jobs", security(("key" = [])),
    params(("id" = String, Path, pattern = "^[0-9a-f]{96}$", description = "Upload"),
        ("Tus-Resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "1.0.0")),
    responses(
        (status = 200, description = "Upload-Offset and Upload-Length"),
        (status = 400, description = "Tus-Resumable is missing"),
        (status = 404, description = "No such upload"),
        (status = 412, description = "Another version of tus")
    ))]
async fn offset(
    Shared(state): Shared<State>,
    who: Principal,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    spoken(&headers)?;
    let (ticket, length) = known(&state, &who, &id).await?;
    let (folder, asked) = (uploads::folder(&state.config.data_dir), ticket.clone());
    let offset = on_disk(move || Partial::offset(&folder, &asked)).await?.to_string();
    let expires = expiry(&state, &who, &ticket).await?;
    let length = length.to_string();
    let told = [("upload-offset", offset.as_str()), ("upload-length", &length), ("upload-expires", &expires)];
    Ok(answer(StatusCode::OK, &told))
}

/// Sends the next bytes of an upload.
#[utoipa::path(patch, path = "/v1/uploads/{id}", operation_id = "append_upload", tag = "jobs", security(("key" = [])),
    params(("id" = String, Path, pattern = "^[0-9a-f]{96}$", description = "Upload"),
        ("Tus-Resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "1.0.0"),
        ("Upload-Offset" = String, Header, pattern = "^[0-9]{1,18}$", description = "How much was sent before, bytes"),
        ("Upload-Checksum" = Option<String>, Header, pattern = "^(sha1 [A-Za-z0-9+/]{27}=|sha256 [A-Za-z0-9+/]{43}=)$", description = "`sha1` or `sha256` and the digest in base 64")),
    request_body(content = String, content_type = "application/offset+octet-stream", description = "Bytes"),
    responses(
        (status = 204, description = "Kept: Upload-Offset tells how much there is now"),
        (status = 400, description = "The body broke off, or a header is wrong; what arrived is kept", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such upload", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "Another offset; HEAD tells it", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "Another version of tus", body = Problem, content_type = "application/problem+json"),
        (status = 423, description = "Another call is sending", body = Problem, content_type = "application/problem+json"),
        (status = 460, description = "The checksum does not fit; nothing was kept", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "The disk is full", body = Problem, content_type = "application/problem+json")
    ))]
async fn append(
    Shared(state): Shared<State>,
    who: Principal,
    Path(id): Path<String>,
    request: Request,
) -> Result<Response, Problem> {
    let (parts, body) = request.into_parts();
    let (partial, ticket, left, check) = match ready(&state, &who, &id, &parts.headers).await {
        Ok(ready) => ready,
        Err(problem) => {
            drained(body).await;
            return Err(problem);
        }
    };
    // A task of its own: it keeps what arrived though the connection's own task may be dropped at its end.
    let kept = tokio::spawn(received(partial, body, left, check)).await.map_err(Problem::internal)?;
    let kept = kept?.to_string();
    let expires = expiry(&state, &who, &ticket).await?;
    Ok(answer(StatusCode::NO_CONTENT, &[("upload-offset", &kept), ("upload-expires", &expires)]))
}

/// Ends an upload and erases what was sent.
#[utoipa::path(delete, path = "/v1/uploads/{id}", operation_id = "delete_upload", tag = "jobs", security(("key" = [])),
    params(("id" = String, Path, pattern = "^[0-9a-f]{96}$", description = "Upload"),
        ("Tus-Resumable" = String, Header, pattern = "^1\\.0\\.0$", description = "1.0.0")),
    responses(
        (status = 204, description = "Erased"),
        (status = 400, description = "Tus-Resumable is missing", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such upload", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "Another version of tus", body = Problem, content_type = "application/problem+json")
    ))]
async fn remove(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    spoken(&headers)?;
    let (ticket, _) = known(&state, &who, &id).await?;
    let gone = uploads::remove(state.queue.db(), &state.config.data_dir, &who.tenant, ticket.id).await;
    if !gone.map_err(Problem::internal)? {
        return Err(Problem::not_found("upload"));
    }
    state.audit(&who, &trace.0, "upload.erase", &ticket.id.to_string()).await?;
    Ok(answer(StatusCode::NO_CONTENT, &[]))
}

/// The upload of a PATCH whose headers are in order, how much it lacks, and the checksum that was promised.
async fn ready(
    state: &State,
    who: &Principal,
    id: &str,
    headers: &HeaderMap,
) -> Result<(Partial, Ticket, u64, Option<Promise>), Problem> {
    spoken(headers)?;
    if headers.get(header::CONTENT_TYPE).is_none_or(|v| v != PATCH_TYPE) {
        let detail = format!("Send the bytes as {PATCH_TYPE}.");
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media_type", detail));
    }
    let begin = number(headers, "upload-offset")?;
    let check = promised(headers)?;
    let (ticket, length) = known(state, who, id).await?;
    let mut partial = opened(state, &ticket).await?;
    if partial.offset != begin {
        let detail = format!("The upload stands at {}, not at {begin}. HEAD tells the offset.", partial.offset);
        return Err(Problem::new(StatusCode::CONFLICT, "upload.offset", detail));
    }
    if check.is_some() {
        partial.on_trial();
    }
    Ok((partial, ticket, length - begin.min(length), check))
}

/// Reads and drops what a refused client is still sending: it would see a broken pipe instead of the answer.
async fn drained(body: Body) {
    let mut stream = body.into_data_stream();
    let mut left = DRAINED;
    while let Some(Ok(part)) = stream.next().await {
        left = left.saturating_sub(part.len());
        if left == 0 {
            return;
        }
    }
}

/// A promised digest and its algorithm.
type Promise = (digest::Context, Vec<u8>);

/// Writes a body behind what is there; the new offset.
async fn received(partial: Partial, body: Body, mut left: u64, check: Option<Promise>) -> Result<u64, Problem> {
    let mut stream = body.into_data_stream();
    let (mut partial, mut held, mut check) = (partial, Vec::with_capacity(FRAME), check);
    let mut broken = None;
    while broken.is_none() {
        let Some(part) = stream.next().await else { break };
        match part {
            Err(_) => {
                broken = Some(bad("upload.broken", "The body broke off. HEAD tells what arrived; send the rest."))
            }
            Ok(part) if part.len() as u64 > left => broken = Some(too_large(left)),
            Ok(part) => {
                left -= part.len() as u64;
                if let Some((context, _)) = &mut check {
                    context.update(&part);
                }
                held.extend_from_slice(&part);
            }
        }
        if held.len() >= FRAME {
            partial = written(partial, std::mem::take(&mut held)).await?;
        }
    }
    let mut partial = written(partial, held).await?;
    if let (None, Some((context, wanted))) = (&broken, check) {
        if context.finish().as_ref() != wanted {
            let detail = "The bytes do not have the promised checksum; none of them was kept. Send them again.";
            return Err(Problem::new(StatusCode::BAD_REQUEST, "upload.checksum", detail).with_status(CHECKSUM_MISMATCH));
        }
        partial.keep();
    }
    let offset = partial.offset;
    on_disk(move || partial.sync()).await?;
    broken.map_or(Ok(offset), Err)
}

/// Appends bytes in frames, away from the async workers.
async fn written(mut partial: Partial, bytes: Vec<u8>) -> Result<Partial, Problem> {
    on_disk(move || {
        bytes.chunks(FRAME).try_for_each(|frame| partial.append(frame))?;
        Ok(partial)
    })
    .await
}

/// The caller's upload and its length.
async fn known(state: &State, who: &Principal, id: &str) -> Result<(Ticket, u64), Problem> {
    let ticket = Ticket::of(id).ok_or_else(|| Problem::not_found("upload"))?;
    let found = uploads::find(state.queue.db(), &who.tenant, ticket.id).await?;
    let (length, _) = found.ok_or_else(|| Problem::not_found("upload"))?;
    Ok((ticket, length))
}

async fn opened(state: &State, ticket: &Ticket) -> Result<Partial, Problem> {
    let (folder, ticket) = (uploads::folder(&state.config.data_dir), ticket.clone());
    on_disk(move || Partial::open(&folder, &ticket)).await
}

/// Work on an upload's file, away from the async workers.
async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> std::io::Result<T> + Send + 'static) -> Result<T, Problem> {
    tokio::task::spawn_blocking(work).await.map_err(Problem::internal)?.map_err(fault)
}

fn fault(error: std::io::Error) -> Problem {
    match error.kind() {
        ErrorKind::NotFound => Problem::not_found("upload"),
        ErrorKind::WouldBlock => {
            let detail = "Another call is sending to this upload. Ask HEAD again in a moment.";
            Problem::new(StatusCode::LOCKED, "upload.locked", detail).with_header("retry-after", "2")
        }
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            Problem::storage_full("The disk is full. What arrived before is kept; tell the operator.")
        }
        _ => Problem::internal(error),
    }
}

fn bad(code: &str, detail: impl Into<String>) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, code, detail)
}

fn too_large(most: u64) -> Problem {
    let detail = format!("The upload is larger than {most} bytes, the most that may be sent here.");
    Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "upload.too_large", detail)
}

/// Whether the caller speaks this version of tus.
fn spoken(headers: &HeaderMap) -> Result<(), Problem> {
    match headers.get(RESUMABLE) {
        Some(version) if version == VERSION => Ok(()),
        Some(_) => {
            let detail = format!("This server speaks tus {VERSION}.");
            Err(Problem::new(StatusCode::PRECONDITION_FAILED, "upload.version", detail)
                .with_header("tus-version", VERSION))
        }
        None => Err(bad("upload.version", format!("Send the header Tus-Resumable: {VERSION}."))),
    }
}

fn number(headers: &HeaderMap, name: &str) -> Result<u64, Problem> {
    let digits = headers.get(name).and_then(|v| v.to_str().ok()).filter(|v| v.bytes().all(|b| b.is_ascii_digit()));
    let number = digits.and_then(|v| v.parse().ok()).filter(|n| i64::try_from(*n).is_ok());
    number.ok_or_else(|| bad("upload.header", format!("Send the header {name} with a number of bytes.")))
}

/// `Upload-Checksum: ALGORITHM DIGEST`.
fn promised(headers: &HeaderMap) -> Result<Option<Promise>, Problem> {
    let Some(value) = headers.get("upload-checksum") else { return Ok(None) };
    let read = value.to_str().ok().and_then(|text| {
        let (name, coded) = text.split_once(' ')?;
        let algorithm = match name {
            "sha1" => &digest::SHA1_FOR_LEGACY_USE_ONLY,
            "sha256" => &digest::SHA256,
            _ => return None,
        };
        let wanted = base64_bytes(coded.trim()).filter(|bytes| bytes.len() == algorithm.output_len())?;
        Some((digest::Context::new(algorithm), wanted))
    });
    let said = "Upload-Checksum must be sha1 or sha256, a space, and the digest in base 64.";
    read.map(Some).ok_or_else(|| bad("upload.checksum", said))
}

/// `filename` of Upload-Metadata, or a plain word.
fn file_name(headers: &HeaderMap) -> String {
    let text = headers.get("upload-metadata").and_then(|v| v.to_str().ok()).unwrap_or_default();
    let coded = text.split(',').find_map(|pair| pair.trim().strip_prefix("filename ").map(str::trim));
    let name = coded.and_then(base64_bytes).and_then(|bytes| String::from_utf8(bytes).ok());
    name.filter(|name| !name.is_empty() && name.len() <= 1024).unwrap_or_else(|| "upload".to_owned())
}

/// `Upload-Expires`, as HTTP writes a time.
async fn expiry(state: &State, who: &Principal, ticket: &Ticket) -> Result<String, Problem> {
    let found = uploads::find(state.queue.db(), &who.tenant, ticket.id).await?;
    let (_, at) = found.ok_or_else(|| Problem::not_found("upload"))?;
    crate::media::http_date(at).ok_or_else(|| Problem::internal("a time beyond the calendar"))
}

fn answer(status: StatusCode, headers: &[(&'static str, &str)]) -> Response {
    let mut response = status.into_response();
    response.headers_mut().insert(RESUMABLE, HeaderValue::from_static(VERSION));
    for (name, value) in headers {
        if let Ok(value) = HeaderValue::from_str(value) {
            response.headers_mut().insert(HeaderName::from_static(name), value);
        }
    }
    response
}
