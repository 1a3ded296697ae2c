//! Finished jobs with their result.json, for tables of many.

use super::{ArtefactRow, Queue};
use crate::db::{Row, Scope, args};
use uuid::Uuid;

/// Which finished jobs, newest first.
#[derive(Clone, Debug)]
pub struct Finished {
    /// Created at this time or later, ms since 1970.
    pub after: i64,
    /// Created before this time, ms since 1970.
    pub before: i64,
    /// The job's kind; empty for all.
    pub kind: &'static str,
    /// At most so many.
    pub limit: i64,
}

/// A finished job and its result.json.
#[derive(Clone, Debug)]
pub struct ResultRow {
    /// The job's id.
    pub job: String,
    /// Its kind.
    pub kind: String,
    /// Accepted, ms since 1970.
    pub created_at: i64,
    /// Its result.json.
    pub artefact: ArtefactRow,
}

impl ResultRow {
    fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            job: row.get("id")?,
            kind: row.get("kind")?,
            created_at: row.get("created_at")?,
            artefact: ArtefactRow::of(row)?,
        })
    }
}

const ONE: &str = "SELECT job.id, job.kind, job.created_at, name, media_type, bytes, digest, object_key \
    FROM job JOIN artefact ON artefact.job = job.id AND artefact.name = 'result.json' \
    WHERE tenant = $1 AND job.id = $2 AND state = 'succeeded'";
const MANY: &str = "SELECT job.id, job.kind, job.created_at, name, media_type, bytes, digest, object_key \
    FROM job JOIN artefact ON artefact.job = job.id AND artefact.name = 'result.json' \
    WHERE tenant = $1 AND state = 'succeeded' AND created_at >= $2 AND created_at < $3 AND ($4 = '' OR kind = $4) \
    ORDER BY job.id DESC LIMIT $5";

impl Queue {
    /// Finished jobs of this tenant that have a result.json.
    ///
    /// # Errors
    /// The database's.
    pub async fn finished(&self, tenant: &str, wanted: &Finished) -> sqlx::Result<Vec<ResultRow>> {
        let values = args![tenant, wanted.after, wanted.before, wanted.kind, wanted.limit];
        self.db().rows(Scope::Tenant(tenant), MANY, values).await?.iter().map(ResultRow::of).collect()
    }

    /// A finished job of this tenant, if it has a result.json.
    ///
    /// # Errors
    /// The database's.
    pub async fn finished_job(&self, tenant: &str, id: Uuid) -> sqlx::Result<Option<ResultRow>> {
        self.db().row(Scope::Tenant(tenant), ONE, args![tenant, id]).await?.as_ref().map(ResultRow::of).transpose()
    }
}
