//! Reading: one job, pages of jobs, events, artefacts, counts. Every read of a request names the tenant.

use super::{ArtefactRow, EventRow, JobRow, JobState, Queue};
use crate::db::{Scope, args};
use uuid::Uuid;

/// Which jobs to list, newest first.
#[derive(Clone, Debug, Default)]
pub struct Page {
    /// Only this state.
    pub state: Option<JobState>,
    /// Only jobs older than this id.
    pub before: Option<Uuid>,
    /// At most so many.
    pub limit: i64,
}

/// How many jobs stand where.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Counts {
    /// Waiting.
    pub queued: i64,
    /// Held by a worker.
    pub running: i64,
    /// Done.
    pub succeeded: i64,
    /// Ended with an error.
    pub failed: i64,
    /// Ended by their owner.
    pub cancelled: i64,
    /// How long the oldest queued job has waited, ms; 0 without one.
    pub oldest_queued_ms: i64,
}

impl Queue {
    /// A job of this tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn job(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<JobRow>> {
        let row = self
            .db()
            .row(Scope::Tenant(tenant), "SELECT * FROM job WHERE id = $1 AND tenant = $2", args![id, tenant])
            .await?;
        row.as_ref().map(JobRow::of).transpose()
    }

    /// A page of jobs, newest first, by key and never by offset.
    ///
    /// # Errors
    /// The database's.
    pub async fn jobs(&self, tenant: &str, page: &Page) -> sqlx::Result<Vec<JobRow>> {
        // Every id sorts below 'g': UUIDs are hexadecimal.
        let before = page.before.map_or_else(|| "g".to_owned(), |id| id.to_string());
        let mut values = args![tenant, before, page.limit];
        let sql = match page.state {
            None => "SELECT * FROM job WHERE tenant = $1 AND id < $2 ORDER BY id DESC LIMIT $3",
            Some(state) => {
                values.extend(args![state.as_str()]);
                "SELECT * FROM job WHERE tenant = $1 AND id < $2 AND state = $4 ORDER BY id DESC LIMIT $3"
            }
        };
        self.db().rows(Scope::Tenant(tenant), sql, values).await?.iter().map(JobRow::of).collect()
    }

    /// Events of a job after the event `after`, oldest first. The caller has found the job under its tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn events(&self, id: Uuid, after: i64, limit: i64) -> sqlx::Result<Vec<EventRow>> {
        let sql = "SELECT id, kind, state, stage, progress, eta_s, at FROM event \
                   WHERE job = $1 AND id > $2 ORDER BY id LIMIT $3";
        self.db().rows(Scope::System, sql, args![id, after, limit]).await?.iter().map(EventRow::of).collect()
    }

    /// The artefacts of a job, by name. The caller has found the job under its tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn artefacts(&self, id: Uuid) -> sqlx::Result<Vec<ArtefactRow>> {
        let sql = "SELECT name, media_type, bytes, digest, object_key FROM artefact WHERE job = $1 ORDER BY name";
        self.db().rows(Scope::System, sql, args![id]).await?.iter().map(ArtefactRow::of).collect()
    }

    /// One artefact of a job. The caller has found the job under its tenant.
    ///
    /// # Errors
    /// The database's.
    pub async fn artefact(&self, id: Uuid, name: &str) -> sqlx::Result<Option<ArtefactRow>> {
        let sql = "SELECT name, media_type, bytes, digest, object_key FROM artefact WHERE job = $1 AND name = $2";
        self.db().row(Scope::System, sql, args![id, name]).await?.as_ref().map(ArtefactRow::of).transpose()
    }

    /// Counts per state of one tenant, or of all with `None`.
    ///
    /// # Errors
    /// The database's.
    pub async fn counts(&self, tenant: Option<&str>) -> sqlx::Result<Counts> {
        const COUNTS: &str = "SELECT state, COUNT(*) AS jobs, \
             CAST(COALESCE(now_ms() - MIN(created_at), 0) AS BIGINT) AS age_ms FROM job GROUP BY state";
        const OF_TENANT: &str = "SELECT state, COUNT(*) AS jobs, \
             CAST(COALESCE(now_ms() - MIN(created_at), 0) AS BIGINT) AS age_ms FROM job WHERE tenant = $1 GROUP BY state";
        let rows = match tenant {
            None => self.db().rows(Scope::System, COUNTS, Vec::new()).await?,
            Some(tenant) => self.db().rows(Scope::Tenant(tenant), OF_TENANT, args![tenant]).await?,
        };
        let mut counts = Counts::default();
        for row in &rows {
            let jobs = row.get("jobs")?;
            match JobState::of(row.get("state")?)? {
                JobState::Queued => {
                    counts.queued = jobs;
                    counts.oldest_queued_ms = row.get("age_ms")?;
                }
                JobState::Running => counts.running = jobs,
                JobState::Succeeded => counts.succeeded = jobs,
                JobState::Failed => counts.failed = jobs,
                JobState::Cancelled => counts.cancelled = jobs,
            }
        }
        Ok(counts)
    }

    /// Where a job stands, whoever owns it; `None` when there is none.
    ///
    /// # Errors
    /// The database's.
    pub async fn is_known(&self, id: Uuid) -> sqlx::Result<Option<JobState>> {
        let row = self.db().row(Scope::System, "SELECT state FROM job WHERE id = $1", args![id]).await?;
        row.map(|row| JobState::of(row.get("state")?)).transpose()
    }
}
