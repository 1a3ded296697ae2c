//! The job table: every SQL statement about jobs, their events and their artefacts.
//!
//! A job moves queued -> running -> succeeded | failed | cancelled. A claim adds one to `fence` and `attempt`; every
//! later write of the worker carries `id`, `fence` and `state = 'running'`, and no row touched means that the lease
//! was lost: the worker stops and drops its files. Each change and its event commit together, so a reader who has
//! seen event N has seen everything before it. Rejected: the queue library apalis 1.0, which started a poison job of
//! two attempts five times and drained 38-68 times slower at 8,000 queued jobs.
//!
//! `submit` and `read` serve the API, `claim` and `finish` the workers.

mod claim;
mod finish;
mod read;
mod submit;
mod types;

pub use claim::{Beat, Claim, Verdict};
pub use finish::{Closing, Published};
pub use read::{Counts, Page};
pub use submit::{NewJob, Submitted};
pub use types::{ArtefactRow, EventRow, JobRow, JobState};

use crate::db::Db;
use tokio::sync::broadcast;
use uuid::Uuid;

/// How long a claim holds without a beat, ms (service.md: a dead worker's job runs again within 15 s).
pub const LEASE_MS: i64 = 15_000;
/// Job ids buffered for a slow listener; one that lags reads the table anyway.
const HINTS: usize = 1024;

/// The queue: the table plus an in-process hint that a job changed. The table is the truth, the hint saves waiting.
#[derive(Clone, Debug)]
pub struct Queue {
    db: Db,
    hints: broadcast::Sender<Uuid>,
}

impl Queue {
    /// A queue over an open database.
    pub fn new(db: Db) -> Self {
        Self { db, hints: broadcast::Sender::new(HINTS) }
    }

    /// The same table and hints through another connection (the heartbeat thread has its own).
    #[must_use]
    pub fn with_db(&self, db: Db) -> Self {
        Self { db, hints: self.hints.clone() }
    }

    /// The database under it.
    pub fn db(&self) -> &Db {
        &self.db
    }

    /// Ids of jobs that changed, from now on. May lag or miss changes of other processes: poll the table as well.
    pub fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.hints.subscribe()
    }

    /// Tells the listeners of this process that a job changed.
    pub(crate) fn hint(&self, id: Uuid) {
        // An error only means that nobody listens.
        let _ = self.hints.send(id);
    }
}
