//! The database: one small trait, [`Database`], and two of them behind it.
//!
//! SQL is written once, in PostgreSQL's words with `now_ms()` for the database's clock; [`statement`] rewrites the three
//! phrases that SQLite does not have. Rejected: a table trait implemented twice (some 40 statements each to keep
//! equal by hand) and sqlx's `Any` (no group commit, no LISTEN). A value is bound and read through [`Value`] and
//! [`Row`], so no caller names a dialect.
//!
//! Limits: SQLite serves the processes of one machine; PostgreSQL any number of machines. Only the database's own
//! clock is ever compared, never a node's.

mod grouped;
mod line;
mod postgres;
mod sizes;
mod sqlite;
mod statement;
mod together;
mod value;

pub(crate) use grouped::Grouped;
pub(crate) use line::MOST;
pub(crate) use sizes::{Sizes, placeholders};
pub(crate) use together::Together;
pub(crate) use value::args;
pub use value::{Row, Tx, Value};

use crate::config::Config;
use async_trait::async_trait;
use futures::future::BoxFuture;
use std::any::Any;
use std::sync::Arc;
use tokio::sync::mpsc::UnboundedSender;
use uuid::Uuid;

/// Whose rows a statement may touch. PostgreSQL enforces it by row level security beside the `tenant` in the query.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope<'a> {
    /// The service itself: workers, rescue, retention, keys.
    System,
    /// The jobs of one tenant.
    Tenant(&'a str),
}

/// A state of the database: another one after every commit of anybody. Only equality means anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Version {
    /// Which connection was asked: each counts by itself.
    connection: u64,
    count: i64,
}

/// What a unit of writing gives back.
pub type Output = Box<dyn Any + Send>;
/// A unit of writing: all of it is committed, or nothing.
pub type Work = Box<dyn for<'t> FnOnce(&'t mut Tx<'_>) -> BoxFuture<'t, sqlx::Result<Output>> + Send>;

