//! The numbers of many finished jobs in one table.

use super::problems::TraceId;
use crate::auth::Principal;
use crate::cohort::{Quantity, Source, Table, Wanted};
use crate::error::Problem;
use crate::media::{self, Form, rfc3339};
use crate::queue::{Finished, ResultRow};
use crate::state::State;
use axum::extract::{Extension, Query, State as Shared};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use futures::{StreamExt as _, TryStreamExt as _};
use serde::de::{Error as _, IntoDeserializer as _};
use serde::{Deserialize, Deserializer, Serialize};
use std::time::Duration;
use tokio::sync::Semaphore;
use tower_http::compression::CompressionLayer;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Most jobs of one table: 145,000 rows, 25 MB of JSON (0.7 MB gzipped), 130 MB of memory while it is made.
const MOST_JOBS: i64 = 5000;
/// Most ids of one call.
const MOST_IDS: usize = 200;
/// Results that are in memory at the same time.
const AT_ONCE: usize = 8;
/// Tables that are made at the same time.
static TABLES: Semaphore = Semaphore::const_new(2);
/// Longest wait for another table to be ready.
const TABLE_WAIT: Duration = Duration::from_secs(20);

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(cohort)).layer(CompressionLayer::new())
}

/// In which forms the table can be had.
const FORMS: &[Form] = &[
    Form { media_type: "application/json", aliases: &[], words: &["json"], artefact: "cohort.json" },
    Form { media_type: "text/csv", aliases: &[], words: &["csv"], artefact: "cohort.csv" },
];

/// `angle` or `branch`.
#[derive(Clone, Copy, Debug, Deserialize, Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum RowKind {
    Angle,
    Branch,
}

/// A job's kind.
#[derive(Clone, Copy, Debug, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum JobKind {
    Reconstruction,
    Variant,
}

/// In which form.
#[derive(Clone, Copy, Debug, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
enum Word {
    Json,
    Csv,
}

/// Which jobs, and which of their numbers. Lists are separated by commas; without a filter everything is meant.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct Asked {
    /// Only these jobs, in this order; at most 200.
    #[serde(default, deserialize_with = "listed")]
    #[param(value_type = Option<Vec<Uuid>>, style = Form, explode = false, min_items = 1, max_items = 200)]
    id: Option<Vec<Uuid>>,
    /// Only jobs created at this time or later (RFC 3339).
    #[param(format = DateTime)]
    created_after: Option<String>,
    /// Only jobs created before this time (RFC 3339).
    #[param(format = DateTime)]
    created_before: Option<String>,
    /// Only reconstructions of scans, or only variants.
    #[param(inline)]
    job_kind: Option<JobKind>,
    /// Only angles of these names and branches of these roles.
    #[serde(default, deserialize_with = "listed")]
    #[param(value_type = Option<Vec<String>>, style = Form, explode = false, min_items = 1)]
    name: Option<Vec<String>>,
    /// Only these quantities; angles have `deg`.
    #[serde(default, deserialize_with = "listed")]
    #[param(value_type = Option<Vec<Quantity>>, style = Form, explode = false, min_items = 1)]
    quantity: Option<Vec<Quantity>>,
    /// Only angles, or only branches.
    #[serde(default, deserialize_with = "listed")]
    #[param(value_type = Option<Vec<RowKind>>, style = Form, explode = false, min_items = 1)]
    kind: Option<Vec<RowKind>>,
    /// Only branches with these numbers.
    #[serde(default, deserialize_with = "numbered")]
    #[param(value_type = Option<Vec<u32>>, style = Form, explode = false, min_items = 1)]
    branch: Option<Vec<u64>>,
    /// `true`: without results that have warnings.
    without_warnings: Option<bool>,
    /// Goes before Accept.
    #[param(inline)]
    format: Option<Word>,
}

/// `A,B` as a list.
fn listed<'de, D, T>(from: D) -> Result<Option<Vec<T>>, D::Error>
where
    D: Deserializer<'de>,
    T: serde::de::DeserializeOwned,
{
    let text = String::deserialize(from)?;
    let one = |part: &str| T::deserialize(part.to_owned().into_deserializer());
    text.split(',').map(one).collect::<Result<_, _>>().map(Some)
}

/// `1,2` as a list.
fn numbered<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Vec<u64>>, D::Error> {
    let text = String::deserialize(from)?;
    let one = |part: &str| part.parse().map_err(|_| D::Error::custom(format!("{part} is no number of a branch")));
    text.split(',').map(one).collect::<Result<_, _>>().map(Some)
}

