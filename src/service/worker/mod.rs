//! Workers: claim a job, run it as a child process, publish what it made.
//!
//! One job is one process, so that a crash or an out-of-memory kill ends the job and never the service. Each slot is
//! an async task that only waits; beats come from an OS thread of their own ([`heartbeat`]), because a CPU-bound
//! neighbour on an async runtime has starved beats into a livelock in a peer (5 starts in 22 s, never done).
//!
//! Order of publishing: every artefact into the store with fsync, then one transaction that names them all. A worker
//! that lost its lease writes nothing more and drops what it stored.

mod child;
mod folder;
mod heartbeat;
mod isolation;
mod memory;
mod owner;

pub use heartbeat::Heartbeat;
pub use isolation::Isolation;
pub use memory::Memory;
pub(crate) use memory::expected_mb;
pub use owner::Owner;

use crate::config::Config;
use crate::error::Problem;
use crate::media::media_type;
use crate::queue::submit::is_variant;
use crate::queue::{ArtefactRow, Claim, Closing, JobState, Published, Queue, Verdict, WorkerRow};
use crate::store::{self, Store};
use crate::traces::{Course, Traces};
use child::{Child, Ended, Step};
use folder::Folder;
use heartbeat::Held;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// How often an idle slot looks at the table when no hint comes.
const POLL: Duration = Duration::from_secs(1);
/// Pause of a slot after a fault of the database.
const PAUSE: Duration = Duration::from_secs(2);

/// Between lines on the roll of workers.
const ROLL: Duration = Duration::from_secs(10);

/// What every slot shares.
#[derive(Debug)]
pub struct Worker {
    /// Settings.
    pub config: Arc<Config>,
    /// The table.
    pub queue: Queue,
    /// The artefacts.
    pub store: Store,
    /// The beats.
    pub heartbeat: Heartbeat,
    /// Who we are in `lease_owner`.
    pub owner: Arc<Owner>,
    /// What jobs may take together.
    pub memory: Memory,
    /// What the last job said to stand between it and the network.
    pub isolation: Isolation,
    /// Where traces go.
    pub traces: Traces,
    /// Ends everything.
    pub shutdown: CancellationToken,
}

impl Worker {
    /// One slot: claims and runs jobs until shutdown.
    pub async fn slot(self: Arc<Self>) {
        let mut changes = self.queue.changes();
        while !self.shutdown.is_cancelled() {
            match self.queue.claim(self.owner.name(), self.memory.room()).await {
                Ok(Some(claim)) => self.job(&claim).await,
                Ok(None) => tokio::select! {
                    () = self.shutdown.cancelled() => {}
                    _ = changes.recv() => {}
                    () = tokio::time::sleep(POLL) => {}
                },
                Err(error) => {
                    tracing::warn!(%error, "cannot claim");
                    tokio::select! {
                        () = self.shutdown.cancelled() => {}
                        () = tokio::time::sleep(PAUSE) => {}
                    }
                }
            }
        }
    }

    /// Runs one claimed job to its end.
    async fn job(&self, claim: &Claim) {
        let held = self.heartbeat.hold(claim.uuid(), claim.fence);
        let _share = self.memory.take(claim.memory_mb);
        tracing::info!(job = %claim.id, attempt = claim.attempt, trace_id = %claim.trace_id, "job starts");
        let mut course = self.traces.job(claim);
        let closing = match self.run(claim, &held, &mut course).await {
            Ok(closing) => closing,
            Err(error) => {
                tracing::error!(job = %claim.id, cause = %error, "job could not be run");
                Some(Closing::Crashed("the service could not run it".to_owned()))
            }
        };
        let state = self.end(claim, closing).await;
        course.ends(state.map_or("lost", JobState::as_str));
        drop(held);
    }

