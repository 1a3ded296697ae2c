//! The JSON shapes of contract.md.

use crate::error::Problem;
use crate::media::rfc3339;
use crate::queue::{ArtefactRow, EventRow, JobRow, JobState};
use serde::Serialize;
use utoipa::ToSchema;

/// Addresses that belong to a job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Links {
    /// The job.
    #[serde(rename = "self")]
    pub this: String,
    /// Its events.
    pub events: String,
    /// Its artefacts.
    pub artefacts: String,
    /// Its result.
    pub result: String,
    /// POST here to cancel.
    pub cancel: String,
    /// POST here to run a failed job again.
    pub retry: String,
    /// Its plan.
    pub plan: String,
}

/// What was sent.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct InputShape {
    /// Number of files.
    pub files: i64,
    /// Their size.
    pub bytes: i64,
    /// `sha256:` over names, sizes and digests of the files.
    pub digest: String,
}

/// A job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Job {
    /// UUID v7.
    pub id: String,
    /// `reconstruction` or `variant`.
    pub kind: String,
    /// Where it stands.
    pub state: JobState,
    /// Stage that runs, or in which it failed.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Higher runs earlier; 0 is usual.
    pub priority: i64,
    /// Seconds left, as the job estimates.
    pub eta_s: Option<f64>,
    /// Starts so far.
    pub attempt: i64,
    /// Starts allowed.
    pub max_attempts: i64,
    /// Whether a cancel is on its way to the worker.
    pub cancel_requested: bool,
    /// Who sent it: the label of the key.
    pub sent_by: Option<String>,
    /// The earlier job whose scan or result it takes.
    pub parent: Option<String>,
    /// What was sent.
    pub input: InputShape,
    /// RFC 3339, UTC.
    pub created_at: Option<String>,
    /// RFC 3339, UTC: the last start.
    pub started_at: Option<String>,
    /// RFC 3339, UTC.
    pub finished_at: Option<String>,
    /// Why it failed.
    #[schema(value_type = Option<Problem>)]
    pub error: Option<serde_json::Value>,
    /// Addresses.
    pub links: Links,
}

/// A page of jobs.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobList {
    /// Newest first.
    pub items: Vec<Job>,
    /// Address of the next page, or null.
    pub next: Option<String>,
}

/// An artefact.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Artefact {
    /// File name.
    pub name: String,
    /// Media type.
    pub media_type: String,
    /// Size.
    pub bytes: i64,
    /// `sha256:` and 64 hex digits.
    pub digest: String,
    /// Address.
    pub href: String,
}

/// All artefacts of a job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ArtefactList {
    /// By name.
    pub items: Vec<Artefact>,
    /// Always null: there are few.
    pub next: Option<String>,
}

/// `data` of an event.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct EventData {
    /// State after the event.
    pub state: JobState,
    /// Stage.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Seconds left.
    pub eta_s: Option<f64>,
    /// RFC 3339, UTC.
    pub at: Option<String>,
}

/// An event in a list.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct EventShape {
    /// Grows.
    pub id: i64,
    /// `progress`, `stage` or `state`.
    pub event: String,
    /// What happened.
    pub data: EventData,
}

/// Events of a job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct EventList {
    /// Oldest first.
    pub items: Vec<EventShape>,
    /// Address of the next page, or null.
    pub next: Option<String>,
}

impl From<JobRow> for Job {
    fn from(row: JobRow) -> Self {
        let this = format!("/v1/jobs/{}", row.id);
        Self {
            links: Links {
                events: format!("{this}/events"),
                artefacts: format!("{this}/artefacts"),
                result: format!("{this}/result"),
                cancel: format!("{this}/cancel"),
                retry: format!("{this}/retry"),
                plan: format!("{this}/plan"),
                this,
            },
            input: InputShape { files: row.input_files, bytes: row.input_bytes, digest: row.input_digest },
            id: row.id,
            kind: row.kind,
            state: row.state,
            stage: row.stage,
            progress: row.progress,
            priority: row.priority,
            eta_s: row.eta_s,
            attempt: row.attempt,
            max_attempts: row.max_attempts,
            cancel_requested: row.cancel_requested,
            sent_by: row.sent_by,
            parent: row.parent,
            created_at: rfc3339(row.created_at),
            started_at: row.started_at.and_then(rfc3339),
            finished_at: row.finished_at.and_then(rfc3339),
            // The table holds what Problem::body wrote.
            error: row.error.and_then(|text| serde_json::from_str(&text).ok()),
        }
    }
}

impl Artefact {
    /// The shape of a row of job `id`.
    pub(super) fn new(id: uuid::Uuid, row: ArtefactRow) -> Self {
        Self {
            href: format!("/v1/jobs/{id}/artefacts/{}", row.name),
            name: row.name,
            media_type: row.media_type,
            bytes: row.bytes,
            digest: row.digest,
        }
    }
}

impl From<EventRow> for EventShape {
    fn from(row: EventRow) -> Self {
        let data = EventData {
            state: row.state,
            stage: row.stage,
            progress: row.progress,
            eta_s: row.eta_s,
            at: rfc3339(row.at),
        };
        Self { id: row.id, event: row.kind, data }
    }
}
