//! Several jobs in one request: all are accepted in one transaction, or none.
//!
//! An Idempotency-Key covers them all: the first job carries it, the others carry it with a blank and their number, which
//! no request can send as a key of its own.

use super::submit::inserted;
use super::{JobRow, NewJob, Queue};
use crate::db::{Scope, Tx, args};

/// Most jobs of one request.
pub const MOST_TOGETHER: usize = 100;

/// What became of a submission of several.
#[derive(Clone, Debug)]
pub enum Together {
    /// Accepted: all committed and durable.
    New(Vec<JobRow>),
    /// The key was used before with the same input and plans.
    Replayed(Vec<JobRow>),
    /// The key was used before with another input or other plans; one of those jobs.
    Mismatch(Box<JobRow>),
}

impl Queue {
    /// Accepts all of `jobs` or none. Their idempotency keys are taken from the first one's.
    ///
    /// # Errors
    /// The database's.
    pub async fn submit_together(&self, jobs: &[NewJob]) -> sqlx::Result<Together> {
        let submitted = match self.together_once(jobs).await {
            // Another request with the same key was faster: now its jobs are there to be found.
            Err(sqlx::Error::RowNotFound) => self.together_once(jobs).await?,
            other => other?,
        };
        if matches!(submitted, Together::New(_)) {
            jobs.iter().for_each(|job| self.hint(job.id));
        }
        Ok(submitted)
    }

    async fn together_once(&self, jobs: &[NewJob]) -> sqlx::Result<Together> {
        let Some(first) = jobs.first() else { return Ok(Together::New(Vec::new())) };
        let (tenant, jobs) = (first.tenant.clone(), jobs.to_vec());
        let work = self.db().write(Scope::Tenant(&tenant), move |tx| Box::pin(async move { accepted(tx, jobs).await }));
        work.await
    }
}

async fn accepted(tx: &mut Tx<'_>, jobs: Vec<NewJob>) -> sqlx::Result<Together> {
    let key = jobs.first().and_then(|job| job.idempotency_key.clone());
    if let (Some(key), Some(first)) = (&key, jobs.first()) {
        let mut found = earlier(tx, &first.tenant, key).await?;
        if found.first().is_some_and(|(number, _)| *number != 0) {
            // On PostgreSQL every statement sees what was committed before it: the other request committed between two of ours.
            // Now all of its jobs are there, but for those that were erased since.
            found = earlier(tx, &first.tenant, key).await?;
        }
        let same = found.len() == jobs.len() && jobs.iter().zip(&found).all(|(job, (_, row))| job.is_same(row));
        let in_order = found.iter().enumerate().all(|(k, (number, _))| k == *number);
        if same && in_order {
            return Ok(Together::Replayed(found.into_iter().map(|(_, row)| row).collect()));
        }
        if let Some((_, row)) = found.into_iter().next() {
            return Ok(Together::Mismatch(row.into()));
        }
    }
    let mut rows = Vec::new();
    for (number, mut job) in jobs.into_iter().enumerate() {
        job.idempotency_key = key.as_ref().map(|key| numbered(key, number));
        rows.push(inserted(tx, &job).await?);
    }
    Ok(Together::New(rows))
}

fn numbered(key: &str, number: usize) -> String {
    if number == 0 { key.to_owned() } else { format!("{key} {number}") }
}

const KEYED: &str = "SELECT * FROM job WHERE tenant = $1 AND idempotency_key = $2";

/// The jobs of an earlier request with this key, with their numbers in it.
async fn earlier(tx: &mut Tx<'_>, tenant: &str, key: &str) -> sqlx::Result<Vec<(usize, JobRow)>> {
    let mut found = Vec::new();
    for number in 0..MOST_TOGETHER {
        if let Some(row) = tx.row(KEYED, args![tenant, numbered(key, number)]).await? {
            found.push((number, JobRow::of(&row)?));
        }
    }
    Ok(found)
}

/// Whether the request that used this key made more jobs than one.
pub(super) async fn has_others(tx: &mut Tx<'_>, tenant: &str, key: &str) -> sqlx::Result<bool> {
    Ok(tx.row(KEYED, args![tenant, numbered(key, 1)]).await?.is_some())
}
