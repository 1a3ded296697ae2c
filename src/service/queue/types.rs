//! Rows of the table.

use crate::db::Row;
use serde::{Deserialize, Serialize};

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Accepted, waits for a worker.
    Queued,
    /// A worker holds its lease.
    Running,
    /// Done; artefacts are named by the table.
    Succeeded,
    /// Ended with an error.
    Failed,
    /// Ended by its owner.
    Cancelled,
}

impl JobState {
    /// The word in the table and in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// The state of a word of the table.
    ///
    /// # Errors
    /// A word that the table's own check forbids.
    pub fn of(word: &str) -> sqlx::Result<Self> {
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled]
            .into_iter()
            .find(|state| state.as_str() == word)
            .ok_or_else(|| sqlx::Error::Decode(format!("unknown job state {word}").into()))
    }

    /// Whether nothing more happens by itself.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

/// What readers see of a job. Times in ms since 1970.
#[derive(Clone, Debug)]
pub struct JobRow {
    /// UUID v7 as text, so that ids sort by time.
    pub id: String,
    /// Owner.
    pub tenant: String,
    /// `reconstruction`.
    pub kind: String,
    /// Where it stands.
    pub state: JobState,
    /// Higher runs first.
    pub priority: i64,
    /// plan.json as sent (`{}` without).
    pub plan: String,
    /// `sha256:` of the input's manifest.
    pub input_digest: String,
    /// Number of input files.
    pub input_files: i64,
    /// Size of the input.
    pub input_bytes: i64,
    /// Starts so far.
    pub attempt: i64,
    /// Starts allowed.
    pub max_attempts: i64,
    /// Stage that runs or ran last.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Seconds left, as the job estimates.
    pub eta_s: Option<f64>,
    /// Whether a cancel waits for the worker.
    pub cancel_requested: bool,
    /// Problem body of a failed job.
    pub error: Option<String>,
    /// Label of the key that sent it, where it is known.
    pub sent_by: Option<String>,
    /// The earlier job whose scan or result it takes.
    pub parent: Option<String>,
    /// Trace of the request that made it.
    pub trace_id: String,
    /// Grows with every visible change.
    pub revision: i64,
    /// Accepted.
    pub created_at: i64,
    /// Last start.
    pub started_at: Option<i64>,
    /// End.
    pub finished_at: Option<i64>,
    /// Erased by itself after this time.
    pub expires_at: Option<i64>,
}

impl JobRow {
    /// Reads a row of `SELECT * FROM job`.
    ///
    /// # Errors
    /// A column that is missing or of another type.
    pub fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.get("id")?,
            tenant: row.get("tenant")?,
            kind: row.get("kind")?,
            state: JobState::of(row.get("state")?)?,
            priority: row.get("priority")?,
            plan: row.get("plan")?,
            input_digest: row.get("input_digest")?,
            input_files: row.get("input_files")?,
            input_bytes: row.get("input_bytes")?,
            attempt: row.get("attempt")?,
            max_attempts: row.get("max_attempts")?,
            stage: row.get("stage")?,
            progress: row.get("progress")?,
            eta_s: row.get("eta_s")?,
            cancel_requested: row.flag("cancel_requested")?,
            error: row.get("error")?,
            sent_by: row.get("sent_by")?,
            parent: row.get("parent")?,
            trace_id: row.get("trace_id")?,
            revision: row.get("revision")?,
            created_at: row.get("created_at")?,
            started_at: row.get("started_at")?,
            finished_at: row.get("finished_at")?,
            expires_at: row.get("expires_at")?,
        })
    }
}

/// An artefact that the table names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ArtefactRow {
    /// File name of contract.md.
    pub name: String,
    /// Media type.
    pub media_type: String,
    /// Size.
    pub bytes: i64,
    /// `sha256:` and 64 hex digits.
    pub digest: String,
    /// Where the store keeps it.
    pub object_key: String,
}

impl ArtefactRow {
    /// Reads a row of the artefact table.
    pub(super) fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            name: row.get("name")?,
            media_type: row.get("media_type")?,
            bytes: row.get("bytes")?,
            digest: row.get("digest")?,
            object_key: row.get("object_key")?,
        })
    }
}

/// One event of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct EventRow {
    /// Grows over all jobs.
    pub id: i64,
    /// `progress`, `stage` or `state`.
    pub kind: String,
    /// State after the event.
    pub state: JobState,
    /// Stage.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Seconds left.
    pub eta_s: Option<f64>,
    /// When, ms since 1970.
    pub at: i64,
}

impl EventRow {
    /// Reads a row of the event table.
    pub(super) fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.get("id")?,
            kind: row.get("kind")?,
            state: JobState::of(row.get("state")?)?,
            stage: row.get("stage")?,
            progress: row.get("progress")?,
            eta_s: row.get("eta_s")?,
            at: row.get("at")?,
        })
    }
}
