//! Callers that wait in a line to be answered many at a time.

use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::oneshot;

/// Most calls of one statement: its arguments are written out.
pub(crate) const MOST: usize = 32;

/// What is waited for: a call, and where its answer goes.
pub(super) type Waiting<C, R> = Vec<(C, oneshot::Sender<R>)>;

/// The line.
#[derive(Debug)]
pub(super) struct Line<C, R>(Mutex<Waiting<C, R>>);

impl<C, R> Default for Line<C, R> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<C: Clone, R> Line<C, R> {
    /// At the end of the line; the answer comes by what is given back.
    pub(super) fn join(&self, call: C) -> oneshot::Receiver<R> {
        let (sender, answer) = oneshot::channel();
        self.lock().push((call, sender));
        answer
    }

    /// The first that waits and those like it, at most [`MOST`]; those whose caller went away are dropped.
    pub(super) fn take(&self, alike: impl Fn(&C, &C) -> bool) -> Waiting<C, R> {
        let mut waiting = self.lock();
        waiting.retain(|(_, sender)| !sender.is_closed());
        let Some(first) = waiting.first().map(|(call, _)| call.clone()) else { return Vec::new() };
        let mut left = MOST;
        waiting
            .extract_if(.., |(call, _)| {
                let taken = left > 0 && alike(&first, call);
                left -= usize::from(taken);
                taken
            })
            .collect()
    }

    /// All that wait.
    pub(super) fn take_all(&self) -> Waiting<C, R> {
        std::mem::take(&mut *self.lock())
    }

    fn lock(&self) -> MutexGuard<'_, Waiting<C, R>> {
        // Calls and senders are whole or not there.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
