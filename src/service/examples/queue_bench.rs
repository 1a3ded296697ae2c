//! The queue by itself, without children: `queue_bench sqlite|postgres [--large N | --drain N]` (`cargo xtask bench queue`).
//!
//! Shows durable no-op jobs per second (accepted, claimed, ended; each step committed and synced), the same drain with
//! 10^3 and with N (10^6) jobs queued, and the time from a job's acceptance to its start while the queue is quiet. `--drain` is
//! for comparisons: the jobs per second of N queued ones alone.

use anyhow::{Context as _, Result, bail};
use service::db::Db;
use service::queue::{ArtefactRow, Closing, NewJob, Published, Queue, Room};
use service::{Auth, Config};
use std::time::{Duration, Instant};
use uuid::Uuid;

#[path = "../tests/support/postgres.rs"]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, dead_code, unreachable_pub, missing_docs)]
mod postgres;

/// Callers at the same time, and slots of all workers together: what a busy service has.
const AT_ONCE: usize = 64;
/// Workers, each a queue of its own as a process has.
const WORKERS: usize = 4;
/// Jobs of one measurement.
const JOBS: usize = 4000;
/// Drains of 1,000 jobs at each length of the queue; the median is told.
const DRAINS: usize = 7;
/// Jobs whose start is timed.
const STARTS: usize = 300;

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let number = |name: &str| -> Result<Option<i64>> {
        let Some(at) = words.iter().position(|w| w == name) else { return Ok(None) };
        Ok(Some(words.get(at + 1).context("a number is missing")?.parse()?))
    };
    let kind = words.first().map_or("sqlite", String::as_str);
    let what = match number("--drain")? {
        Some(jobs) => What::Drain(usize::try_from(jobs)?),
        None => What::All { large: number("--large")?.unwrap_or(1_000_000) },
    };
    tokio::runtime::Runtime::new()?.block_on(bench(kind, what))
}

/// What is measured.
enum What {
    /// Everything, with so many queued in the large case.
    All { large: i64 },
    /// The drain of so many jobs.
    Drain(usize),
}

async fn bench(kind: &str, what: What) -> Result<()> {
    let folder = tempfile::TempDir::new()?;
    let mut config = Config { data_dir: folder.path().to_owned(), auth: Auth::None, ..Config::default() };
    let mut cluster = None;
    match kind {
        "sqlite" => {}
        "postgres" => {
            let server = postgres::cluster().context("PostgreSQL is not installed")?;
            config.database_url = Some(server.database());
            config.database_connections = 32;
            cluster = Some(server);
        }
        _ => bail!("sqlite or postgres"),
    }
    let queue = Queue::new(Db::open(&config).await?);
    let large = match what {
        What::All { large } => large,
        What::Drain(jobs) => {
            accept(&queue, jobs).await?;
            println!("{:.0}", rate(jobs, drain(&queue, jobs).await?));
            queue.db().close().await;
            return Ok(());
        }
    };
    let begun = Instant::now();
    accept(&queue, JOBS).await?;
    let accepted = begun.elapsed();
    let drained = drain(&queue, JOBS).await?;
    let whole = accepted + drained;
    println!(
        "{kind}: {:.0} no-op jobs/s ({:.0} accepted/s, {:.0} claimed and ended/s)",
        rate(JOBS, whole),
        rate(JOBS, accepted),
        rate(JOBS, drained)
    );
    let rest = |fill: &str| -> Result<()> {
        // The superuser is not held to the service's time for a statement; what the fill itself leaves to be written and
        // counted is not the drain's.
        if let Some(server) = cluster {
            for sql in [fill, "VACUUM ANALYZE", "CHECKPOINT"] {
                server.sql("v0", sql);
            }
        } else {
            let connection = rusqlite::Connection::open(config.database_file()?)?;
            connection.execute_batch(fill)?;
            connection.query_row("PRAGMA wal_checkpoint(TRUNCATE)", [], |_| Ok(()))?;
        }
        Ok(())
    };
    let (mut small, mut full) = (Vec::new(), Vec::new());
    for round in 0..DRAINS {
        rest(&fill(round, 1000))?;
        small.push(rate(1000, drain(&queue, 1000).await?));
    }
    rest(&fill(DRAINS, large))?;
    for _ in 0..DRAINS {
        full.push(rate(1000, drain(&queue, 1000).await?));
        rest("SELECT 1")?;
    }
    let (small, full) = (median(small), median(full));
    println!("{kind}: drain {small:.0}/s at 10^3 queued, {full:.0}/s at {large} ({:.0} %)", 100.0 * full / small);
    rest("DELETE FROM job WHERE state = 'queued'")?;
    let times = starts(&queue).await?;
    println!("{kind}: accepted to started p50 {:?}, p99 {:?}", times[times.len() / 2], times[times.len() * 99 / 100]);
    queue.db().close().await;
    Ok(())
}

