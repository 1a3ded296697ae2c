//! SQLite: the embedded default, one file, with group commit.
//!
//! WAL with `synchronous = FULL`: a commit is on disk before anybody hears of it (NORMAL may lose the last commits at a
//! loss of power). One fsync costs 1 to 8 ms here, so one per job gave 123-646 jobs/s; the writer therefore takes every
//! unit of work that waits into one transaction. Each unit has a savepoint of its own, so that one that fails leaves
//! nothing and the others stand. The writer lives on a thread of its own: neither a busy runtime nor a long reader can
//! hold it back. It never waits for company: while one commit syncs, the next group gathers by itself.
//!
//! Statements run on the thread that asks, the writer's or the reader's (docs/adr/0074): sqlx keeps a thread for each
//! connection, and two changes of thread per statement cost an idle machine more than the statement. A read that goes on
//! for more than [`QUICK`] steps is begun again where it may block. sqlx still applies the migrations.

use super::statement::{fault, is_interruption, rows, run};
use super::{Database, Output, Row, Scope, Tx, Value, Version, Work, copy, migration_fault, unboxed};
use anyhow::Context as _;
use async_trait::async_trait;
use rusqlite::{Connection, OpenFlags};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions as _, Connection as _};
use std::ffi::c_int;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc::{Receiver, Sender, UnboundedSender, channel};
use tokio::sync::{Semaphore, oneshot};
use uuid::Uuid;

/// Connections that only read.
const READERS: usize = 4;
/// How long a writer waits for a writer of another process.
const BUSY: Duration = Duration::from_secs(5);
/// Units of work in one commit. At 256 the fsync is below a tenth of the group's time here; more only adds latency.
const GROUP: usize = 256;
/// Units that may wait before senders wait too.
const WAITING: usize = 4096;
/// Steps of SQLite's machine that a read may take on a thread of the runtime, about a millisecond.
const QUICK: c_int = 50_000;
/// Statements that a connection keeps prepared.
const PREPARED: usize = 128;

static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("../../migrations/sqlite");

struct Unit {
    work: Work,
    reply: oneshot::Sender<sqlx::Result<Output>>,
}

/// One SQLite file.
#[derive(Debug)]
pub(super) struct Sqlite {
    file: PathBuf,
    readers: Arc<Readers>,
    units: Sender<Unit>,
    /// Held by everyone who may write; the thread ends when the last is gone.
    thread: Arc<Mutex<Option<std::thread::JoinHandle<()>>>>,
}

impl Sqlite {
    /// Opens (or makes) the file and applies the migrations.
    pub(super) async fn open(file: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot open the database {}", file.display());
        let mut connection = options(file).connect().await.with_context(cannot)?;
        let newest = MIGRATIONS.iter().map(|m| m.version).max().unwrap_or(0);
        MIGRATIONS
            .run(&mut connection)
            .await
            .map_err(|error| migration_fault(error, newest, &file.display().to_string()))?;
        connection.close().await.with_context(cannot)?;
        let readers = Arc::new(Readers::new(file, READERS));
        let (units, inbox) = channel(WAITING);
        let path = file.to_owned();
        let thread =
            std::thread::Builder::new().name("sqlite-writer".to_owned()).spawn(move || writer(&path, inbox))?;
        Ok(Self { file: file.to_owned(), readers, units, thread: Arc::new(Mutex::new(Some(thread))) })
    }
}

fn options(file: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(file)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .busy_timeout(BUSY)
}

fn opened(file: &Path, flags: OpenFlags) -> sqlx::Result<Connection> {
    let connection = Connection::open_with_flags(file, flags | OpenFlags::SQLITE_OPEN_NO_MUTEX).map_err(fault)?;
    connection.busy_timeout(BUSY).map_err(fault)?;
    connection.set_prepared_statement_cache_capacity(PREPARED);
    Ok(connection)
}

/// The connection that writes; the file and its journal were made by [`Sqlite::open`].
fn writing(file: &Path) -> sqlx::Result<Connection> {
    let connection = opened(file, OpenFlags::SQLITE_OPEN_READ_WRITE)?;
    connection.execute_batch("PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON").map_err(fault)?;
    Ok(connection)
}

/// The writing thread: groups until every sender is gone.
fn writer(file: &Path, mut inbox: Receiver<Unit>) {
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return tracing::error!(%error, "no runtime for the database's writer"),
    };
    // Dropping the last connection folds the WAL into the file; the next opening would do it too.
    runtime.block_on(async move {
        let mut connection: Option<Connection> = None;
        let mut group = Vec::with_capacity(GROUP);
        while inbox.recv_many(&mut group, GROUP).await > 0 {
            if connection.is_none() {
                match writing(file) {
                    Ok(open) => connection = Some(open),
                    Err(error) => {
                        refuse(group.drain(..), &error);
                        continue;
                    }
                }
            }
            if let Some(open) = &mut connection
                && commit(open, &mut group).await.is_err()
            {
                // A connection whose transaction is in doubt is not used again.
                connection = None;
            }
        }
    });
}

