//! Rows of the table.

use serde::{Deserialize, Serialize};
use sqlx::FromRow;

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, sqlx::Type, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
#[sqlx(rename_all = "lowercase")]
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

    /// Whether nothing more happens by itself.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

/// What readers see of a job. Times in ms since 1970.
#[derive(Clone, Debug, FromRow)]
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
}

/// An artefact that the table names.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
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

/// One event of a job.
#[derive(Clone, Debug, PartialEq, FromRow)]
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
