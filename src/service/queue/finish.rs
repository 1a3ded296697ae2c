//! Ending a job: one transaction each, guarded by id, fence and `state = 'running'`.

use super::submit::record;
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

async fn closed(tx: &mut Tx<'_>, claim: &Claim, closing: &Closing) -> sqlx::Result<Option<JobState>> {
    let held = "SELECT cancel_requested FROM job WHERE id = $1 AND fence = $2 AND state = 'running' FOR UPDATE";
    let Some(row) = tx.row(held, args![&claim.id, claim.fence]).await? else { return already(tx, claim).await };
    let (state, error) = outcome(claim, closing, row.flag("cancel_requested")?);
    let end = "UPDATE job SET state = $3, error = $4, lease_owner = NULL, lease_until = NULL, eta_s = NULL, \
        progress = CASE WHEN $3 = 'succeeded' THEN 1 WHEN $3 = 'queued' THEN 0 ELSE progress END, \
        stage = CASE WHEN $3 = 'failed' THEN stage END, result = $5, attempt = attempt - $6, run_at = now_ms() + $7, \
        finished_at = CASE WHEN $3 = 'queued' THEN NULL ELSE now_ms() END, revision = revision + 1 \
        WHERE id = $1 AND fence = $2 AND state = 'running'";
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
    tx.run(end, values).await?;
    if let (JobState::Succeeded, Closing::Succeeded(published)) = (state, closing) {
        for artefact in &published.artefacts {
            name_artefact(tx, &claim.id, artefact).await?;
        }
    }
    record(tx, &claim.id, "state").await?;
    if state.is_final() {
        settle(tx, &claim.id).await?;
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

/// What follows a final state, in its transaction: the end of the tenant's retention, and a message for each webhook.
pub(super) async fn settle(tx: &mut Tx<'_>, id: &str) -> sqlx::Result<()> {
    let keep = "UPDATE job SET expires_at = finished_at + \
                (SELECT retention_ms FROM tenant WHERE tenant.id = job.tenant) WHERE id = $1 \
                AND EXISTS (SELECT 1 FROM tenant WHERE tenant.id = job.tenant AND retention_ms IS NOT NULL)";
    tx.run(keep, args![id]).await?;
    let tell = "INSERT INTO outbox (id, webhook, body, run_at) \
        SELECT webhook.id || '.' || job.id || '.' || CAST(job.revision AS TEXT), webhook.id, \
        '{\"id\":\"' || job.id || '\",\"state\":\"' || job.state || '\",\"at\":' || CAST(job.finished_at AS TEXT) || '}', \
        now_ms() FROM job JOIN webhook ON webhook.tenant = job.tenant WHERE job.id = $1";
    tx.run(tell, args![id]).await?;
    Ok(())
}

fn outcome(claim: &Claim, closing: &Closing, cancel: bool) -> (JobState, Option<Problem>) {
    if cancel {
        return (JobState::Cancelled, None);
    }
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