/// What the table tells of a result as a whole.
#[derive(ToSchema)]
#[allow(dead_code, reason = "describes the answer in the OpenAPI document")]
struct CohortResult {
    /// Job.
    job: String,
    /// RFC 3339, UTC.
    created_at: Option<String>,
    /// Whether the vessel was made from a measured one.
    variant: bool,
    /// Slices of the scan.
    slices: Option<u64>,
    /// Distance between slices, mm.
    slice_spacing_mm: Option<f64>,
    /// Volume of the lumen, mm^3.
    volume_mm3: Option<f64>,
    /// Node of the junction that the report puts first.
    main_junction: Option<u64>,
    /// Warnings of the result.
    warnings: u64,
}

/// One number of one job.
#[derive(ToSchema)]
#[allow(dead_code, reason = "describes the answer in the OpenAPI document")]
struct CohortRow {
    /// Job.
    job: String,
    /// What it belongs to.
    kind: RowKind,
    /// Junction's node or branch's number.
    id: u64,
    /// The angle's name or the branch's role.
    name: String,
    /// `deg` or the branch's quantity.
    quantity: String,
    /// Null where it could not be had.
    value: Option<f64>,
    /// 95 % band, where there is one.
    band95: Option<[f64; 2]>,
    /// Warnings of the job's result.
    warnings: u64,
}

/// How the values of one name and quantity spread (quantiles of type 7, those of numpy and R).
#[derive(ToSchema)]
#[allow(dead_code, reason = "describes the answer in the OpenAPI document")]
struct CohortSpread {
    /// The angle's name or the branch's role.
    name: String,
    /// `deg` or the branch's quantity.
    quantity: String,
    /// Values.
    count: u64,
    /// Values that could not be had.
    missing: u64,
    /// Smallest.
    min: f64,
    /// First quartile.
    q1: f64,
    /// Median.
    median: f64,
    /// Third quartile.
    q3: f64,
    /// Largest.
    max: f64,
    /// Mean.
    mean: f64,
    /// Of the sample; null for a single value.
    standard_deviation: Option<f64>,
}

/// The numbers of many jobs.
#[derive(ToSchema)]
#[allow(dead_code, reason = "describes the answer in the OpenAPI document")]
struct Cohort {
    /// `vasculum/cohort/1`.
    schema: String,
    /// Results that gave a row.
    jobs: u64,
    /// Those results: newest first, or in the order of `id`.
    results: Vec<CohortResult>,
    /// One row for each number.
    rows: Vec<CohortRow>,
    /// Medians and spread.
    summary: Vec<CohortSpread>,
}

/// Reads the angles and branches of many finished jobs together, with medians and spread, as JSON or (rows only) CSV.
#[utoipa::path(get, path = "/v1/cohort", operation_id = "read_cohort", tag = "results", security(("key" = [])),
    params(Asked), responses(
        (status = 200, description = "The table: what `vasculum cohort` makes of the same results", content((Cohort = "application/json"), (String = "text/csv"))),
        (status = 400, description = "The query cannot be understood", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "One of `id` is no finished job", body = Problem, content_type = "application/problem+json"),
        (status = 406, description = "Neither JSON nor CSV is accepted", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "More than 5000 jobs are meant", body = Problem, content_type = "application/problem+json")
    ))]
async fn cohort(
    Shared(state): Shared<State>,
    who: Principal,
    Extension(trace): Extension<TraceId>,
    Query(asked): Query<Asked>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let form = form_of(asked.format, &headers)?;
    let Ok(Ok(_permit)) = tokio::time::timeout(TABLE_WAIT, TABLES.acquire()).await else {
        let busy = Problem::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "cohort.busy",
            "Other tables are being made. Ask again in a moment, or for fewer jobs.",
        );
        return Err(busy.with_header("retry-after", "10"));
    };
    let found = meant(&state, &who, &asked).await?;
    // Whose numbers were seen: the newest and the oldest of them, and how many.
    let ends = found.first().zip(found.last()).map_or(String::new(), |(a, b)| format!(" {} .. {}", a.job, b.job));
    state.audit(&who, &trace.0, "cohort.read", &format!("{} jobs{ends}", found.len())).await?;
    let table = filled(&state, (state.config.cohort)(wanted(&asked)), found).await?;
    let csv = form.media_type == "text/csv";
    let text = tokio::task::spawn_blocking(move || if csv { table.csv() } else { table.json() });
    let text = text.await.map_err(Problem::internal)??;
    let name = format!("inline; filename=\"{}\"", form.artefact);
    let head = [
        (header::CONTENT_TYPE, media::media_type(form.artefact).to_owned()),
        (header::CONTENT_DISPOSITION, name),
        (header::CACHE_CONTROL, "private, no-cache".to_owned()),
        (header::VARY, "accept".to_owned()),
    ];
    Ok((head, text).into_response())
}