    /// `None`: the lease was lost on the way.
    async fn run(&self, claim: &Claim, held: &Held, course: &mut Course<'_>) -> anyhow::Result<Option<Closing>> {
        let folder = Folder::make(&self.owner, claim).await?;
        let input = folder.input();
        let fetch = || self.store.fetch_input(claim.uuid(), &claim.input_digest, &input);
        match self.patiently(claim, held, fetch).await {
            Ok(Some(())) => {}
            Ok(None) => return Ok(given_up(held.verdict())),
            Err(error) => {
                // Erased meanwhile, or cancelled: the lease says which.
                return match held.verdict_now().await {
                    Verdict::Run => Err(error.into()),
                    over => Ok(given_up(over)),
                };
            }
        }
        tokio::fs::write(folder.plan(), &claim.plan).await?;
        if let Err(error) = self.fetch_earlier(claim, &folder).await {
            // It would only have saved time.
            tracing::warn!(job = %claim.id, cause = %error, "what the earlier job left cannot be had");
        }
        let mut child = Child::start(&self.config, &folder, claim, self.memory.each())?;
        let ended = self.watch(&mut child, held, claim, course).await?;
        let closing = match ended {
            Some(Ended::Done) => match self.patiently(claim, held, || self.publish(claim, &folder)).await? {
                Some(closing) => Some(closing),
                None => given_up(held.verdict()),
            },
            Some(Ended::Problem(problem)) => Some(Closing::Failed(problem)),
            Some(Ended::Crashed(how)) => Some(Closing::Crashed(how)),
            Some(Ended::OutOfMemory) => Some(Closing::OutOfMemory(self.memory.each())),
            Some(Ended::Cancelled) => Some(Closing::Cancelled),
            Some(Ended::HandedBack) => Some(Closing::HandedBack),
            None => None,
        };
        folder.remove().await;
        Ok(closing)
    }

    /// What the store answers, asked for until it does: that it is away for a while must not cost a job one of its attempts, and
    /// a result that was computed is not thrown away for it. `None`: the job is cancelled or lost, or the service stops.
    async fn patiently<T, F>(&self, claim: &Claim, held: &Held, ask: impl Fn() -> F) -> Result<Option<T>, store::Error>
    where
        F: Future<Output = Result<T, store::Error>>,
    {
        let mut verdict = held.subscribe();
        let answer = async {
            loop {
                match ask().await {
                    Err(error) if error.is_away() => {
                        tracing::warn!(job = %claim.id, %error, "the store does not answer, trying again");
                        tokio::select! {
                            () = self.shutdown.cancelled() => return Ok(None),
                            () = tokio::time::sleep(PAUSE) => {}
                        }
                    }
                    answer => return answer.map(Some),
                }
            }
        };
        tokio::select! {
            _ = verdict.wait_for(|verdict| *verdict != Verdict::Run) => Ok(None),
            answer = answer => answer,
        }
    }

    /// What an earlier job on the same scan left for this one. A variant has another scan: none.
    async fn fetch_earlier(&self, claim: &Claim, folder: &Folder) -> anyhow::Result<()> {
        let Some(parent) = claim.parent.as_ref().filter(|_| !is_variant(&claim.plan)) else { return Ok(()) };
        let parent = uuid::Uuid::parse_str(parent)?;
        if self.queue.job(&claim.tenant, parent).await?.is_none() {
            return Ok(());
        }
        if let Some(found) = self.queue.artefact(parent, folder::FIELD).await? {
            let bytes = self.store.bytes(&found.object_key, &found.digest).await?;
            tokio::fs::write(folder.earlier(), &bytes).await?;
        }
        Ok(())
    }

    /// Waits for the child, passing its progress on, and kills it when the job is cancelled, lost or handed back.
    async fn watch(
        &self,
        child: &mut Child,
        held: &Held,
        claim: &Claim,
        course: &mut Course<'_>,
    ) -> anyhow::Result<Option<Ended>> {
        let mut changes = self.queue.changes();
        let mut verdict = held.subscribe();
        let longest = Duration::from_secs(self.config.job_seconds);
        let end = tokio::time::sleep(longest);
        tokio::pin!(end);
        loop {
            tokio::select! {
                line = child.next() => match line {
                    Some(Step { isolation: Some(barriers), .. }) => self.isolation.told(barriers),
                    Some(step) => {
                        step.stage.iter().for_each(|stage| course.enters(stage));
                        held.step(step);
                    }
                    None => return Ok(Some(child.end(&claim.id).await?)),
                },
                change = changes.recv() => {
                    if change.is_ok_and(|id| id == claim.uuid()) {
                        held.ask();
                    }
                }
                Ok(()) = verdict.changed() => {
                    let now = *verdict.borrow_and_update();
                    if now != Verdict::Run {
                        child.kill().await;
                        return Ok((now == Verdict::Cancel).then_some(Ended::Cancelled));
                    }
                }
                () = &mut end, if !longest.is_zero() => {
                    child.kill().await;
                    return Ok(Some(Ended::Problem(too_long(longest, &claim.id))));
                }
                () = self.shutdown.cancelled() => {
                    child.kill().await;
                    return Ok(Some(Ended::HandedBack));
                }
            }
        }
    }