#[allow(clippy::cast_precision_loss, reason = "counts are small")]
fn rate(jobs: usize, time: Duration) -> f64 {
    jobs as f64 / time.as_secs_f64()
}

fn job() -> NewJob {
    NewJob {
        id: Uuid::now_v7(),
        tenant: "default".to_owned(),
        priority: 0,
        plan: "{}".to_owned(),
        input_digest: "sha256:0".to_owned(),
        input_files: 1,
        input_bytes: 1,
        memory_mb: 0,
        trace_id: "0".to_owned(),
        idempotency_key: None,
        parent: None,
    }
}

async fn accept(queue: &Queue, jobs: usize) -> Result<()> {
    let callers: Vec<_> = (0..AT_ONCE)
        .map(|k| {
            let queue = queue.clone();
            tokio::spawn(async move {
                for _ in (k..jobs).step_by(AT_ONCE) {
                    queue.submit(&job()).await?;
                }
                anyhow::Ok(())
            })
        })
        .collect();
    for caller in callers {
        caller.await??;
    }
    Ok(())
}

async fn drain(queue: &Queue, jobs: usize) -> Result<Duration> {
    let begun = Instant::now();
    let workers: Vec<Queue> = (0..WORKERS).map(|_| Queue::new(queue.db().clone())).collect();
    let slots: Vec<_> = (0..AT_ONCE)
        .zip(workers.iter().cycle())
        .map(|(k, worker)| {
            let (owner, worker) = (format!("w{}", k % WORKERS), worker.clone());
            tokio::spawn(async move {
                let mut left = (k..jobs).step_by(AT_ONCE).count();
                while left > 0 {
                    let Some(claim) = worker.claim(&owner, Room::Any).await? else {
                        tokio::time::sleep(Duration::from_millis(1)).await;
                        continue;
                    };
                    worker.close(&claim, &success()).await?;
                    left -= 1;
                }
                anyhow::Ok(())
            })
        })
        .collect();
    for slot in slots {
        slot.await??;
    }
    Ok(begun.elapsed())
}

fn success() -> Closing {
    let artefact = ArtefactRow {
        name: "result.json".to_owned(),
        media_type: "application/json".to_owned(),
        bytes: 2,
        digest: "sha256:1".to_owned(),
        object_key: "k".to_owned(),
    };
    Closing::Succeeded(Published { artefacts: vec![artefact] })
}

/// A statement that queues jobs, in both databases' words. Their ids sort by their age, as those that the service makes (UUID v7):
/// where a job's neighbours in the queue were not its neighbours in the indexes (ids that end in 9, 10, 100, 11), a claim wrote
/// twice as many pages with 10^6 queued as with 10^3.
fn fill(round: usize, jobs: i64) -> String {
    format!(
        "INSERT INTO job (id, tenant, kind, state, plan, input_digest, input_files, input_bytes, trace_id, rank, run_at, \
         created_at) WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < {jobs}) \
         SELECT '01900000-0000-7000-8000-00{round:02}' || CAST(10000000 + k AS TEXT), 'default', 'r', 'queued', '{{}}', 'd', 1, \
         1, 't', k, 0, 0 FROM n"
    )
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Times from a caller's 202 to the claim of a worker that waits for hints, shortest first.
async fn starts(queue: &Queue) -> Result<Vec<Duration>> {
    let mut changes = queue.changes();
    let worker = queue.clone();
    let (started, mut times) = tokio::sync::mpsc::unbounded_channel();
    let task = tokio::spawn(async move {
        while changes.recv().await.is_ok() {
            while let Ok(Some(claim)) = worker.claim("w", Room::Any).await {
                let _ = started.send((claim.uuid(), Instant::now()));
            }
        }
    });
    let mut waits = Vec::new();
    for _ in 0..STARTS {
        let new = job();
        queue.submit(&new).await?;
        let accepted = Instant::now();
        let (_, at) = times.recv().await.context("the worker ended")?;
        waits.push(at.saturating_duration_since(accepted));
    }
    task.abort();
    waits.sort();
    Ok(waits)
}