fn form_of(word: Option<Word>, headers: &HeaderMap) -> Result<&'static Form, Problem> {
    let [json, csv] = FORMS else { return Err(Problem::internal("the table has two forms")) };
    let accept = headers.get(header::ACCEPT).and_then(|v| v.to_str().ok()).unwrap_or("");
    match word {
        Some(Word::Json) => Ok(json),
        Some(Word::Csv) => Ok(csv),
        None => media::negotiate(accept, FORMS).ok_or_else(|| {
            let detail = "The table can be had as application/json or text/csv.";
            Problem::new(StatusCode::NOT_ACCEPTABLE, "not_acceptable", detail)
        }),
    }
}

fn wanted(asked: &Asked) -> Wanted {
    let words = |list: &Option<Vec<RowKind>>| {
        let word = |kind: &RowKind| match kind {
            RowKind::Angle => "angle".to_owned(),
            RowKind::Branch => "branch".to_owned(),
        };
        list.iter().flatten().map(word).collect()
    };
    Wanted {
        names: asked.name.clone().unwrap_or_default(),
        quantities: asked.quantity.iter().flatten().map(|q| q.as_str().to_owned()).collect(),
        kinds: words(&asked.kind),
        branches: asked.branch.clone().unwrap_or_default(),
        without_warnings: asked.without_warnings.unwrap_or(false),
    }
}

/// The finished jobs that the query means.
async fn meant(state: &State, who: &Principal, asked: &Asked) -> Result<Vec<ResultRow>, Problem> {
    let time = |name: &str, text: &Option<String>, without: i64| match text {
        None => Ok(without),
        Some(text) => media::ms_of(text).ok_or_else(|| {
            let detail = format!("{name} must be a time of RFC 3339 such as 2026-11-24T20:00:00Z.");
            Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail)
        }),
    };
    let wanted = Finished {
        after: time("created_after", &asked.created_after, i64::MIN)?,
        before: time("created_before", &asked.created_before, i64::MAX)?,
        kind: match asked.job_kind {
            None => "",
            Some(JobKind::Reconstruction) => "reconstruction",
            Some(JobKind::Variant) => "variant",
        },
        limit: MOST_JOBS + 1,
    };
    let Some(ids) = &asked.id else {
        let found = state.queue.finished(&who.tenant, &wanted).await?;
        return if found.len() > usize::try_from(MOST_JOBS).unwrap_or(usize::MAX) {
            Err(too_many())
        } else {
            Ok(found)
        };
    };
    if ids.len() > MOST_IDS {
        let detail = format!("At most {MOST_IDS} ids can be named in one call; name times instead.");
        return Err(Problem::new(StatusCode::BAD_REQUEST, "bad_request", detail));
    }
    let mut found = Vec::new();
    for id in ids {
        let one = state.queue.finished_job(&who.tenant, *id).await?;
        found.push(one.ok_or_else(|| Problem::not_found(&format!("finished job {id}")))?);
    }
    found.retain(|row| {
        (wanted.after..wanted.before).contains(&row.created_at) && (wanted.kind.is_empty() || row.kind == wanted.kind)
    });
    Ok(found)
}

fn too_many() -> Problem {
    let detail = format!(
        "More than {MOST_JOBS} finished jobs are meant, the most that one table may have. Narrow it by created_after \
         and created_before, and put the parts together."
    );
    Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "cohort.too_many", detail)
}

/// Adds every result; a few are read at the same time, and none is kept.
async fn filled(state: &State, mut table: Box<dyn Table>, found: Vec<ResultRow>) -> Result<Box<dyn Table>, Problem> {
    let read = |row: ResultRow| async move {
        match state.store.bytes(&row.artefact.object_key, &row.artefact.digest).await {
            Ok(bytes) => Ok(Some((Source { created_at: rfc3339(row.created_at), job: row.job }, bytes))),
            // Erased since it was listed: it is in no table any more.
            Err(_) if !still_there(state, &row).await? => Ok(None),
            Err(error) => Err(Problem::from(error)),
        }
    };
    let mut results = futures::stream::iter(found).map(read).buffered(AT_ONCE);
    while let Some(read) = results.try_next().await? {
        let Some((source, bytes)) = read else { continue };
        let added = tokio::task::spawn_blocking(move || table.add(&source, &bytes).map(|()| table));
        table = added.await.map_err(Problem::internal)??;
    }
    Ok(table)
}

async fn still_there(state: &State, row: &ResultRow) -> Result<bool, Problem> {
    let id = Uuid::parse_str(&row.job).map_err(Problem::internal)?;
    Ok(state.queue.is_known(id).await?.is_some())
}
