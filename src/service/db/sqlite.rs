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

use super::{Database, Output, Row, Scope, Tx, Value, Work, migration_fault};
use anyhow::Context as _;
use async_trait::async_trait;
use rusqlite::types::{ToSqlOutput, ValueRef};
use rusqlite::{Connection, OpenFlags, ToSql};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions as _, Connection as _};
use std::borrow::Cow;
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
}

impl Readers {
    fn new(file: &Path, most: usize) -> Self {
        Self { file: file.to_owned(), turns: Semaphore::new(most), idle: Mutex::default() }
    }

    async fn rows(self: &Arc<Self>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        let turn = tokio::time::timeout(BUSY, self.turns.acquire()).await;
        let _turn = turn.map_err(|_| sqlx::Error::PoolTimedOut)?.map_err(|_| sqlx::Error::PoolClosed)?;
        if let Some(quick) = self.read(sql, &args, true)? {
            return Ok(quick);
        }
        let readers = Arc::clone(self);
        let slow = tokio::task::spawn_blocking(move || readers.read(sql, &args, false)).await;
        Ok(slow.map_err(|_| sqlx::Error::WorkerCrashed)??.unwrap_or_default())
    }

    /// Rows, or `None` where they are no quick matter.
    fn read(&self, sql: &str, args: &[Value], quick: bool) -> sqlx::Result<Option<Vec<Row>>> {
        let waiting = self.idle().pop();
        let connection = match waiting {
            Some(connection) => connection,
            None => opened(&self.file, OpenFlags::SQLITE_OPEN_READ_ONLY)?,
        };
        if quick {
            connection.progress_handler(QUICK, Some(|| true)).map_err(fault)?;
        }
        let rows = rows(&connection, sql, args);
        connection.progress_handler(0, None::<fn() -> bool>).map_err(fault)?;
        let interrupted = rows.as_ref().is_err_and(|error| quick && is_interruption(error));
        // One that met another fault is not used again.
        if rows.is_ok() || interrupted {
            self.idle().push(connection);
        }
        if interrupted { Ok(None) } else { rows.map(Some) }
    }

    fn idle(&self) -> std::sync::MutexGuard<'_, Vec<Connection>> {
        // Connections are whole or not there.
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn close(&self) {
        self.turns.close();
        self.idle().clear();
    }
}

/// Every row of a statement.
pub(super) fn rows(connection: &Connection, sql: &str, args: &[Value]) -> sqlx::Result<Vec<Row>> {
    let mut statement = prepared(connection, sql, args)?;
    let names: Arc<[String]> = statement.column_names().into_iter().map(str::to_owned).collect();
    let mut out = Vec::new();
    let mut found = statement.raw_query();
    while let Some(row) = found.next().map_err(fault)? {
        let values = (0..names.len()).map(|i| row.get(i).map_err(fault)).collect::<sqlx::Result<_>>()?;
        out.push(Row::Sqlite(Cells { names: Arc::clone(&names), values }));
    }
    Ok(out)
}

/// Runs a statement; the number of rows it touched.
pub(super) fn run(connection: &Connection, sql: &str, args: &[Value]) -> sqlx::Result<u64> {
    let mut statement = prepared(connection, sql, args)?;
    let mut found = statement.raw_query();
    while found.next().map_err(fault)?.is_some() {}
    Ok(connection.changes())
}

/// A statement whose `$N` are bound to the N-th argument.
fn prepared<'c>(connection: &'c Connection, sql: &str, args: &[Value]) -> sqlx::Result<rusqlite::CachedStatement<'c>> {
    let mut statement = connection.prepare_cached(&words(sql)).map_err(fault)?;
    for i in 1..=statement.parameter_count() {
        let number = statement.parameter_name(i).and_then(|name| name.get(1..)?.parse::<usize>().ok()).unwrap_or(i);
        let missing = || sqlx::Error::Protocol(format!("the statement has no argument {number}"));
        let value = number.checked_sub(1).and_then(|k| args.get(k)).ok_or_else(missing)?;
        statement.raw_bind_parameter(i, value).map_err(fault)?;
    }
    Ok(statement)
}

