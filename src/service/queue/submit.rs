//! Accepting, cancelling, retrying and erasing: the writes of the API.

use super::{AGEING_MS, JobRow, JobState, Queue};
use crate::db::{Db, Scope, Sizes, Tx, Value, args, placeholders};
use std::collections::BTreeMap;
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
        let db = self.db().clone();
        let write = move |jobs: Vec<NewJob>| {
            let db = db.clone();
            async move { new(&db, jobs).await }
        };
        let submitted = match self.news.call(job.clone(), |a, b| a.tenant == b.tenant, write).await? {
            Some(row) => Submitted::New(row.into()),
            None => self.submit_keyed(job).await?,
        };
        if matches!(submitted, Submitted::New(_)) {
            self.hint(job.id);
        }
        Ok(submitted)
    }

    /// Accepts a job whose key another one has, or had until a moment ago.
    async fn submit_keyed(&self, job: &NewJob) -> sqlx::Result<Submitted> {
        match self.submit_once(job).await {
            // Another request with the same key was faster: now its job is there to be found.
            Err(sqlx::Error::RowNotFound) => self.submit_once(job).await,
            other => other,
        }
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

/// Jobs of one tenant that are new, in their order; `None` for one whose idempotency key was used before.
async fn new(db: &Db, jobs: Vec<NewJob>) -> sqlx::Result<Vec<Option<JobRow>>> {
    let Some(tenant) = jobs.first().map(|job| job.tenant.clone()) else { return Ok(Vec::new()) };
    let work = db.write(Scope::Tenant(&tenant), move |tx| {
        Box::pin(async move {
            let mut rows = insert(tx, &jobs).await?;
            Ok(jobs.iter().map(|job| rows.remove(&job.id.to_string())).collect())
        })
    });
    work.await
}

/// The row of a new job. Whoever calls has looked for its idempotency key: one that is there by now is
/// [`sqlx::Error::RowNotFound`], at which the request begins again.
pub(super) async fn inserted(tx: &mut Tx<'_>, job: &NewJob) -> sqlx::Result<JobRow> {
    insert(tx, std::slice::from_ref(job)).await?.remove(&job.id.to_string()).ok_or(sqlx::Error::RowNotFound)
}

const COLUMNS: usize = 13;
static INSERT: Sizes = Sizes::new(|jobs| {
    let values = placeholders(jobs, COLUMNS);
    format!(
        "WITH new (n_id, n_tenant, n_kind, n_priority, n_plan, n_digest, n_files, n_bytes, n_memory, n_trace, n_key, n_ahead, \
         n_parent, n_row) AS (VALUES {values}) \
         INSERT INTO job (id, tenant, kind, state, priority, plan, input_digest, input_files, input_bytes, memory_mb, trace_id, \
         idempotency_key, rank, run_at, created_at, parent) \
         SELECT n_id, n_tenant, n_kind, 'queued', n_priority, n_plan, n_digest, n_files, n_bytes, n_memory, n_trace, n_key, \
         now_ms() - n_ahead, now_ms(), now_ms(), n_parent FROM new WHERE n_row = 1 \
         ON CONFLICT (tenant, idempotency_key) WHERE idempotency_key IS NOT NULL DO NOTHING RETURNING *"
    )
});

/// Inserts jobs but those whose idempotency key is there already; the new ones by their ids.
async fn insert(tx: &mut Tx<'_>, jobs: &[NewJob]) -> sqlx::Result<BTreeMap<String, JobRow>> {
    let mut rows = BTreeMap::new();
    for (sql, values) in INSERT.over(&jobs.iter().map(values).collect::<Vec<_>>()) {
        for row in tx.rows(sql, values).await? {
            let row = JobRow::of(&row)?;
            rows.insert(row.id.clone(), row);
        }
    }
    Ok(rows)
}

fn values(job: &NewJob) -> [Value; COLUMNS] {
    [
        Value::from(job.id),
        Value::from(&job.tenant),
        Value::from(if is_variant(&job.plan) { "variant" } else { "reconstruction" }),
        Value::from(job.priority),
        Value::from(&job.plan),
        Value::from(&job.input_digest),
        Value::from(job.input_files),
        Value::from(job.input_bytes),
        Value::from(job.memory_mb),
        Value::from(&job.trace_id),
        Value::from(&job.idempotency_key),
        Value::from(job.priority.saturating_mul(AGEING_MS)),
        Value::from(job.parent.map(|id| id.to_string())),
    ]
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
