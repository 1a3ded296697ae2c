//! The job table: every SQL statement about jobs, their events and their artefacts.
//!
//! A job moves queued -> running -> succeeded | failed | cancelled. A claim adds one to `fence` and `attempt`; every
//! later write of the worker carries `id`, `fence` and `state = 'running'`, and no row touched means that the lease
//! was lost: the worker stops and drops its files. Each change and its event commit together, so a reader who has
//! seen event N has seen everything before it; triggers on the row see to that, and to what follows an end (retention,
//! webhooks: migrations 0007 and 0008, docs/adr/0075). Rejected: the queue library apalis 1.0, which started a poison job of
//! two attempts five times and drained 38-68 times slower at 8,000 queued jobs.
//!
//! `submit`, `several`, `gather`, `read` and `results` serve the API, `claim` and `finish` the workers, `keep` retention and the workers' roll.

mod claim;
mod finish;
mod gather;
mod keep;
mod read;
mod results;
mod several;
pub(crate) mod submit;
mod types;

pub use claim::{Beat, Claim, Room, Verdict};
pub use finish::{Closing, Published};
pub use gather::Grown;
pub use keep::WorkerRow;
pub use read::{Counts, Page};
pub use results::{Finished, ResultRow};
pub use several::{MOST_TOGETHER, Together as Several};
pub use submit::{NewJob, Submitted};
pub use types::{ArtefactRow, EventRow, JobRow, JobState};

use crate::db::{Db, Grouped, Together};
use claim::Wanted;
use finish::End;
use std::sync::Arc;
use tokio::sync::{broadcast, mpsc};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// How long a claim holds without a beat (of which there is one a second), ms. A lost job is found within a beat and begun within
/// another second, a slot's look at the table: 12.1 s, of the 15 that are promised. A lease of 12 s with a look every 2 s came to 15.
pub const LEASE_MS: i64 = 10_000;
/// One step of priority is worth so much waiting, ms: a job of priority 0 passes a newer one of priority 10 after 10 min.
pub const AGEING_MS: i64 = 60_000;
/// Job ids buffered for a slow listener; one that lags reads the table anyway.
const HINTS: usize = 1024;
/// Groups of submissions at the same time: those of several tenants. Of claims and of ends there is one group: two of claims would want
/// the same jobs, and both fall apart into single calls where more are under way.
const SUBMISSIONS: usize = 4;
/// Hints to other processes go out together, this often at most.
const TELL: std::time::Duration = std::time::Duration::from_millis(10);
/// Between attempts to listen again.
const RELISTEN: std::time::Duration = std::time::Duration::from_secs(2);

/// The queue: the table plus a hint that a job changed. The table is the truth, the hint saves waiting.
#[derive(Clone, Debug)]
pub struct Queue {
    db: Db,
    hints: broadcast::Sender<Uuid>,
    told: broadcast::Sender<Uuid>,
    /// Callers that ask for single jobs at the same time, by tenant and id.
    asked: Arc<Together<(String, String), JobRow>>,
    /// Callers that submit, claim and end jobs at the same time.
    news: Arc<Grouped<NewJob, Option<JobRow>>>,
    claims: Arc<Grouped<Wanted, Option<Claim>>>,
    ends: Arc<Grouped<End, Option<JobState>>>,
}

impl Queue {
    /// A queue over an open database.
    pub fn new(db: Db) -> Self {
        Self::over(db, broadcast::Sender::new(HINTS), broadcast::Sender::new(HINTS))
    }

    /// The same table and hints through another connection (the heartbeat thread has its own).
    #[must_use]
    pub fn with_db(&self, db: Db) -> Self {
        Self::over(db, self.hints.clone(), self.told.clone())
    }

    fn over(db: Db, hints: broadcast::Sender<Uuid>, told: broadcast::Sender<Uuid>) -> Self {
        let (news, claims, ends) = (Grouped::new(SUBMISSIONS), Grouped::new(1), Grouped::new(1));
        Self { db, hints, told, asked: Arc::default(), news: news.into(), claims: claims.into(), ends: ends.into() }
    }

    /// The database under it.
    pub fn db(&self) -> &Db {
        &self.db
    }

    /// Ids of jobs that changed, from now on. May lag or miss changes of other processes: poll the table as well.
    pub fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.hints.subscribe()
    }

    /// Tells the listeners of this process that a job changed, and soon those of the others.
    pub(crate) fn hint(&self, id: Uuid) {
        // An error only means that nobody listens.
        let _ = self.hints.send(id);
        let _ = self.told.send(id);
    }

    /// Carries hints to and from other processes until the end. Hints may be lost; nothing depends on one.
    pub async fn carry_hints(self, shutdown: CancellationToken) {
        let tell = self.clone().tell();
        let hear = self.hear();
        tokio::select! {
            () = shutdown.cancelled() => {}
            () = async { tokio::join!(tell, hear); } => {}
        }
    }

    async fn tell(self) {
        let mut told = self.told.subscribe();
        loop {
            match told.recv().await {
                Ok(id) => {
                    tokio::time::sleep(TELL).await;
                    let mut ids = vec![id];
                    while let Ok(more) = told.try_recv() {
                        ids.push(more);
                    }
                    ids.sort_unstable();
                    ids.dedup();
                    if let Err(error) = self.db.tell(&ids).await {
                        tracing::debug!(%error, "hint not sent");
                    }
                }
                Err(broadcast::error::RecvError::Lagged(_)) => {}
                Err(broadcast::error::RecvError::Closed) => return,
            }
        }
    }

    async fn hear(&self) {
        let (sender, mut heard) = mpsc::unbounded_channel();
        let listen = async {
            loop {
                match self.db.listen(sender.clone()).await {
                    Ok(()) => std::future::pending::<()>().await,
                    Err(error) => tracing::warn!(%error, "not listening for hints; the table is polled"),
                }
                tokio::time::sleep(RELISTEN).await;
            }
        };
        let pass = async {
            while let Some(id) = heard.recv().await {
                // An error only means that nobody listens.
                let _ = self.hints.send(id);
            }
        };
        tokio::join!(listen, pass);
    }
}
