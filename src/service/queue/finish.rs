//! Ending a job: one transaction each, guarded by id, fence and `state = 'running'`.

use super::{ArtefactRow, Claim, JobState, Queue};
use crate::db::{Scope, Tx, args};
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
    /// The child met its bound of memory, MiB: tried again while attempts are left, then failed.
    OutOfMemory(i64),
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

/// The problem of a job that met its bound of memory at its last attempt.
fn out_of_memory(bound_mb: i64) -> Problem {
    Problem::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "job.memory",
        format!(
            "The job needed more than the {bound_mb} MiB that it may take. Send a smaller volume, or ask the operator for a worker with more memory."
        ),
    )
}

impl Queue {
    /// Ends the hold; asked again after it ended, it answers the state of then and writes nothing. `None`: the lease was lost, nothing was written, the caller drops its files.
    /// A success that meets a cancel becomes a cancel; the state that was reached is returned.
    ///
    /// # Errors
    /// The database's; nothing was written.
    pub async fn close(&self, claim: &Claim, closing: &Closing) -> sqlx::Result<Option<JobState>> {
        let (held, end) = (claim.clone(), closing.clone());
        let state =
            self.db().write(Scope::System, move |tx| Box::pin(async move { closed(tx, &held, &end).await })).await?;
        if state.is_some() {
            self.hint(claim.uuid());
        }
        Ok(state)
    }
}

/// A cancel that comes in between wins, so the statement itself looks whether there is one.
const END: &str = "UPDATE job SET state = CASE WHEN cancel_requested = 1 THEN 'cancelled' ELSE $3 END, \
    error = CASE WHEN cancel_requested = 0 THEN $4 END, result = CASE WHEN cancel_requested = 0 THEN $5 END, \
    stage = CASE WHEN cancel_requested = 0 AND $3 = 'failed' THEN stage END, \
    progress = CASE WHEN cancel_requested = 1 THEN progress WHEN $3 = 'succeeded' THEN 1 WHEN $3 = 'queued' THEN 0 \
        ELSE progress END, \
    finished_at = CASE WHEN cancel_requested = 1 OR $3 <> 'queued' THEN now_ms() END, \
    lease_owner = NULL, lease_until = NULL, eta_s = NULL, attempt = attempt - $6, run_at = now_ms() + $7, \
    revision = revision + 1 WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING state";

async fn closed(tx: &mut Tx<'_>, claim: &Claim, closing: &Closing) -> sqlx::Result<Option<JobState>> {
    let (state, error) = outcome(claim, closing);
    let pause = if matches!(closing, Closing::Crashed(_) | Closing::OutOfMemory(_)) {
        BACKOFF_MS * claim.attempt * claim.attempt
    } else {
        0
    };
    let values = args![
        &claim.id,
        claim.fence,
        state.as_str(),
        error.map(|e| e.body()),
        result_json(closing),
        matches!(closing, Closing::HandedBack),
        pause,
    ];
    let Some(row) = tx.row(END, values).await? else { return already(tx, claim).await };
    let state = JobState::of(row.get("state")?)?;
    if let (JobState::Succeeded, Closing::Succeeded(published)) = (state, closing) {
        for artefact in &published.artefacts {
            name_artefact(tx, &claim.id, artefact).await?;
        }
    }
    Ok(Some(state))
}

/// The state in which this very hold ended earlier, if it did. A commit whose answer was lost (the database stopped, the
/// connection broke) is asked for again: it must not look like a lost lease, or the worker would drop files that the
/// table names. The kill storm found that. Every claim and rescue raises the fence, so an equal fence is this hold's.
async fn already(tx: &mut Tx<'_>, claim: &Claim) -> sqlx::Result<Option<JobState>> {
    let ended = "SELECT state FROM job WHERE id = $1 AND fence = $2";
    let row = tx.row(ended, args![&claim.id, claim.fence]).await?;
    row.map(|row| JobState::of(row.get("state")?)).transpose()
}

/// What a hold's end makes of a job that nobody cancels.
fn outcome(claim: &Claim, closing: &Closing) -> (JobState, Option<Problem>) {
    match closing {
        Closing::Succeeded(_) => (JobState::Succeeded, None),
        Closing::Failed(problem) => (JobState::Failed, Some(problem.clone())),
        Closing::Crashed(how) if claim.attempt >= claim.max_attempts => (JobState::Failed, Some(crashed(how))),
        Closing::OutOfMemory(bound) if claim.attempt >= claim.max_attempts => {
            (JobState::Failed, Some(out_of_memory(*bound)))
        }
        Closing::Crashed(_) | Closing::OutOfMemory(_) | Closing::HandedBack => (JobState::Queued, None),
        Closing::Cancelled => (JobState::Cancelled, None),
    }
}

/// The digest of result.json, kept in the row so that results can be compared without the store.
fn result_json(closing: &Closing) -> Option<String> {
    let Closing::Succeeded(published) = closing else { return None };
    let result = published.artefacts.iter().find(|a| a.name == "result.json")?;
    Some(serde_json::json!({"digest": result.digest, "bytes": result.bytes}).to_string())
}

async fn name_artefact(tx: &mut Tx<'_>, job: &str, artefact: &ArtefactRow) -> sqlx::Result<()> {
    let sql = "INSERT INTO artefact (job, name, media_type, bytes, digest, object_key) VALUES ($1, $2, $3, $4, $5, $6)";
    let values =
        args![job, &artefact.name, &artefact.media_type, artefact.bytes, &artefact.digest, &artefact.object_key];
    tx.run(sql, values).await?;
    Ok(())
}