/// A database that can hold the queue.
#[async_trait]
pub trait Database: Send + Sync + std::fmt::Debug {
    /// Rows of a statement that only reads.
    async fn read(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>>;

    /// Runs `work` in a transaction and returns after its commit is durable.
    async fn write(&self, scope: Scope<'_>, work: Work) -> sqlx::Result<Output>;

    /// Rows of one statement that writes, in a transaction of its own; returns after the commit is durable.
    async fn change(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>>;

    /// The state that a read would see now; `None` where that is not to be had for less than a read.
    fn version(&self) -> sqlx::Result<Option<Version>>;

    /// The same database for a thread with a runtime of its own.
    async fn for_thread(&self) -> sqlx::Result<Arc<dyn Database>>;

    /// Tells other processes that jobs changed: a hint, which may be lost.
    async fn tell(&self, jobs: &[Uuid]) -> sqlx::Result<()>;

    /// Passes the hints of other processes on until the receiver is gone; returns at once where there are none.
    async fn listen(&self, heard: UnboundedSender<Uuid>) -> sqlx::Result<()>;

    /// Writes a consistent copy into `file`, where the database can do so by itself.
    async fn backup(&self, file: &std::path::Path) -> anyhow::Result<()>;

    /// Lets go of every connection; committed work is in the database.
    async fn close(&self);
}

/// The database in use. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Db(Arc<dyn Database>);

impl Db {
    /// Opens the configured database and brings it to this version's schema.
    ///
    /// # Errors
    /// It cannot be reached, or holds a newer schema than this binary knows.
    pub async fn open(config: &Config) -> anyhow::Result<Self> {
        match config.database_url.as_deref() {
            Some(url) if url.starts_with("postgres:") || url.starts_with("postgresql:") => {
                Ok(Self(Arc::new(postgres::Postgres::open(url, config.database_connections).await?)))
            }
            _ => Ok(Self(Arc::new(sqlite::Sqlite::open(&config.database_file()?).await?))),
        }
    }

    /// Rows of a statement.
    ///
    /// # Errors
    /// The database's.
    pub async fn rows(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        self.0.read(scope, sql, args).await
    }

    /// The first row of a statement.
    ///
    /// # Errors
    /// The database's.
    pub async fn row(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Option<Row>> {
        Ok(self.0.read(scope, sql, args).await?.into_iter().next())
    }

    /// Runs `work` in one transaction; returns after the commit is durable.
    ///
    /// # Errors
    /// The database's; nothing was written.
    pub async fn write<T, F>(&self, scope: Scope<'_>, work: F) -> sqlx::Result<T>
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Tx<'_>) -> BoxFuture<'t, sqlx::Result<T>> + Send + 'static,
    {
        let boxed: Work = Box::new(move |tx| {
            let work = work(tx);
            Box::pin(async move { work.await.map(|value| Box::new(value) as Output) })
        });
        unboxed(self.0.write(scope, boxed).await?)
    }

    /// The first row of one statement that writes, in a transaction of its own.
    ///
    /// # Errors
    /// The database's; nothing was written.
    pub async fn change(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Option<Row>> {
        Ok(self.0.change(scope, sql, args).await?.into_iter().next())
    }

    /// Rows of one statement that writes, in a transaction of its own.
    ///
    /// # Errors
    /// The database's; nothing was written.
    pub async fn changes(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        self.0.change(scope, sql, args).await
    }

    /// One statement in a transaction of its own; the number of rows it touched.
    ///
    /// # Errors
    /// The database's.
    pub async fn run(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<u64> {
        self.write(scope, move |tx| Box::pin(async move { tx.run(sql, args).await })).await
    }

    /// See [`Database::version`].
    ///
    /// # Errors
    /// The database's.
    pub fn version(&self) -> sqlx::Result<Option<Version>> {
        self.0.version()
    }

    /// The same database for a thread with a runtime of its own.
    ///
    /// # Errors
    /// It cannot be reached.
    pub async fn for_thread(&self) -> sqlx::Result<Self> {
        Ok(Self(self.0.for_thread().await?))
    }

    /// See [`Database::tell`].
    ///
    /// # Errors
    /// The database's.
    pub async fn tell(&self, jobs: &[Uuid]) -> sqlx::Result<()> {
        self.0.tell(jobs).await
    }

    /// See [`Database::listen`].
    ///
    /// # Errors
    /// The database's.
    pub async fn listen(&self, heard: UnboundedSender<Uuid>) -> sqlx::Result<()> {
        self.0.listen(heard).await
    }

    /// See [`Database::backup`].
    ///
    /// # Errors
    /// The database's; PostgreSQL is backed up by its own tools.
    pub async fn backup(&self, file: &std::path::Path) -> anyhow::Result<()> {
        self.0.backup(file).await
    }

    /// Closes every connection; committed work stays.
    pub async fn close(&self) {
        self.0.close().await;
    }
}

/// Whether the database could not be reached, by its own fault or the way's.
pub(crate) fn is_away(error: &sqlx::Error) -> bool {
    use sqlx::Error::{Io, PoolClosed, PoolTimedOut, Tls, WorkerCrashed};
    matches!(error, PoolTimedOut | PoolClosed | WorkerCrashed | Io(_) | Tls(_))
}

/// The same error for another caller of a group: what matters is that it is the storage's and not the caller's.
fn copy(error: &sqlx::Error) -> sqlx::Error {
    sqlx::Error::Io(std::io::Error::other(error.to_string()))
}

/// What a unit of writing gave back.
fn unboxed<T: 'static>(output: Output) -> sqlx::Result<T> {
    output.downcast::<T>().map(|value| *value).map_err(|_| sqlx::Error::Protocol("a write's output was lost".into()))
}

/// The words for a migration that failed.
pub(crate) fn migration_fault(error: sqlx::migrate::MigrateError, newest: i64, place: &str) -> anyhow::Error {
    use sqlx::migrate::MigrateError;
    match error {
        MigrateError::VersionMissing(version) => anyhow::anyhow!(
            "the database {place} has schema {version}, this binary knows schemas up to {newest}: it is older than the \
             data. Start the newer release again, or restore a backup made before the upgrade"
        ),
        MigrateError::VersionMismatch(version) => anyhow::anyhow!(
            "schema {version} of the database {place} was made by another build than this one: take the release that made it"
        ),
        other => anyhow::Error::new(other).context(format!("the schema of {place} cannot be brought up to date")),
    }
}