/// One transaction over a group; the error of the transaction itself, if it had one.
async fn commit(connection: &mut Connection, group: &mut Vec<Unit>) -> sqlx::Result<()> {
    if let Err(error) = connection.execute_batch("BEGIN IMMEDIATE").map_err(fault) {
        refuse(group.drain(..), &error);
        return Err(error);
    }
    let mut done = Vec::with_capacity(group.len());
    for unit in group.drain(..) {
        if unit.reply.is_closed() {
            continue;
        }
        let outcome = one(connection, unit.work).await;
        done.push((unit.reply, outcome));
    }
    let committed = connection.execute_batch("COMMIT").map_err(fault);
    if committed.is_err() {
        // After a full disk the transaction may still be open.
        let _ = connection.execute_batch("ROLLBACK");
    }
    for (reply, outcome) in done {
        let told = match (&committed, outcome) {
            (Err(error), Ok(_)) => Err(copy(error)),
            (_, outcome) => outcome,
        };
        // An error means that the caller went away.
        let _ = reply.send(told);
    }
    committed
}

/// One unit in its savepoint.
async fn one(connection: &mut Connection, work: Work) -> sqlx::Result<Output> {
    connection.execute_batch("SAVEPOINT unit").map_err(fault)?;
    let outcome = work(&mut Tx::Sqlite(&mut *connection)).await;
    let end = if outcome.is_ok() { "RELEASE unit" } else { "ROLLBACK TO unit; RELEASE unit" };
    connection.execute_batch(end).map_err(fault)?;
    outcome
}

/// Connections that only read, opened when they are wanted.
#[derive(Debug)]
struct Readers {
    file: PathBuf,
    turns: Semaphore,
    idle: Mutex<Vec<Connection>>,
    /// The one that is asked for versions, and which one since the start it is.
    versions: Mutex<(u64, Option<Connection>)>,
}

impl Readers {
    fn new(file: &Path, most: usize) -> Self {
        Self { file: file.to_owned(), turns: Semaphore::new(most), idle: Mutex::default(), versions: Mutex::default() }
    }

    async fn rows(self: &Arc<Self>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        let turn = tokio::time::timeout(BUSY, self.turns.acquire()).await;
        let _turn = turn.map_err(|_| sqlx::Error::PoolTimedOut)?.map_err(|_| sqlx::Error::PoolClosed)?;
        if let Some(quick) = self.read(sql, &args, Some(QUICK))? {
            return Ok(quick);
        }
        let readers = Arc::clone(self);
        let slow = tokio::task::spawn_blocking(move || readers.read(sql, &args, None)).await;
        Ok(slow.map_err(|_| sqlx::Error::WorkerCrashed)??.unwrap_or_default())
    }

    /// Rows, or `None` where they want more than so many steps.
    fn read(&self, sql: &str, args: &[Value], steps: Option<c_int>) -> sqlx::Result<Option<Vec<Row>>> {
        let waiting = self.idle().pop();
        let connection = match waiting {
            Some(connection) => connection,
            None => opened(&self.file, OpenFlags::SQLITE_OPEN_READ_ONLY)?,
        };
        if let Some(steps) = steps {
            connection.progress_handler(steps, Some(|| true)).map_err(fault)?;
        }
        let rows = rows(&connection, sql, args);
        connection.progress_handler(0, None::<fn() -> bool>).map_err(fault)?;
        let interrupted = rows.as_ref().is_err_and(|error| steps.is_some() && is_interruption(error));
        // One that met another fault is not used again.
        if rows.is_ok() || interrupted {
            self.idle().push(connection);
        }
        if interrupted { Ok(None) } else { rows.map(Some) }
    }

    /// SQLite counts for each connection the commits of all others that it meets: some microseconds, no page is read.
    fn version(&self) -> sqlx::Result<Version> {
        let mut versions = self.versions.lock().unwrap_or_else(PoisonError::into_inner);
        let (number, held) = &mut *versions;
        // One that meets a fault is not put back.
        let connection = match held.take() {
            Some(connection) => connection,
            None => {
                *number += 1;
                opened(&self.file, OpenFlags::SQLITE_OPEN_READ_ONLY)?
            }
        };
        let asked =
            connection.prepare_cached("PRAGMA data_version").and_then(|mut s| s.query_row([], |row| row.get(0)));
        let count = asked.map_err(fault)?;
        *held = Some(connection);
        Ok(Version { connection: *number, count })
    }

