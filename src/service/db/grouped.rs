//! Writes that many callers want at the same time, as one statement in one transaction.
//!
//! The fixed cost of a write on PostgreSQL (messages, planning, triggers, the commit) is many times that of a further row in
//! the same statement. So while as many groups as there may be are under way, further callers wait together, and the next group takes
//! up to [`super::MOST`] of them. A lonely caller waits for nobody, and everybody hears after the commit of its own group.
//!
//! A group runs as a task of its own: a caller that goes away takes nobody with it. Where the database refuses a group
//! (a constraint, a deadlock), each of its callers is asked for alone, so that one bad call fails by itself.

use super::line::{Line, Waiting};
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Callers that wait for their writes.
#[derive(Debug)]
pub(crate) struct Grouped<A, R> {
    line: Line<A, sqlx::Result<R>>,
    turns: Arc<Semaphore>,
}

impl<A, R> Grouped<A, R> {
    /// For so many groups at the same time.
    pub(crate) fn new(groups: usize) -> Self {
        Self { line: Line::default(), turns: Arc::new(Semaphore::new(groups)) }
    }
}

impl<A: Clone + Send + 'static, R: Send + 'static> Grouped<A, R> {
    /// The answer to a call. `alike` says which other calls may be in one group with this one; `write` answers a group, in
    /// the order of its calls.
    ///
    /// # Errors
    /// What `write` says of this call.
    pub(crate) async fn call<F>(
        self: &Arc<Self>,
        call: A,
        alike: impl Fn(&A, &A) -> bool,
        write: impl Fn(Vec<A>) -> F + Clone + Send + Sync + 'static,
    ) -> sqlx::Result<R>
    where
        F: Future<Output = sqlx::Result<Vec<R>>> + Send + 'static,
    {
        let mut answer = self.line.join(call);
        let told = loop {
            let turn = tokio::select! {
                biased;
                told = &mut answer => break told,
                turn = Arc::clone(&self.turns).acquire_owned() => turn.map_err(|_| sqlx::Error::PoolClosed)?,
            };
            let group = self.line.take(&alike);
            if group.is_empty() {
                // Ours is under way with another group.
                drop(turn);
                break answer.await;
            }
            tokio::spawn(Arc::clone(self).answer(group, write.clone(), turn));
        };
        told.map_err(|_| sqlx::Error::WorkerCrashed)?
    }

    async fn answer<F>(
        self: Arc<Self>,
        group: Waiting<A, sqlx::Result<R>>,
        write: impl Fn(Vec<A>) -> F + Send + Sync,
        turn: OwnedSemaphorePermit,
    ) where
        F: Future<Output = sqlx::Result<Vec<R>>> + Send,
    {
        let (calls, senders): (Vec<A>, Vec<_>) = group.into_iter().unzip();
        let mut answers = Vec::with_capacity(calls.len());
        match write(calls.clone()).await {
            Ok(all) => answers.extend(all.into_iter().map(Ok)),
            Err(sqlx::Error::Database(_)) if calls.len() > 1 => {
                for call in calls {
                    answers.push(write(vec![call]).await.and_then(|one| one.into_iter().next().ok_or_else(unanswered)));
                }
            }
            Err(error) => {
                if super::is_away(&error) {
                    // Those who wait would find the same out, one group after the other.
                    for (_, sender) in self.line.take_all() {
                        let _ = sender.send(Err(super::copy(&error)));
                    }
                }
                answers.extend(calls.iter().skip(1).map(|_| Err(super::copy(&error))));
                answers.push(Err(error));
            }
        }
        drop(turn);
        let mut answers = answers.into_iter();
        for sender in senders {
            // An error means that the caller went away.
            let _ = sender.send(answers.next().unwrap_or_else(|| Err(unanswered())));
        }
    }
}

fn unanswered() -> sqlx::Error {
    sqlx::Error::Protocol("a write was not answered".into())
}

#[cfg(test)]
mod tests {
    use super::super::MOST;
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    /// Doubles each number; refuses a group that holds 13 as a database refuses a row, and the number by itself too.
    async fn doubled(numbers: Vec<u32>) -> sqlx::Result<Vec<u32>> {
        tokio::time::sleep(Duration::from_millis(5)).await;
        if numbers.contains(&13) {
            return Err(super::super::statement::fault(rusqlite::Error::SqliteFailure(
                rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_CONSTRAINT),
                None,
            )));
        }
        Ok(numbers.into_iter().map(|n| 2 * n).collect())
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn many_callers_are_few_writes_and_each_gets_its_own_answer() {
        static WRITES: AtomicUsize = AtomicUsize::new(0);
        let grouped = Arc::new(Grouped::<u32, u32>::new(2));
        let write = |numbers: Vec<u32>| {
            WRITES.fetch_add(1, Ordering::Relaxed);
            assert!(numbers.len() <= MOST);
            assert!(numbers.iter().all(|n| n % 2 == numbers.first().map_or(0, |first| first % 2)));
            doubled(numbers)
        };
        let answers = (100..400).map(|n| grouped.call(n, |a, b| a % 2 == b % 2, write));
        for (n, answer) in (100..400).zip(futures::future::join_all(answers).await) {
            assert_eq!(answer.ok(), Some(2 * n));
        }
        let writes = WRITES.load(Ordering::Relaxed);
        assert!(writes <= 16, "{writes} writes for 300 callers");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_refused_call_fails_alone_and_one_that_went_away_takes_nobody_with_it() {
        let grouped = Arc::new(Grouped::<u32, u32>::new(2));
        let all = |_: &u32, _: &u32| true;
        let hasty = tokio::time::timeout(Duration::from_millis(1), grouped.call(99, all, doubled));
        let answers = futures::future::join_all((0..30).map(|n| grouped.call(n, all, doubled)));
        let (gone, answers) = tokio::join!(hasty, answers);
        assert!(gone.is_err());
        for (n, answer) in (0..30).zip(answers) {
            assert_eq!(answer.ok(), (n != 13).then_some(2 * n));
        }
        // A fault of the storage is everybody's: nothing is asked again.
        let away = |_: Vec<u32>| async { Err::<Vec<u32>, _>(sqlx::Error::PoolTimedOut) };
        let failed = futures::future::join_all((0..9).map(|n| grouped.call(n, all, away))).await;
        assert!(failed.into_iter().all(|answer| matches!(answer, Err(sqlx::Error::Io(_) | sqlx::Error::PoolTimedOut))));
    }
}
