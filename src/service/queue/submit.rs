//! Accepting, cancelling, retrying and erasing: the writes of the API.

use super::{JobRow, JobState, Queue};
use crate::db::now;
use sqlx::{Sqlite, Transaction};
use uuid::Uuid;

/// A job to accept; its input is in the store already.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// UUID v7.
    pub id: Uuid,
    /// Owner.
    pub tenant: String,
    /// plan.json text.
    pub plan: String,
    /// `sha256:` of the input's manifest.
    pub input_digest: String,
    /// Number of files.
    pub input_files: i64,
    /// Their size.
    pub input_bytes: i64,
    /// Trace of the request.
    pub trace_id: String,
    /// Idempotency-Key of the request.
    pub idempotency_key: Option<String>,
}

/// What became of a submission.
#[derive(Clone, Debug)]
pub enum Submitted {
    /// Accepted: committed and durable.
    New(Box<JobRow>),
    /// The key was used before with the same input and plan.
    Replayed(Box<JobRow>),
    /// The key was used before with another input or plan.
    Mismatch(Box<JobRow>),
}

/// Appends the event that tells a job's present row.
pub(super) async fn record(tx: &mut Transaction<'_, Sqlite>, id: &str, kind: &str) -> sqlx::Result<()> {
    sqlx::query(concat!(
        "INSERT INTO event (job, kind, state, stage, progress, eta_s, at) ",
        "SELECT id, $2, state, stage, progress, eta_s, ",
        now!(),
        " FROM job WHERE id = $1"
    ))
    .bind(id)
    .bind(kind)
    .execute(&mut **tx)
    .await?;
    Ok(())
}

impl Queue {
    /// Accepts a job. When this returns `New`, the job is on disk and will reach a final state.
    ///
    /// # Errors
    /// The database's.
    pub async fn submit(&self, job: &NewJob) -> sqlx::Result<Submitted> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        if let Some(key) = &job.idempotency_key {
            let earlier: Option<JobRow> =
                sqlx::query_as("SELECT * FROM job WHERE tenant = $1 AND idempotency_key = $2")
                    .bind(&job.tenant)
                    .bind(key)
                    .fetch_optional(&mut *tx)
                    .await?;
            if let Some(row) = earlier {
                let same = row.input_digest == job.input_digest && row.plan == job.plan;
                return Ok(if same { Submitted::Replayed(row.into()) } else { Submitted::Mismatch(row.into()) });
            }
        }
        let row = insert(&mut tx, job).await?;
        record(&mut tx, &row.id, "state").await?;
        tx.commit().await?;
        self.hint(job.id);
        Ok(Submitted::New(row.into()))
    }

    /// Cancels: a queued job at once, a running one by asking its worker (see the row's `cancel_requested`).
    /// A job in a final state is left alone. `None`: no such job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn cancel(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let ended = sqlx::query(concat!(
            "UPDATE job SET state = 'cancelled', cancel_requested = 1, revision = revision + 1, finished_at = ",
            now!(),
            " WHERE id = $1 AND tenant = $2 AND state = 'queued'"
        ))
        .bind(id.to_string())
        .bind(tenant)
        .execute(&mut *tx)
        .await?
        .rows_affected();
        if ended > 0 {
            record(&mut tx, &id.to_string(), "state").await?;
        } else {
            sqlx::query(
                "UPDATE job SET cancel_requested = 1, revision = revision + 1 \
                 WHERE id = $1 AND tenant = $2 AND state = 'running' AND cancel_requested = 0",
            )
            .bind(id.to_string())
            .bind(tenant)
            .execute(&mut *tx)
            .await?;
        }
        let row = one(&mut tx, tenant, id).await?;
        tx.commit().await?;
        self.hint(id);
        Ok(row)
    }

    /// Puts a failed job back into the queue with all its attempts. Returns the row after, or `None` when it is not
    /// a failed job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn retry(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let back = sqlx::query(concat!(
            "UPDATE job SET state = 'queued', attempt = 0, error = NULL, stage = NULL, progress = 0, eta_s = NULL, ",
            "cancel_requested = 0, started_at = NULL, finished_at = NULL, revision = revision + 1, run_at = ",
            now!(),
            " WHERE id = $1 AND tenant = $2 AND state = 'failed'"
        ))
        .bind(id.to_string())
        .bind(tenant)
        .execute(&mut *tx)
        .await?
        .rows_affected();
        if back == 0 {
            return Ok(None);
        }
        record(&mut tx, &id.to_string(), "state").await?;
        let row = one(&mut tx, tenant, id).await?;
        tx.commit().await?;
        self.hint(id);
        Ok(row)
    }

    /// Erases a job with its events and artefact rows. A worker that still runs it loses its lease at the next beat.
    /// Returns whether there was one.
    ///
    /// # Errors
    /// The database's.
    pub async fn erase(&self, tenant: &str, id: Uuid) -> sqlx::Result<bool> {
        let gone = sqlx::query("DELETE FROM job WHERE id = $1 AND tenant = $2")
            .bind(id.to_string())
            .bind(tenant)
            .execute(&self.db().writer)
            .await?
            .rows_affected();
        self.hint(id);
        Ok(gone > 0)
    }
}

async fn insert(tx: &mut Transaction<'_, Sqlite>, job: &NewJob) -> sqlx::Result<JobRow> {
    sqlx::query_as(concat!(
        "INSERT INTO job (id, tenant, kind, state, plan, input_digest, input_files, input_bytes, trace_id, ",
        "idempotency_key, run_at, created_at) VALUES ($1, $2, 'reconstruction', $3, $4, $5, $6, $7, $8, $9, ",
        now!(),
        ", ",
        now!(),
        ") RETURNING *"
    ))
    .bind(job.id.to_string())
    .bind(&job.tenant)
    .bind(JobState::Queued)
    .bind(&job.plan)
    .bind(&job.input_digest)
    .bind(job.input_files)
    .bind(job.input_bytes)
    .bind(&job.trace_id)
    .bind(&job.idempotency_key)
    .fetch_one(&mut **tx)
    .await
}

async fn one(tx: &mut Transaction<'_, Sqlite>, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
    sqlx::query_as("SELECT * FROM job WHERE id = $1 AND tenant = $2")
        .bind(id.to_string())
        .bind(tenant)
        .fetch_optional(&mut **tx)
        .await
}