impl ToSql for Value {
    fn to_sql(&self) -> rusqlite::Result<ToSqlOutput<'_>> {
        let value = match self {
            Self::Text(Some(text)) => ValueRef::Text(text.as_bytes()),
            Self::Int(Some(number)) => ValueRef::Integer(*number),
            Self::Real(Some(number)) => ValueRef::Real(*number),
            Self::Bytes(Some(bytes)) => ValueRef::Blob(bytes),
            Self::Text(None) | Self::Int(None) | Self::Real(None) | Self::Bytes(None) => ValueRef::Null,
        };
        Ok(ToSqlOutput::Borrowed(value))
    }
}

/// A row of SQLite.
#[derive(Debug)]
pub struct Cells {
    names: Arc<[String]>,
    values: Vec<rusqlite::types::Value>,
}

impl Cells {
    pub(super) fn get<'r, T: FromCell<'r>>(&'r self, column: &str) -> sqlx::Result<T> {
        let at = self.names.iter().position(|name| name == column);
        let value =
            at.and_then(|i| self.values.get(i)).ok_or_else(|| sqlx::Error::ColumnNotFound(column.to_owned()))?;
        T::from_cell(value).ok_or_else(|| sqlx::Error::ColumnDecode {
            index: column.to_owned(),
            source: format!("a value of type {}", value.data_type()).into(),
        })
    }
}

/// What a cell can be read as.
pub trait FromCell<'r>: Sized {
    /// `None` where the cell is of another type.
    fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self>;
}

macro_rules! from_cell {
    ($($to:ty: $($variant:ident $value:ident => $make:expr),+;)*) => {
        $(impl<'r> FromCell<'r> for $to {
            fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self> {
                match cell {
                    $(rusqlite::types::Value::$variant($value) => Some($make),)+
                    _ => None,
                }
            }
        })*
    };
}

from_cell! {
    &'r str: Text v => v.as_str();
    String: Text v => v.clone();
    i64: Integer v => *v;
    f64: Real v => *v, Integer v => *v as f64;
    Vec<u8>: Blob v => v.clone();
}

impl<'r, T: FromCell<'r>> FromCell<'r> for Option<T> {
    fn from_cell(cell: &'r rusqlite::types::Value) -> Option<Self> {
        match cell {
            rusqlite::types::Value::Null => Some(None),
            other => T::from_cell(other).map(Some),
        }
    }
}

/// A fault of SQLite as sqlx tells those of a database.
#[derive(Debug)]
struct Fault {
    code: c_int,
    message: String,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "(code: {}) {}", self.code, self.message)
    }
}

impl std::error::Error for Fault {}

impl sqlx::error::DatabaseError for Fault {
    fn message(&self) -> &str {
        &self.message
    }

    fn code(&self) -> Option<Cow<'_, str>> {
        Some(self.code.to_string().into())
    }

    fn kind(&self) -> sqlx::error::ErrorKind {
        match self.code {
            rusqlite::ffi::SQLITE_CONSTRAINT_UNIQUE | rusqlite::ffi::SQLITE_CONSTRAINT_PRIMARYKEY => {
                sqlx::error::ErrorKind::UniqueViolation
            }
            _ => sqlx::error::ErrorKind::Other,
        }
    }

    fn as_error(&self) -> &(dyn std::error::Error + Send + Sync + 'static) {
        self
    }

    fn as_error_mut(&mut self) -> &mut (dyn std::error::Error + Send + Sync + 'static) {
        self
    }

    fn into_error(self: Box<Self>) -> Box<dyn std::error::Error + Send + Sync + 'static> {
        self
    }
}

fn fault(error: rusqlite::Error) -> sqlx::Error {
    match error {
        rusqlite::Error::SqliteFailure(failure, message) => {
            let message = message.unwrap_or_else(|| failure.to_string());
            sqlx::Error::Database(Box::new(Fault { code: failure.extended_code, message }))
        }
        other => sqlx::Error::Protocol(other.to_string()),
    }
}

fn is_interruption(error: &sqlx::Error) -> bool {
    let code = error.as_database_error().and_then(|fault| fault.code().map(Cow::into_owned));
    code.is_some_and(|code| code == rusqlite::ffi::SQLITE_INTERRUPT.to_string())
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
        self.readers.rows(sql, args).await
    }

    async fn write(&self, _scope: Scope<'_>, work: Work) -> sqlx::Result<Output> {
        let (reply, answer) = oneshot::channel();
        self.units.send(Unit { work, reply }).await.map_err(|_| sqlx::Error::PoolClosed)?;
        answer.await.map_err(|_| sqlx::Error::WorkerCrashed)?
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
