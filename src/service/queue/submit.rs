//! Accepting, cancelling, retrying and erasing: the writes of the API.

use super::{AGEING_MS, JobRow, JobState, Queue};
use crate::db::{Scope, Tx, args};
use uuid::Uuid;

/// Jobs that one bulk cancel takes in one transaction; the rest follows in the next.
const BULK: i64 = 500;
/// Priorities beyond this would let a job pass whole days of others.
pub(crate) const LARGEST_PRIORITY: i64 = 100;

/// A job to accept; its input is in the store already.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// UUID v7.
    pub id: Uuid,
    /// Owner.
    pub tenant: String,
    /// Higher runs earlier; 0 is usual.
    pub priority: i64,
    /// plan.json text.
    pub plan: String,
    /// `sha256:` of the input's manifest.
    pub input_digest: String,
    /// Number of files.
    pub input_files: i64,
    /// Their size.
    pub input_bytes: i64,
    /// Memory that the job is expected to need, MiB.
    pub memory_mb: i64,
    /// Trace of the request.
    pub trace_id: String,
    /// Idempotency-Key of the request.
    pub idempotency_key: Option<String>,
    /// The earlier job whose scan or result it takes.
    pub parent: Option<Uuid>,
}

impl NewJob {
    /// Whether an accepted job is of the same request.
    pub(super) fn is_same(&self, row: &JobRow) -> bool {
        row.input_digest == self.input_digest && row.plan == self.plan
    }
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

impl Queue {
    /// Accepts a job. When this returns `New`, the job is on disk and will reach a final state.
    ///
    /// # Errors
    /// The database's.
    pub async fn submit(&self, job: &NewJob) -> sqlx::Result<Submitted> {
        let submitted = match self.submit_once(job).await {
            // Another request with the same key was faster: now its job is there to be found.
            Err(sqlx::Error::Database(fault)) if fault.is_unique_violation() => self.submit_once(job).await?,
            other => other?,
        };
        if matches!(submitted, Submitted::New(_)) {
            self.hint(job.id);
        }
        Ok(submitted)
    }

    async fn submit_once(&self, job: &NewJob) -> sqlx::Result<Submitted> {
        let new = job.clone();
        self.db().write(Scope::Tenant(&job.tenant), move |tx| Box::pin(async move { accepted(tx, &new).await })).await
    }

    /// Cancels: a queued job at once, a running one by asking its worker (see the row's `cancel_requested`).
    /// A job in a final state is left alone. `None`: no such job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn cancel(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
        let owner = tenant.to_owned();
        let row = self
            .db()
            .write(Scope::Tenant(tenant), move |tx| {
                Box::pin(async move {
                    cancelled(tx, &owner, &id.to_string()).await?;
                    one(tx, &owner, id).await
                })
            })
            .await?;
        self.hint(id);
        Ok(row)
    }

    /// Cancels every job of a state (queued and running ones without it) that was created before `before` (ms since
    /// 1970; all without it). Returns the ids of those that are cancelled or being cancelled.
    ///
    /// # Errors
    /// The database's; jobs cancelled before the fault stay cancelled.
    pub async fn cancel_all(
        &self,
        tenant: &str,
        state: Option<JobState>,
        before: Option<i64>,
    ) -> sqlx::Result<Vec<Uuid>> {
        let words = match state {
            Some(state) if state.is_final() => return Ok(Vec::new()),
            Some(state) => [state.as_str(), state.as_str()],
            None => ["queued", "running"],
        };
        let mut ids: Vec<Uuid> = Vec::new();
        loop {
            let owner = tenant.to_owned();
            let some = self
                .db()
                .write(Scope::Tenant(tenant), move |tx| {
                    Box::pin(async move {
                        let pick = "SELECT id FROM job WHERE tenant = $1 AND state IN ($2, $3) AND cancel_requested = 0 \
                                    AND created_at < $4 ORDER BY id LIMIT $5 FOR UPDATE";
                        let values = args![&owner, words[0], words[1], before.unwrap_or(i64::MAX), BULK];
                        let mut ids = Vec::new();
                        for row in tx.rows(pick, values).await? {
                            let id: String = row.get("id")?;
                            cancelled(tx, &owner, &id).await?;
                            ids.extend(Uuid::parse_str(&id).ok());
                        }
                        Ok(ids)
                    })
                })
                .await?;
            some.iter().for_each(|id| self.hint(*id));
            let last = i64::try_from(some.len()).unwrap_or(BULK) < BULK;
            ids.extend(some);
            if last {
                return Ok(ids);
            }
        }
    }