    /// Keeps this worker on the roll until shutdown.
    pub async fn roll(self: Arc<Self>) {
        while !self.shutdown.is_cancelled() {
            let row = WorkerRow {
                id: self.owner.name().to_owned(),
                host: std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default().trim().to_owned(),
                version: env!("CARGO_PKG_VERSION").to_owned(),
                slots: i64::try_from(self.config.workers).unwrap_or(i64::MAX),
                busy: i64::try_from(self.heartbeat.held()).unwrap_or(i64::MAX),
                memory_mb: self.memory.all(),
                isolation: self.isolation.last(),
                started_at: 0,
                seen_at: 0,
            };
            if let Err(error) = self.queue.enrol(&row).await {
                tracing::warn!(%error, "not on the roll of workers");
            }
            tokio::select! {
                () = self.shutdown.cancelled() => {}
                () = self.isolation.changed() => {}
                () = tokio::time::sleep(ROLL) => {}
            }
        }
        if let Err(error) = self.queue.strike_off(self.owner.name()).await {
            tracing::debug!(%error, "still on the roll of workers, for a minute");
        }
    }

    /// Puts every file of the finished folder into the store.
    async fn publish(&self, claim: &Claim, folder: &Folder) -> Result<Closing, store::Error> {
        let mut artefacts = Vec::new();
        for (name, path) in folder.artefacts().await? {
            let bytes = tokio::fs::read(&path).await?;
            let size = i64::try_from(bytes.len()).unwrap_or(i64::MAX);
            let (object_key, digest) = self.store.put_artefact(claim.uuid(), claim.fence, &name, bytes).await?;
            artefacts.push(ArtefactRow {
                media_type: media_type(&name).to_owned(),
                name,
                bytes: size,
                digest,
                object_key,
            });
        }
        if artefacts.iter().all(|a| a.name != "result.json") {
            return Ok(Closing::Failed(Problem::new(
                axum::http::StatusCode::INTERNAL_SERVER_ERROR,
                "job.no_result",
                "The job's process ended well but left no result.json. This is a fault of the service: report it.",
            )));
        }
        Ok(Closing::Succeeded(Published { artefacts }))
    }

    /// Writes the end, trying again while the database is away, and drops the files of an attempt that did not count; the state that was
    /// reached.
    async fn end(&self, claim: &Claim, closing: Option<Closing>) -> Option<JobState> {
        let mut reached = None;
        if let Some(closing) = closing {
            loop {
                match self.queue.close(claim, &closing).await {
                    Ok(state) => {
                        reached = state;
                        break;
                    }
                    // At shutdown the lease simply runs out and the next start takes the job back.
                    Err(error) if self.shutdown.is_cancelled() => {
                        tracing::warn!(job = %claim.id, %error, "end not written, the job will be taken back");
                        return None;
                    }
                    Err(error) => {
                        tracing::warn!(job = %claim.id, %error, "end not written, trying again");
                        tokio::time::sleep(PAUSE).await;
                    }
                }
            }
        }
        tracing::info!(job = %claim.id, state = reached.map_or("lost", JobState::as_str), "job ends");
        let erased = match reached {
            Some(JobState::Succeeded) => return reached,
            // A cancelled job forgets its scan: nothing of it stays on disk.
            Some(JobState::Cancelled) => self.store.erase_job(claim.uuid()).await,
            _ => self.store.erase_attempt(claim.uuid(), claim.fence).await,
        };
        if let Err(error) = erased {
            tracing::warn!(job = %claim.id, %error, "files left behind; the sweep at the next start takes them");
        }
        reached
    }
}

/// How a hold ends that is given up before its job has ended.
fn given_up(verdict: Verdict) -> Option<Closing> {
    match verdict {
        Verdict::Run => Some(Closing::HandedBack),
        Verdict::Cancel => Some(Closing::Cancelled),
        Verdict::Lost => None,
    }
}

fn too_long(longest: Duration, job: &str) -> Problem {
    let detail = format!(
        "The job ran for {} seconds, the most that this service gives to one job. Send a smaller volume, or ask the \
         operator for more time.",
        longest.as_secs()
    );
    let mut problem = Problem::new(axum::http::StatusCode::UNPROCESSABLE_ENTITY, "job.time", detail);
    problem.instance = format!("/v1/jobs/{job}");
    problem
}
