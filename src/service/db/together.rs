//! Reads of single rows that many callers want at the same time, as one statement.
//!
//! A read costs four round trips under row level security on PostgreSQL, some 60 us of processor here, whatever it reads
//! (SQLite's cost less since docs/adr/0074). So while as many batches as [`BATCHES`] are under way, further callers
//! wait together, and the first whose turn comes asks for all of them. A lonely caller waits for nobody. What a caller
//! gets was read after it asked, so nobody sees anything older than without this.

use super::line::Line;
use std::collections::BTreeMap;
use tokio::sync::Semaphore;

/// Statements at the same time; more would only make each smaller.
const BATCHES: usize = 2;

/// Callers that wait for rows by their keys.
#[derive(Debug)]
pub(crate) struct Together<K, V> {
    line: Line<K, Option<V>>,
    turns: Semaphore,
}

impl<K, V> Default for Together<K, V> {
    fn default() -> Self {
        Self { line: Line::default(), turns: Semaphore::new(BATCHES) }
    }
}

impl<K: Ord + Clone, V: Clone> Together<K, V> {
    /// The row of a key. `alike` says which other keys may be asked for with this one; `read` asks for all of them.
    ///
    /// # Errors
    /// What `read` says.
    pub(crate) async fn row<F>(
        &self,
        key: K,
        alike: impl Fn(&K, &K) -> bool,
        read: impl Fn(Vec<K>) -> F,
    ) -> sqlx::Result<Option<V>>
    where
        F: Future<Output = sqlx::Result<BTreeMap<K, V>>>,
    {
        let mut answer = self.line.join(key.clone());
        let told = loop {
            let turn = tokio::select! {
                biased;
                told = &mut answer => break told,
                turn = self.turns.acquire() => turn.map_err(|_| sqlx::Error::PoolClosed)?,
            };
            let batch = self.line.take(&alike);
            if batch.is_empty() {
                // Ours is under way with another batch: taking turns on and on would only keep a processor busy.
                drop(turn);
                break answer.await;
            }
            let mut keys: Vec<K> = batch.iter().map(|(key, _)| key.clone()).collect();
            keys.sort_unstable();
            keys.dedup();
            let rows = read(keys).await?;
            for (key, sender) in batch {
                // An error means that the caller went away.
                let _ = sender.send(rows.get(&key).cloned());
            }
        };
        match told {
            Ok(row) => Ok(row),
            // Whoever asked for us met a fault or went away: ask for ourselves.
            Err(_) => Ok(read(vec![key.clone()]).await?.remove(&key)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::MOST;
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    #[tokio::test(flavor = "multi_thread")]
    async fn many_callers_are_one_read_and_each_gets_its_own() {
        let (together, reads) = (Together::<u32, String>::default(), AtomicUsize::new(0));
        let read = |keys: Vec<u32>| {
            reads.fetch_add(1, Ordering::Relaxed);
            assert!(keys.len() <= MOST);
            async move {
                tokio::time::sleep(Duration::from_millis(5)).await;
                // Odd numbers have no row.
                Ok(keys.into_iter().filter(|k| k % 2 == 0).map(|k| (k, k.to_string())).collect())
            }
        };
        let calls = (0..200).map(|k| together.row(k % 50, |a, b| a % 3 == b % 3, read));
        let rows = futures::future::join_all(calls).await;
        for (k, row) in (0_u32..).zip(rows) {
            let k = k % 50;
            assert_eq!(row.unwrap(), (k % 2 == 0).then(|| k.to_string()));
        }
        let reads = reads.load(Ordering::Relaxed);
        assert!(reads <= 12, "{reads} reads for 200 callers");
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_caller_that_goes_away_takes_nobody_with_it() {
        let together = Together::<u32, u32>::default();
        let slow = |keys: Vec<u32>| async move {
            tokio::time::sleep(Duration::from_millis(50)).await;
            Ok(keys.into_iter().map(|k| (k, k)).collect())
        };
        let all = |_: &u32, _: &u32| true;
        let hasty = tokio::time::timeout(Duration::from_millis(10), together.row(1, all, slow));
        let patient = futures::future::join_all((2..20).map(|k| together.row(k, all, slow)));
        let (gone, rows) = tokio::join!(hasty, patient);
        assert!(gone.is_err());
        for (k, row) in (2..20).zip(rows) {
            assert_eq!(row.unwrap(), Some(k));
        }
        let failing = |_: Vec<u32>| async { Err(sqlx::Error::PoolClosed) };
        let failed = futures::future::join_all((0..9).map(|k| together.row(k, all, failing))).await;
        assert!(failed.into_iter().all(|row| row.is_err()));
    }
}
