//! What the processes of jobs say to stand between them and the network, for the log and the roll of workers.

use std::sync::{Mutex, PoisonError};
use tokio::sync::Notify;

/// Longest word kept, characters.
const LONGEST: usize = 64;

/// The barriers of the last job.
#[derive(Debug, Default)]
pub struct Isolation {
    last: Mutex<Option<String>>,
    changes: Notify,
}

impl Isolation {
    /// Notes what a job said; a change goes to the log.
    pub(super) fn told(&self, barriers: String) {
        let barriers: String = barriers.chars().take(LONGEST).collect();
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if last.as_ref() != Some(&barriers) {
            match barriers.as_str() {
                "none" => tracing::warn!(
                    "jobs are NOT held back from the network: neither a namespace nor a filter of system calls is permitted here"
                ),
                _ => tracing::info!(%barriers, "jobs are held back from the network"),
            }
            self.changes.notify_one();
        }
        *last = Some(barriers);
    }

    /// Returns when the jobs' word has changed.
    pub(super) async fn changed(&self) {
        self.changes.notified().await;
    }

    /// What the last job said; `None` before the first.
    pub fn last(&self) -> Option<String> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}