    fn idle(&self) -> std::sync::MutexGuard<'_, Vec<Connection>> {
        // Connections are whole or not there.
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn close(&self) {
        self.turns.close();
        self.idle().clear();
        self.versions.lock().unwrap_or_else(PoisonError::into_inner).1 = None;
    }
}

fn refuse(units: impl Iterator<Item = Unit>, error: &sqlx::Error) {
    for unit in units {
        // An error means that the caller went away.
        let _ = unit.reply.send(Err(copy(error)));
    }
}

#[async_trait]
impl Database for Sqlite {
    async fn read(&self, _scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        self.readers.rows(sql, args).await
    }

    async fn write(&self, _scope: Scope<'_>, work: Work) -> sqlx::Result<Output> {
        let (reply, answer) = oneshot::channel();
        self.units.send(Unit { work, reply }).await.map_err(|_| sqlx::Error::PoolClosed)?;
        answer.await.map_err(|_| sqlx::Error::WorkerCrashed)?
    }

    async fn change(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        let work: Work = Box::new(move |tx| Box::pin(async move { Ok(Box::new(tx.rows(sql, args).await?) as Output) }));
        unboxed(self.write(scope, work).await?)
    }

    fn version(&self) -> sqlx::Result<Option<Version>> {
        self.readers.version().map(Some)
    }

    async fn for_thread(&self) -> sqlx::Result<Arc<dyn Database>> {
        let readers = Arc::new(Readers::new(&self.file, 1));
        let thread = Arc::clone(&self.thread);
        Ok(Arc::new(Self { file: self.file.clone(), readers, units: self.units.clone(), thread }))
    }

    async fn tell(&self, _jobs: &[Uuid]) -> sqlx::Result<()> {
        Ok(())
    }

    async fn listen(&self, _heard: UnboundedSender<Uuid>) -> sqlx::Result<()> {
        Ok(())
    }

    async fn backup(&self, file: &Path) -> anyhow::Result<()> {
        let (from, to) = (self.file.clone(), file.to_owned());
        let copied = tokio::task::spawn_blocking(move || {
            let connection = opened(&from, OpenFlags::SQLITE_OPEN_READ_ONLY)?;
            run(&connection, "VACUUM INTO $1", &[Value::from(to.to_string_lossy().into_owned())])?;
            anyhow::Ok(std::fs::File::open(&to)?.sync_all()?)
        });
        copied.await?
    }

    async fn close(&self) {
        self.readers.close();
        // Everything sent before this is committed when the answer comes.
        let nothing: Work = Box::new(|_| Box::pin(async { Ok(Box::new(()) as Output) }));
        let _ = self.write(Scope::System, nothing).await;
    }
}

impl Drop for Sqlite {
    fn drop(&mut self) {
        if Arc::strong_count(&self.thread) > 1 {
            return;
        }
        // The last sender goes now, so the thread ends after what it has; wait for it, so that the file is closed.
        let (gone, _) = channel(1);
        self.units = gone;
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(thread) = thread {
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::db::args;

    #[tokio::test]
    async fn every_commit_of_anybody_is_another_version() {
        let folder = tempfile::TempDir::new().unwrap();
        let file = folder.path().join("queue.db");
        let (one, two) = (Sqlite::open(&file).await.unwrap(), Sqlite::open(&file).await.unwrap());
        let mut seen = vec![one.version().unwrap().unwrap()];
        for (k, writer) in [&one, &two, &one, &two].into_iter().enumerate() {
            let add = "INSERT INTO tenant (id, name, created_at) VALUES ($1, 't', 0)";
            writer.change(Scope::System, add, args![k.to_string()]).await.unwrap();
            seen.push(one.version().unwrap().unwrap());
            assert_eq!(one.version().unwrap(), seen.last().copied(), "nothing was committed between");
        }
        one.readers.versions.lock().unwrap().1 = None;
        seen.push(one.version().unwrap().unwrap());
        for (k, version) in seen.iter().enumerate() {
            assert!(!seen[..k].contains(version), "{seen:?}");
        }
    }

    #[tokio::test]
    async fn a_long_read_is_begun_again_where_it_may_block() {
        let folder = tempfile::TempDir::new().unwrap();
        let db = Sqlite::open(&folder.path().join("queue.db")).await.unwrap();
        let count =
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < $1) SELECT COUNT(*) AS n FROM n";
        for (most, quick) in [(10_i64, true), (300_000, false)] {
            let at_once = db.readers.read(count, &[Value::from(most)], Some(QUICK)).unwrap();
            assert_eq!(at_once.is_some(), quick, "{most}");
            let rows = db.read(Scope::System, count, args![most]).await.unwrap();
            assert_eq!(rows.first().unwrap().get::<i64>("n").unwrap(), most);
        }
    }
}
