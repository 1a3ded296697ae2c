//! Ending jobs, guarded by id, fence and `state = 'running'`: one transaction for all ends that wait at the same time.

use super::{ArtefactRow, Claim, JobState, Queue};
use crate::db::{Scope, Sizes, Tx, Value, args, placeholders};
use crate::error::Problem;
use axum::http::StatusCode;
use std::collections::BTreeMap;

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
        let db = self.db().clone();
        let write = move |ends: Vec<End>| {
            let db = db.clone();
            async move {
                let work = db.write(Scope::System, move |tx| Box::pin(async move { closed(tx, &ends).await }));
                work.await
            }
        };
        let state = self.ends.call(End::of(claim, closing), |_, _| true, write).await?;
        if state.is_some() {
            self.hint(claim.uuid());
        }
        Ok(state)
    }
}

/// The end of one hold.
#[derive(Clone, Debug)]
pub(super) struct End {
    id: String,
    fence: i64,
    state: JobState,
    error: Option<String>,
    result: Option<String>,
    is_handed_back: bool,
    pause_ms: i64,
    artefacts: Vec<ArtefactRow>,
}

impl End {
    fn of(claim: &Claim, closing: &Closing) -> Self {
        let (state, error) = outcome(claim, closing);
        let pause_ms = if matches!(closing, Closing::Crashed(_) | Closing::OutOfMemory(_)) {
            BACKOFF_MS * claim.attempt * claim.attempt
        } else {
            0
        };
        Self {
            id: claim.id.clone(),
            fence: claim.fence,
            state,
            error: error.map(|e| e.body()),
            result: result_json(closing),
            is_handed_back: matches!(closing, Closing::HandedBack),
            pause_ms,
            artefacts: match closing {
                Closing::Succeeded(published) => published.artefacts.clone(),
                _ => Vec::new(),
            },
        }
    }

    fn values(&self) -> [Value; 7] {
        [
            Value::from(&self.id),
            Value::from(self.fence),
            Value::from(self.state.as_str()),
            Value::from(&self.error),
            Value::from(&self.result),
            Value::from(self.is_handed_back),
            Value::from(self.pause_ms),
        ]
    }
}

/// A cancel that comes in between wins, so the statement itself looks whether there is one.
const END: &str = "UPDATE job SET state = CASE WHEN cancel_requested = 1 THEN 'cancelled' ELSE e_state END, \
    error = CASE WHEN cancel_requested = 0 THEN e_error END, result = CASE WHEN cancel_requested = 0 THEN e_result END, \
    stage = CASE WHEN cancel_requested = 0 AND e_state = 'failed' THEN stage END, \
    progress = CASE WHEN cancel_requested = 1 THEN progress WHEN e_state = 'succeeded' THEN 1 WHEN e_state = 'queued' THEN 0 \
        ELSE progress END, \
    finished_at = CASE WHEN cancel_requested = 1 OR e_state <> 'queued' THEN now_ms() END, \
    lease_owner = NULL, lease_until = NULL, eta_s = NULL, attempt = attempt - e_back, run_at = now_ms() + e_pause, \
    revision = revision + 1 FROM ended WHERE e_row = 1 AND id = e_id AND fence = e_fence AND state = 'running' RETURNING id, fence, state";
static ENDS: Sizes = Sizes::new(|holds| {
    let values = placeholders(holds, 7);
    format!("WITH ended (e_id, e_fence, e_state, e_error, e_result, e_back, e_pause, e_row) AS (VALUES {values}) {END}")
});

/// Ends holds in one transaction; the state that each reached, in their order.
async fn closed(tx: &mut Tx<'_>, ends: &[End]) -> sqlx::Result<Vec<Option<JobState>>> {
    let mut order: Vec<&End> = ends.iter().collect();
    // Rows are locked in one order by everybody who locks several.
    order.sort_by(|a, b| a.id.cmp(&b.id));
    let mut reached: BTreeMap<(String, i64), JobState> = BTreeMap::new();
    for (sql, values) in ENDS.over(&order.into_iter().map(End::values).collect::<Vec<_>>()) {
        for row in tx.rows(sql, values).await? {
            reached.insert((row.get("id")?, row.get("fence")?), JobState::of(row.get("state")?)?);
        }
    }
    let of = |end: &End| reached.get(&(end.id.clone(), end.fence)).copied();
    let done = |end: &&End| end.state == JobState::Succeeded && of(end) == Some(JobState::Succeeded);
    name_artefacts(tx, ends.iter().filter(done)).await?;
    let mut states = Vec::with_capacity(ends.len());
    for end in ends {
        states.push(match of(end) {
            Some(state) => Some(state),
            None => already(tx, end).await?,
        });
    }
    Ok(states)
}

/// The state in which this very hold ended earlier, if it did. A commit whose answer was lost (the database stopped, the
/// connection broke) is asked for again: it must not look like a lost lease, or the worker would drop files that the
/// table names. The kill storm found that. Every claim and rescue raises the fence, so an equal fence is this hold's.
async fn already(tx: &mut Tx<'_>, end: &End) -> sqlx::Result<Option<JobState>> {
    let ended = "SELECT state FROM job WHERE id = $1 AND fence = $2";
    let row = tx.row(ended, args![&end.id, end.fence]).await?;
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

static NAMES: Sizes = Sizes::new(|artefacts| {
    let values = placeholders(artefacts, 6);
    format!(
        "WITH named (a_job, a_name, a_media, a_bytes, a_digest, a_key, a_row) AS (VALUES {values}) \
         INSERT INTO artefact (job, name, media_type, bytes, digest, object_key) \
         SELECT a_job, a_name, a_media, a_bytes, a_digest, a_key FROM named WHERE a_row = 1"
    )
});

async fn name_artefacts<'e>(tx: &mut Tx<'_>, ends: impl Iterator<Item = &'e End>) -> sqlx::Result<()> {
    let of = |job: &str, a: &ArtefactRow| {
        [
            Value::from(job),
            Value::from(&a.name),
            Value::from(&a.media_type),
            Value::from(a.bytes),
            Value::from(&a.digest),
            Value::from(&a.object_key),
        ]
    };
    let named: Vec<_> = ends.flat_map(|end| end.artefacts.iter().map(move |a| of(&end.id, a))).collect();
    for (sql, values) in NAMES.over(&named) {
        tx.run(sql, values).await?;
    }
    Ok(())
}
