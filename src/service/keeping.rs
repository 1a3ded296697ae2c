//! What keeps the house: the orphan sweep of the store, and the end of retention.
//!
//! An object that no row names does not exist for readers; it is left by an upload that broke off before its commit or
//! by an attempt that did not count. On one machine nothing older than this start can still be in flight; where several
//! machines share the store, an object counts as an orphan only after
//! `Config::sweep_seconds` from the making of its job's id.

use crate::config::Config;
use crate::queue::{JobState, Queue};
use crate::store::Store;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// Between looks for jobs whose retention is over.
const RETENTION: Duration = Duration::from_secs(60);
/// Between sweeps of the store.
const SWEEP: Duration = Duration::from_secs(3600);
/// No upload is between its first object and its row for longer.
const LONGEST_UPLOAD: Duration = Duration::from_secs(3600);
/// Jobs erased in one go.
const BATCH: i64 = 100;

/// Sweeps at start and every hour, and erases what is past its time, until shutdown. `start` is a moment before this
/// process took its first request: an upload has its objects before it has its row, and must not be taken for an orphan.
pub(crate) async fn keep(
    queue: Queue,
    store: Store,
    config: Arc<Config>,
    start: SystemTime,
    shutdown: CancellationToken,
) {
    let grace = Duration::from_secs(config.sweep_seconds);
    let first = if config.is_shared() { start.checked_sub(grace) } else { Some(start) };
    sweep(&queue, &store, first).await;
    let mut swept = tokio::time::Instant::now();
    while !shutdown.is_cancelled() {
        if swept.elapsed() >= SWEEP {
            sweep(&queue, &store, SystemTime::now().checked_sub(grace.max(LONGEST_UPLOAD))).await;
            swept = tokio::time::Instant::now();
        }
        if let Err(error) = crate::uploads::retire(queue.db(), &config.data_dir).await {
            tracing::warn!(%error, "uploads past their time wait");
        }
        if let Err(error) = retire(&queue, &store).await {
            tracing::warn!(%error, "retention waits");
        }
        tokio::select! {
            () = shutdown.cancelled() => {}
            () = tokio::time::sleep(RETENTION) => {}
        }
    }
}

/// Erases the jobs whose retention is over.
async fn retire(queue: &Queue, store: &Store) -> anyhow::Result<()> {
    loop {
        let over = queue.expired(BATCH).await?;
        for (tenant, id) in &over {
            queue.erase(tenant, *id).await?;
            store.erase_job(*id).await?;
            tracing::info!(job = %id, "erased at the end of its retention");
        }
        if over.is_empty() {
            return Ok(());
        }
    }
}

/// Removes stored files that no job names. A job's age is that of its id (UUID v7).
async fn sweep(queue: &Queue, store: &Store, before: Option<SystemTime>) {
    let before = before.and_then(|at| at.duration_since(UNIX_EPOCH).ok()).unwrap_or_default().as_millis();
    let stored = match store.jobs().await {
        Ok(jobs) => jobs,
        Err(error) => return tracing::warn!(%error, "cannot sweep the store"),
    };
    for job in stored.into_iter().filter(|job| made_ms(*job) < before) {
        let swept = match queue.is_known(job).await {
            Ok(None | Some(JobState::Cancelled)) => store.erase_job(job).await,
            Ok(Some(JobState::Succeeded | JobState::Failed)) => sweep_attempts(queue, store, job).await,
            Ok(Some(JobState::Queued | JobState::Running)) | Err(_) => Ok(()),
        };
        if let Err(error) = swept {
            tracing::warn!(%job, %error, "cannot sweep");
        }
    }
}

/// When a UUID v7 was made, ms since 1970.
fn made_ms(id: Uuid) -> u128 {
    id.as_u128() >> 80
}

/// Removes the files of attempts that the ended job does not name.
async fn sweep_attempts(queue: &Queue, store: &Store, job: Uuid) -> Result<(), crate::store::Error> {
    let Ok(named) = queue.artefacts(job).await else { return Ok(()) };
    for fence in store.attempts(job).await? {
        let prefix = format!("jobs/{job}/artefacts/{fence}/");
        if !named.iter().any(|row| row.object_key.starts_with(&prefix)) {
            store.erase_attempt(job, fence).await?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::db::Db;

    #[tokio::test]
    async fn an_upload_on_its_way_is_no_orphan_and_an_old_one_is() {
        let folder = tempfile::TempDir::new().unwrap();
        let config = Config { data_dir: folder.path().to_owned(), ..Config::default() };
        let queue = Queue::new(Db::open(&config).await.unwrap());
        let store = Store::open(&config).unwrap();
        let files = vec![("a".to_owned(), b"x".to_vec())];
        let job = Uuid::now_v7();
        store.put_input(job, &Store::describe(&files), files).await.unwrap();
        let made = UNIX_EPOCH + Duration::from_millis(u64::try_from(made_ms(job)).unwrap());
        sweep(&queue, &store, Some(made)).await;
        assert_eq!(store.jobs().await.unwrap(), [job]);
        // What a kill leaves between writing and renaming goes too.
        std::fs::write(folder.path().join(format!("store/jobs/{job}/input/000001#1")), b"scan").unwrap();
        sweep(&queue, &store, Some(made + Duration::from_millis(1))).await;
        assert!(store.jobs().await.unwrap().is_empty());
        assert!(!folder.path().join(format!("store/jobs/{job}")).exists());
    }
}
