//! Claiming, beating and rescuing: how a job is held by exactly one worker.

use super::submit::record;
use super::{JobState, LEASE_MS, Queue};
use crate::db::now;
use sqlx::FromRow;
use uuid::Uuid;

/// A job that this worker holds until its lease runs out.
#[derive(Clone, Debug, FromRow)]
pub struct Claim {
    /// Job id.
    pub id: String,
    /// The number that every later write must carry.
    pub fence: i64,
    /// Which start this is, from 1.
    pub attempt: i64,
    /// Starts allowed.
    pub max_attempts: i64,
    /// plan.json text.
    pub plan: String,
    /// `sha256:` of the input's manifest.
    pub input_digest: String,
    /// Trace of the request that made the job.
    pub trace_id: String,
}

impl Claim {
    /// The id as a UUID (the table holds nothing else).
    pub fn uuid(&self) -> Uuid {
        Uuid::parse_str(&self.id).unwrap_or_default()
    }
}

/// What a worker tells at a beat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Beat {
    /// Stages entered since the last beat, oldest first.
    pub stages: Vec<String>,
    /// Stage that runs.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Seconds left.
    pub eta_s: Option<f64>,
    /// Whether progress changed since the last beat.
    pub moved: bool,
}

/// What a beat answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Go on.
    Run,
    /// The owner wants it ended.
    Cancel,
    /// Somebody else holds the job, or it was erased: stop and write nothing.
    Lost,
}

impl Queue {
    /// Claims the next job that may run, or `None`.
    ///
    /// # Errors
    /// The database's.
    pub async fn claim(&self, owner: &str) -> sqlx::Result<Option<Claim>> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let claim: Option<Claim> = sqlx::query_as(concat!(
            "UPDATE job SET state = 'running', attempt = attempt + 1, fence = fence + 1, lease_owner = $1, ",
            "stage = NULL, progress = 0, eta_s = NULL, revision = revision + 1, started_at = ",
            now!(),
            ", lease_until = ",
            now!(),
            " + $2 WHERE id = (SELECT id FROM job WHERE state = 'queued' AND run_at <= ",
            now!(),
            " ORDER BY priority DESC, id LIMIT 1) RETURNING *"
        ))
        .bind(owner)
        .bind(LEASE_MS)
        .fetch_optional(&mut *tx)
        .await?;
        if let Some(claim) = &claim {
            record(&mut tx, &claim.id, "state").await?;
            tx.commit().await?;
            self.hint(claim.uuid());
        }
        Ok(claim)
    }

    /// Renews the lease, writes the progress and reads whether the job is to end: one statement, plus its events.
    ///
    /// # Errors
    /// The database's.
    pub async fn beat(&self, id: Uuid, fence: i64, beat: &Beat) -> sqlx::Result<Verdict> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let cancel: Option<bool> = sqlx::query_scalar(concat!(
            "UPDATE job SET stage = $3, progress = $4, eta_s = $5, revision = revision + $6, lease_until = ",
            now!(),
            " + $7 WHERE id = $1 AND fence = $2 AND state = 'running' RETURNING cancel_requested"
        ))
        .bind(id.to_string())
        .bind(fence)
        .bind(&beat.stage)
        .bind(beat.progress)
        .bind(beat.eta_s)
        .bind(i64::from(beat.moved))
        .bind(LEASE_MS)
        .fetch_optional(&mut *tx)
        .await?;
        let Some(cancel) = cancel else { return Ok(Verdict::Lost) };
        for stage in &beat.stages {
            sqlx::query(concat!(
                "INSERT INTO event (job, kind, state, stage, progress, eta_s, at) VALUES ($1, 'stage', 'running', $2, $3, $4, ",
                now!(),
                ")"
            ))
            .bind(id.to_string())
            .bind(stage)
            .bind(beat.progress)
            .bind(beat.eta_s)
            .execute(&mut *tx)
            .await?;
        }
        if beat.moved && beat.stages.is_empty() {
            record(&mut tx, &id.to_string(), "progress").await?;
        }
        tx.commit().await?;
        if beat.moved {
            self.hint(id);
        }
        Ok(if cancel { Verdict::Cancel } else { Verdict::Run })
    }

    /// Takes jobs back whose lease ran out, and all jobs of `dead` owners at once. Those with attempts left are
    /// queued again, the others fail with `job.crashed`, a cancelled one is cancelled. Returns their ids.
    ///
    /// # Errors
    /// The database's.
    pub async fn rescue(&self, dead: &[String]) -> sqlx::Result<Vec<Uuid>> {
        let mut tx = self.db().writer.begin_with("BEGIN IMMEDIATE").await?;
        let mut lost: Vec<String> =
            sqlx::query_scalar(concat!("SELECT id FROM job WHERE state = 'running' AND lease_until < ", now!()))
                .fetch_all(&mut *tx)
                .await?;
        for owner in dead {
            let theirs: Vec<String> =
                sqlx::query_scalar("SELECT id FROM job WHERE state = 'running' AND lease_owner = $1")
                    .bind(owner)
                    .fetch_all(&mut *tx)
                    .await?;
            lost.extend(theirs);
        }
        for id in &lost {
            sqlx::query(concat!(
                "UPDATE job SET state = CASE WHEN cancel_requested THEN 'cancelled' ",
                "WHEN attempt >= max_attempts THEN 'failed' ELSE 'queued' END, ",
                "error = CASE WHEN cancel_requested = 0 AND attempt >= max_attempts THEN $2 END, ",
                "finished_at = CASE WHEN cancel_requested OR attempt >= max_attempts THEN ",
                now!(),
                " END, fence = fence + 1, lease_owner = NULL, lease_until = NULL, revision = revision + 1 ",
                "WHERE id = $1 AND state = 'running'"
            ))
            .bind(id)
            .bind(super::finish::crashed("its worker ended or lost its lease").body())
            .execute(&mut *tx)
            .await?;
            record(&mut tx, id, "state").await?;
        }
        tx.commit().await?;
        let ids: Vec<Uuid> = lost.iter().filter_map(|id| Uuid::parse_str(id).ok()).collect();
        for id in &ids {
            self.hint(*id);
        }
        Ok(ids)
    }

    /// Which of the given ids are jobs.
    ///
    /// # Errors
    /// The database's.
    pub async fn is_known(&self, id: Uuid) -> sqlx::Result<Option<JobState>> {
        sqlx::query_scalar("SELECT state FROM job WHERE id = $1")
            .bind(id.to_string())
            .fetch_optional(&self.db().reader)
            .await
    }
}
