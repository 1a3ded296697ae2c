//! Ending a job: one transaction each, guarded by id, fence and `state = 'running'`.

use super::submit::record;
use super::{ArtefactRow, Claim, JobState, Queue};
use crate::db::now;
use crate::error::Problem;
use axum::http::StatusCode;

/// A crashed attempt waits this long times the square of its number, ms: a full disk or a passing shortage of memory
/// must not use up every attempt within a moment.
const BACKOFF_MS: i64 = 500;

/// What a successful job leaves.
#[derive(Clone, Debug)]
pub struct Published {
    /// Every artefact, in the store already.
    pub artefacts: Vec<ArtefactRow>,
}

/// How a worker ends its hold on a job.
#[derive(Clone, Debug)]
pub enum Closing {
    /// Done, with artefacts.
    Succeeded(Published),
    /// Ended with the job's own problem; not tried again.
    Failed(Problem),
    /// The child died without a word: tried again while attempts are left, then failed.
    Crashed(String),
    /// Ended by its owner.
    Cancelled,
    /// The server stops: back into the queue without counting this start.
    HandedBack,
}

/// The problem of a job whose process died at its last attempt.
pub(super) fn crashed(how: &str) -> Problem {
    Problem::new(
        StatusCode::INTERNAL_SERVER_ERROR,
        "job.crashed",
        format!(
            "The job's process died at every attempt ({how}). Retry it, or send a smaller volume if memory is short."
        ),
    )
}

impl Queue {
    /// Ends the hold. `None`: the lease was lost, nothing was written, the caller drops its files.
    /// A success that meets a cancel becomes a cancel; the state that was reached is returned.
    ///
    /// # Errors
    /// The database's; nothing was written.
    pub async fn close(&self, claim: &Claim, closing: &Closing) -> sqlx::Result<Option<JobState>> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let cancel: Option<bool> =
            sqlx::query_scalar("SELECT cancel_requested FROM job WHERE id = $1 AND fence = $2 AND state = 'running'")
                .bind(&claim.id)
                .bind(claim.fence)
                .fetch_optional(&mut *tx)
                .await?;
        let Some(cancel) = cancel else { return Ok(None) };
        let (state, error) = outcome(claim, closing, cancel);
        sqlx::query(concat!(
            "UPDATE job SET state = $3, error = $4, lease_owner = NULL, lease_until = NULL, eta_s = NULL, ",
            "progress = CASE $3 WHEN 'succeeded' THEN 1 WHEN 'queued' THEN 0 ELSE progress END, ",
            "stage = CASE $3 WHEN 'failed' THEN stage END, result = $5, attempt = attempt - $6, run_at = ",
            now!(),
            " + $7, ",
            "finished_at = CASE $3 WHEN 'queued' THEN NULL ELSE ",
            now!(),
            " END, revision = revision + 1 WHERE id = $1 AND fence = $2 AND state = 'running'"
        ))
        .bind(&claim.id)
        .bind(claim.fence)
        .bind(state)
        .bind(error.map(|e| e.body()))
        .bind(result_json(closing))
        .bind(i64::from(matches!(closing, Closing::HandedBack)))
        .bind(if matches!(closing, Closing::Crashed(_)) { BACKOFF_MS * claim.attempt * claim.attempt } else { 0 })
        .execute(&mut *tx)
        .await?;
        if let (JobState::Succeeded, Closing::Succeeded(published)) = (state, closing) {
            for artefact in &published.artefacts {
                name_artefact(&mut tx, &claim.id, artefact).await?;
            }
        }
        record(&mut tx, &claim.id, "state").await?;
        tx.commit().await?;
        self.hint(claim.uuid());
        Ok(Some(state))
    }
}

fn outcome(claim: &Claim, closing: &Closing, cancel: bool) -> (JobState, Option<Problem>) {
    if cancel {
        return (JobState::Cancelled, None);
    }
    match closing {
        Closing::Succeeded(_) => (JobState::Succeeded, None),
        Closing::Failed(problem) => (JobState::Failed, Some(problem.clone())),
        Closing::Crashed(how) if claim.attempt >= claim.max_attempts => (JobState::Failed, Some(crashed(how))),
        Closing::Crashed(_) | Closing::HandedBack => (JobState::Queued, None),
        Closing::Cancelled => (JobState::Cancelled, None),
    }
}

/// The digest of result.json, kept in the row so that results can be compared without the store.
fn result_json(closing: &Closing) -> Option<String> {
    let Closing::Succeeded(published) = closing else { return None };
    let result = published.artefacts.iter().find(|a| a.name == "result.json")?;
    Some(serde_json::json!({"digest": result.digest, "bytes": result.bytes}).to_string())
}

async fn name_artefact(
    tx: &mut sqlx::Transaction<'_, sqlx::Sqlite>,
    job: &str,
    artefact: &ArtefactRow,
) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT INTO artefact (job, name, media_type, bytes, digest, object_key) VALUES ($1, $2, $3, $4, $5, $6)",
    )
    .bind(job)
    .bind(&artefact.name)
    .bind(&artefact.media_type)
    .bind(artefact.bytes)
    .bind(&artefact.digest)
    .bind(&artefact.object_key)
    .execute(&mut **tx)
    .await?;
    Ok(())
}