    /// Puts a failed job back into the queue with all its attempts. Returns the row after, or `None` when it is not
    /// a failed job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn retry(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
        let owner = tenant.to_owned();
        let row = self
            .db()
            .write(Scope::Tenant(tenant), move |tx| {
                Box::pin(async move {
                    let back = "UPDATE job SET state = 'queued', attempt = 0, error = NULL, stage = NULL, progress = 0, \
                        eta_s = NULL, cancel_requested = 0, started_at = NULL, finished_at = NULL, expires_at = NULL, \
                        revision = revision + 1, run_at = now_ms() WHERE id = $1 AND tenant = $2 AND state = 'failed'";
                    if tx.run(back, args![id, &owner]).await? == 0 {
                        return Ok(None);
                    }
                    one(tx, &owner, id).await
                })
            })
            .await?;
        self.hint(id);
        Ok(row)
    }

    /// Moves a queued job within the queue. Returns the row after, or `None` when it is not a queued job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn prioritise(&self, tenant: &str, id: Uuid, priority: i64) -> sqlx::Result<Option<JobRow>> {
        let sql = "UPDATE job SET rank = rank - ($3 - priority) * $4, priority = $3, revision = revision + 1 \
                   WHERE id = $1 AND tenant = $2 AND state = 'queued' RETURNING *";
        let row = self.db().change(Scope::Tenant(tenant), sql, args![id, tenant, priority, AGEING_MS]).await?;
        self.hint(id);
        row.as_ref().map(JobRow::of).transpose()
    }

    /// Erases a job with its events and artefact rows. A worker that still runs it loses its lease at the next beat.
    /// Returns whether there was one.
    ///
    /// # Errors
    /// The database's.
    pub async fn erase(&self, tenant: &str, id: Uuid) -> sqlx::Result<bool> {
        let sql = "DELETE FROM job WHERE id = $1 AND tenant = $2";
        let gone = self.db().run(Scope::Tenant(tenant), sql, args![id, tenant]).await?;
        self.hint(id);
        Ok(gone > 0)
    }
}

pub(super) async fn accepted(tx: &mut Tx<'_>, job: &NewJob) -> sqlx::Result<Submitted> {
    if let Some(key) = &job.idempotency_key {
        let earlier = "SELECT * FROM job WHERE tenant = $1 AND idempotency_key = $2";
        if let Some(row) = tx.row(earlier, args![&job.tenant, key]).await? {
            let row = JobRow::of(&row)?;
            let same = job.is_same(&row) && !super::several::has_others(tx, &job.tenant, key).await?;
            return Ok(if same { Submitted::Replayed(row.into()) } else { Submitted::Mismatch(row.into()) });
        }
    }
    Ok(Submitted::New(inserted(tx, job).await?.into()))
}

pub(super) async fn inserted(tx: &mut Tx<'_>, job: &NewJob) -> sqlx::Result<JobRow> {
    let insert = "INSERT INTO job (id, tenant, kind, state, priority, plan, input_digest, input_files, input_bytes, \
        memory_mb, trace_id, idempotency_key, rank, run_at, created_at, parent) \
        VALUES ($1, $2, $12, 'queued', $3, $4, $5, $6, $7, $8, $9, $10, now_ms() - $11, now_ms(), now_ms(), $13) \
        RETURNING *";
    let values = args![
        job.id,
        &job.tenant,
        job.priority,
        &job.plan,
        &job.input_digest,
        job.input_files,
        job.input_bytes,
        job.memory_mb,
        &job.trace_id,
        &job.idempotency_key,
        job.priority.saturating_mul(AGEING_MS),
        if is_variant(&job.plan) { "variant" } else { "reconstruction" },
        job.parent.map(|id| id.to_string()),
    ];
    let row = tx.row(insert, values).await?.ok_or(sqlx::Error::RowNotFound)?;
    JobRow::of(&row)
}

/// Whether a plan asks for a re-synthesis in place of a scan's reconstruction.
pub(crate) fn is_variant(plan: &str) -> bool {
    serde_json::from_str::<serde_json::Value>(plan).is_ok_and(|p| !p["variant"].is_null())
}

/// Cancels a queued job, asks for the end of a running one, leaves others alone.
async fn cancelled(tx: &mut Tx<'_>, tenant: &str, id: &str) -> sqlx::Result<()> {
    let at_once = "UPDATE job SET state = 'cancelled', cancel_requested = 1, revision = revision + 1, \
                   finished_at = now_ms() WHERE id = $1 AND tenant = $2 AND state = 'queued'";
    if tx.run(at_once, args![id, tenant]).await? > 0 {
        return Ok(());
    }
    let ask = "UPDATE job SET cancel_requested = 1, revision = revision + 1 \
               WHERE id = $1 AND tenant = $2 AND state = 'running' AND cancel_requested = 0";
    tx.run(ask, args![id, tenant]).await?;
    Ok(())
}

async fn one(tx: &mut Tx<'_>, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
    let row = tx.row("SELECT * FROM job WHERE id = $1 AND tenant = $2", args![id, tenant]).await?;
    row.as_ref().map(JobRow::of).transpose()
}
