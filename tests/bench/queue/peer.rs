//! `bench-queue-peer JOBS`: apalis on SQLite, as it comes, drains so many queued no-op jobs with 64 at a time.

use anyhow::{Context as _, Result};
use apalis::prelude::*;
use apalis_sqlite::{SqlitePool, SqliteStorage};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Jobs that are worked on at the same time, as in our own bench.
const AT_ONCE: usize = 64;

#[tokio::main]
async fn main() -> Result<()> {
    let jobs: usize = std::env::args().nth(1).context("how many jobs?")?.parse()?;
    let folder = tempfile::TempDir::new()?;
    let file = folder.path().join("queue.sqlite");
    let pool = SqlitePool::connect(&format!("sqlite:{}?mode=rwc", file.display())).await?;
    SqliteStorage::setup(&pool).await.map_err(|e| anyhow::anyhow!("{e}"))?;
    let mut backend = SqliteStorage::new(&pool);
    for job in 0..jobs {
        backend.push(job as u64).await.map_err(|e| anyhow::anyhow!("{e}"))?;
    }
    let done = Arc::new(AtomicUsize::new(0));
    let begun = Instant::now();
    let work = move |_: u64, worker: WorkerContext, done: Data<Arc<AtomicUsize>>| async move {
        if done.fetch_add(1, Ordering::AcqRel) + 1 == jobs {
            worker.stop()?;
        }
        Ok::<(), BoxDynError>(())
    };
    let worker = WorkerBuilder::new("bench").backend(backend).data(Arc::clone(&done)).concurrency(AT_ONCE).build(work);
    worker.run().await.map_err(|e| anyhow::anyhow!("{e}"))?;
    println!("{:.0}", jobs as f64 / begun.elapsed().as_secs_f64());
    Ok(())
}
