//! Jobs whose input comes in several requests (a series over DICOMweb).
//!
//! Such a job is queued from its first request on, with `run_at` a quiet time ahead; each further request puts its files
//! into the store, names the larger input in one guarded statement and moves `run_at` on. Once a worker has claimed the
//! job (its fence has grown) it takes nothing more, and what comes later begins another job.

use super::submit::{NewJob, accepted};
use super::{JobRow, Queue, Submitted};
use crate::db::{Scope, Tx, args};
use uuid::Uuid;

/// However the requests drip, a job begins after this, ms.
const LONGEST_MS: i64 = 3_600_000;

/// The input of a gathering job after a further request.
#[derive(Clone, Debug)]
pub struct Grown {
    /// Digest that the job names now.
    pub before: String,
    /// Digest of the larger input.
    pub digest: String,
    /// Number of files.
    pub files: i64,
    /// Their size.
    pub bytes: i64,
    /// Memory that the job is expected to need, MiB.
    pub memory_mb: i64,
}

impl Queue {
    /// The job that gathers a series and has not begun.
    ///
    /// # Errors
    /// The database's.
    pub async fn gathering(&self, tenant: &str, series: &str) -> sqlx::Result<Option<JobRow>> {
        let row = self.db().row(Scope::Tenant(tenant), OPEN, args![tenant, series]).await?;
        row.as_ref().map(JobRow::of).transpose()
    }

    /// Accepts a job that gathers a series and begins `quiet_ms` from now. `None`: another request was faster, and its
    /// job is there to be grown.
    ///
    /// # Errors
    /// The database's.
    pub async fn begin_gathering(&self, job: &NewJob, series: &str, quiet_ms: i64) -> sqlx::Result<Option<JobRow>> {
        let (new, series) = (job.clone(), series.to_owned());
        let begun = self.db().write(Scope::Tenant(&job.tenant), move |tx| {
            Box::pin(async move { begun(tx, &new, &series, quiet_ms).await })
        });
        let begun = begun.await?;
        if begun.is_some() {
            self.hint(job.id);
        }
        Ok(begun)
    }

    /// Names the larger input of a gathering job. `None`: the job has begun or ended, or another request grew it
    /// meanwhile: look again.
    ///
    /// # Errors
    /// The database's.
    pub async fn grow(&self, tenant: &str, id: Uuid, grown: &Grown, quiet_ms: i64) -> sqlx::Result<Option<JobRow>> {
        let (grown, owner) = (grown.clone(), tenant.to_owned());
        let row = self.db().write(Scope::Tenant(tenant), move |tx| {
            Box::pin(async move {
                let values = args![
                    id,
                    &owner,
                    &grown.before,
                    &grown.digest,
                    grown.files,
                    grown.bytes,
                    grown.memory_mb,
                    quiet_ms,
                    LONGEST_MS
                ];
                tx.row(GROW, values).await?.as_ref().map(JobRow::of).transpose()
            })
        });
        let row = row.await?;
        self.hint(id);
        Ok(row)
    }
}

const OPEN: &str = "SELECT job.* FROM gathering JOIN job ON job.id = gathering.job WHERE gathering.tenant = $1 \
    AND gathering.series = $2 AND job.state = 'queued' AND job.fence = 0";

const GROW: &str = "UPDATE job SET input_digest = $4, input_files = $5, input_bytes = $6, memory_mb = $7, \
    run_at = CASE WHEN now_ms() + $8 < created_at + $9 THEN now_ms() + $8 ELSE created_at + $9 END, \
    revision = revision + 1 WHERE id = $1 AND tenant = $2 AND state = 'queued' AND fence = 0 AND input_digest = $3 \
    RETURNING *";

async fn begun(tx: &mut Tx<'_>, job: &NewJob, series: &str, quiet_ms: i64) -> sqlx::Result<Option<JobRow>> {
    // The series' own row is locked first: of two requests with its first instances one begins the job.
    let place = "INSERT INTO gathering (tenant, series) VALUES ($1, $2) ON CONFLICT (tenant, series) DO NOTHING";
    tx.run(place, args![&job.tenant, series]).await?;
    let lock = "SELECT series FROM gathering WHERE tenant = $1 AND series = $2 FOR UPDATE";
    tx.row(lock, args![&job.tenant, series]).await?;
    if tx.row(OPEN, args![&job.tenant, series]).await?.is_some() {
        return Ok(None);
    }
    let Submitted::New(_) = accepted(tx, job).await? else { return Ok(None) };
    let wait = "UPDATE job SET run_at = now_ms() + $2 WHERE id = $1 RETURNING *";
    let row = tx.row(wait, args![job.id, quiet_ms]).await?.ok_or(sqlx::Error::RowNotFound)?;
    let name = "UPDATE gathering SET job = $3 WHERE tenant = $1 AND series = $2";
    tx.run(name, args![&job.tenant, series, job.id]).await?;
    Ok(Some(JobRow::of(&row)?))
}
