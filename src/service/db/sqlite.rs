//! SQLite: the embedded default, one file, with group commit.
//!
//! WAL with `synchronous = FULL`: a commit is on disk before anybody hears of it (NORMAL may lose the last commits at a
//! loss of power). One fsync costs 1 to 8 ms here, so one per job gave 123-646 jobs/s; the writer therefore takes every
//! unit of work that waits into one transaction. Each unit has a savepoint of its own, so that one that fails leaves
//! nothing and the others stand. The writer lives on a thread of its own: neither a busy runtime nor a long reader can
//! hold it back. It never waits for company: while one commit syncs, the next group gathers by itself.

use super::value::bound;
use super::{Database, Output, Row, Scope, Tx, Value, Work, migration_fault};
use anyhow::Context as _;
use async_trait::async_trait;
use sqlx::AssertSqlSafe;
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{ConnectOptions as _, Connection as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc::{Receiver, Sender, UnboundedSender, channel};
use tokio::sync::oneshot;
use uuid::Uuid;

/// Connections that only read.
const READERS: u32 = 4;
/// How long a writer waits for a writer of another process.
const BUSY: Duration = Duration::from_secs(5);
/// Units of work in one commit. At 256 the fsync is below a tenth of the group's time here; more only adds latency.
const GROUP: usize = 256;
/// Units that may wait before senders wait too.
const WAITING: usize = 4096;

static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("../../migrations/sqlite");

/// SQL of PostgreSQL in SQLite's words.
pub(super) fn words(sql: &str) -> String {
    sql.replace("now_ms()", "CAST(unixepoch('subsec') * 1000 AS INTEGER)")
        .replace(" FOR UPDATE SKIP LOCKED", "")
        .replace(" FOR UPDATE", "")
}

struct Unit {
    work: Work,
    reply: oneshot::Sender<sqlx::Result<Output>>,
}

/// One SQLite file.
#[derive(Debug)]
pub(super) struct Sqlite {
    file: PathBuf,
    readers: SqlitePool,
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
        let readers = SqlitePoolOptions::new()
            .max_connections(READERS)
            .acquire_timeout(BUSY)
            .connect_lazy_with(options(file).read_only(true).create_if_missing(false));
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

/// The writing thread: groups until every sender is gone.
fn writer(file: &Path, mut inbox: Receiver<Unit>) {
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return tracing::error!(%error, "no runtime for the database's writer"),
    };
    runtime.block_on(async move {
        let mut connection: Option<SqliteConnection> = None;
        let mut group = Vec::with_capacity(GROUP);
        while inbox.recv_many(&mut group, GROUP).await > 0 {
            if connection.is_none() {
                match options(file).connect().await {
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
        if let Some(open) = connection {
            // Closing the last connection folds the WAL into the file; the next opening would do it too.
            let _ = open.close().await;
        }
    });
}

/// One transaction over a group; the error of the transaction itself, if it had one.
async fn commit(connection: &mut SqliteConnection, group: &mut Vec<Unit>) -> sqlx::Result<()> {
    if let Err(error) = sqlx::query("BEGIN IMMEDIATE").execute(&mut *connection).await {
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
    let committed = sqlx::query("COMMIT").execute(&mut *connection).await;
    if committed.is_err() {
        // After a full disk the transaction may still be open.
        let _ = sqlx::query("ROLLBACK").execute(&mut *connection).await;
    }
    for (reply, outcome) in done {
        let told = match (&committed, outcome) {
            (Err(error), Ok(_)) => Err(copy(error)),
            (_, outcome) => outcome,
        };
        // An error means that the caller went away.
        let _ = reply.send(told);
    }
    committed.map(|_| ())
}

/// One unit in its savepoint.
async fn one(connection: &mut SqliteConnection, work: Work) -> sqlx::Result<Output> {
    sqlx::query("SAVEPOINT unit").execute(&mut *connection).await?;
    let outcome = work(&mut Tx::Sqlite(&mut *connection)).await;
    let end = if outcome.is_ok() { "RELEASE unit" } else { "ROLLBACK TO unit; RELEASE unit" };
    sqlx::raw_sql(end).execute(&mut *connection).await?;
    outcome
}

fn refuse(units: impl Iterator<Item = Unit>, error: &sqlx::Error) {
    for unit in units {
        // An error means that the caller went away.
        let _ = unit.reply.send(Err(copy(error)));
    }
}

/// The same error for another caller of the group: what matters is that it is the storage's and not the caller's.
fn copy(error: &sqlx::Error) -> sqlx::Error {
    sqlx::Error::Io(std::io::Error::other(error.to_string()))
}

#[async_trait]
impl Database for Sqlite {
    async fn read(&self, _scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        let rows = bound!(AssertSqlSafe(words(sql)), args).fetch_all(&self.readers).await?;
        Ok(rows.into_iter().map(Row::Sqlite).collect())
    }

    async fn write(&self, _scope: Scope<'_>, work: Work) -> sqlx::Result<Output> {
        let (reply, answer) = oneshot::channel();
        self.units.send(Unit { work, reply }).await.map_err(|_| sqlx::Error::PoolClosed)?;
        answer.await.map_err(|_| sqlx::Error::WorkerCrashed)?
    }

    async fn for_thread(&self) -> sqlx::Result<Arc<dyn Database>> {
        let readers = SqlitePoolOptions::new()
            .max_connections(1)
            .acquire_timeout(BUSY)
            .connect_lazy_with(options(&self.file).read_only(true).create_if_missing(false));
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
        let target = file.to_string_lossy().into_owned();
        sqlx::query("VACUUM INTO $1").bind(target).execute(&self.readers).await?;
        std::fs::File::open(file)?.sync_all()?;
        Ok(())
    }

    async fn close(&self) {
        self.readers.close().await;
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
