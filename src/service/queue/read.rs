//! Reading: one job, pages of jobs, events, artefacts, counts. Every read of a request names the tenant.

use super::{ArtefactRow, EventRow, JobRow, JobState, Queue};
use crate::db::{MOST, Scope, Value, args};
use std::collections::BTreeMap;
use uuid::Uuid;

const ONE: &str = "SELECT * FROM job WHERE tenant = $1 AND id = $2";
const SOME: &str = "SELECT * FROM job WHERE tenant = $1 AND id IN ($2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, \
    $14, $15, $16, $17, $18, $19, $20, $21, $22, $23, $24, $25, $26, $27, $28, $29, $30, $31, $32, $33)";

/// Which jobs to list, newest first.
#[derive(Clone, Debug, Default)]
pub struct Page {
    /// Only this state.
    pub state: Option<JobState>,
    /// Only jobs that take this one's scan or result.
    pub parent: Option<Uuid>,
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
        let same_tenant = |a: &(String, String), b: &(String, String)| a.0 == b.0;
        self.asked.row((tenant.to_owned(), id.to_string()), same_tenant, |keys| self.named(keys)).await
    }

    /// Jobs of one tenant by tenant and id.
    async fn named(&self, keys: Vec<(String, String)>) -> sqlx::Result<BTreeMap<(String, String), JobRow>> {
        let (Some((tenant, last)), many) = (keys.last(), keys.len() > 1) else { return Ok(BTreeMap::new()) };
        let mut values = args![tenant];
        values.extend(keys.iter().map(|(_, id)| Value::from(id)));
        if many {
            // The statement has always the same number of arguments, so that it is prepared once.
            values.resize(1 + MOST, Value::from(last));
        }
        let rows = self.db().rows(Scope::Tenant(tenant), if many { SOME } else { ONE }, values).await?;
        rows.iter().map(|row| JobRow::of(row).map(|job| ((job.tenant.clone(), job.id.clone()), job))).collect()
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
            _ if page.parent.is_some() => {
                let parent = page.parent.map(|id| id.to_string()).unwrap_or_default();
                values.extend(args![parent, page.state.map_or("", JobState::as_str)]);
                "SELECT * FROM job WHERE tenant = $1 AND id < $2 AND parent = $4 AND ($5 = '' OR state = $5) \
                 ORDER BY id DESC LIMIT $3"
            }
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
