//! Reading: one job, pages of jobs, events, artefacts, counts. Every read names the tenant.

use super::{ArtefactRow, EventRow, JobRow, JobState, Queue};
use crate::db::now;
use sqlx::FromRow;
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
#[derive(Clone, Copy, Debug, Default, PartialEq, FromRow)]
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
        sqlx::query_as("SELECT * FROM job WHERE id = $1 AND tenant = $2")
            .bind(id.to_string())
            .bind(tenant)
            .fetch_optional(&self.db().reader)
            .await
    }

    /// A page of jobs, newest first, by key and never by offset.
    ///
    /// # Errors
    /// The database's.
    pub async fn jobs(&self, tenant: &str, page: &Page) -> sqlx::Result<Vec<JobRow>> {
        // Every id sorts below 'g': UUIDs are hexadecimal.
        let before = page.before.map_or_else(|| "g".to_owned(), |id| id.to_string());
        let query = match page.state {
            None => sqlx::query_as("SELECT * FROM job WHERE tenant = $1 AND id < $2 ORDER BY id DESC LIMIT $3"),
            Some(_) => sqlx::query_as(
                "SELECT * FROM job WHERE tenant = $1 AND id < $2 AND state = $4 ORDER BY id DESC LIMIT $3",
            ),
        };
        let query = query.bind(tenant).bind(before).bind(page.limit);
        match page.state {
            None => query,
            Some(state) => query.bind(state),
        }
        .fetch_all(&self.db().reader)
        .await
    }

    /// Events of a job after the event `after`, oldest first.
    ///
    /// # Errors
    /// The database's.
    pub async fn events(&self, id: Uuid, after: i64, limit: i64) -> sqlx::Result<Vec<EventRow>> {
        sqlx::query_as(
            "SELECT id, kind, state, stage, progress, eta_s, at FROM event WHERE job = $1 AND id > $2 ORDER BY id LIMIT $3",
        )
        .bind(id.to_string())
        .bind(after)
        .bind(limit)
        .fetch_all(&self.db().reader)
        .await
    }

    /// The artefacts of a job, by name.
    ///
    /// # Errors
    /// The database's.
    pub async fn artefacts(&self, id: Uuid) -> sqlx::Result<Vec<ArtefactRow>> {
        sqlx::query_as("SELECT name, media_type, bytes, digest, object_key FROM artefact WHERE job = $1 ORDER BY name")
            .bind(id.to_string())
            .fetch_all(&self.db().reader)
            .await
    }

    /// One artefact of a job.
    ///
    /// # Errors
    /// The database's.
    pub async fn artefact(&self, id: Uuid, name: &str) -> sqlx::Result<Option<ArtefactRow>> {
        sqlx::query_as("SELECT name, media_type, bytes, digest, object_key FROM artefact WHERE job = $1 AND name = $2")
            .bind(id.to_string())
            .bind(name)
            .fetch_optional(&self.db().reader)
            .await
    }

    /// Counts per state of one tenant, or of all with `None`.
    ///
    /// # Errors
    /// The database's.
    pub async fn counts(&self, tenant: Option<&str>) -> sqlx::Result<Counts> {
        sqlx::query_as(concat!(
            "SELECT COUNT(*) FILTER (WHERE state = 'queued') AS queued, ",
            "COUNT(*) FILTER (WHERE state = 'running') AS running, ",
            "COUNT(*) FILTER (WHERE state = 'succeeded') AS succeeded, ",
            "COUNT(*) FILTER (WHERE state = 'failed') AS failed, ",
            "COUNT(*) FILTER (WHERE state = 'cancelled') AS cancelled, ",
            "COALESCE(",
            now!(),
            " - MIN(created_at) FILTER (WHERE state = 'queued'), 0) AS oldest_queued_ms ",
            "FROM job WHERE $1 IS NULL OR tenant = $1"
        ))
        .bind(tenant)
        .fetch_one(&self.db().reader)
        .await
    }
}
