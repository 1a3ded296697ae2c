//! The database: one SQLite file, opened so that a committed job survives a loss of power.
//!
//! WAL with `synchronous = FULL`: a 202 is given after the commit's fsync (NORMAL may lose the last commits). One
//! connection writes, so that writers queue here instead of meeting `SQLITE_BUSY`; several read beside it.
//! Only the database's own clock is ever compared: `now!()` in SQL, never a node's time.

use anyhow::Context as _;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use std::path::Path;
use std::time::Duration;

/// Connections that only read.
const READERS: u32 = 4;
/// How long a writer waits for a writer of another process.
const BUSY: Duration = Duration::from_secs(5);

/// Milliseconds since 1970 by the database's clock, for use inside `concat!`.
macro_rules! now {
    () => {
        "CAST(unixepoch('subsec') * 1000 AS INTEGER)"
    };
}
pub(crate) use now;

static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("../../migrations/sqlite");

/// The writer and the readers. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Db {
    /// The one connection that writes.
    pub writer: SqlitePool,
    /// Connections that only read.
    pub reader: SqlitePool,
}

impl Db {
    /// Opens (or makes) the file and applies the migrations.
    ///
    /// # Errors
    /// The file cannot be opened, or holds a newer schema than this binary knows.
    pub async fn open(file: &Path) -> anyhow::Result<Self> {
        let db = Self {
            writer: writer(file).await?,
            reader: SqlitePoolOptions::new()
                .max_connections(READERS)
                .acquire_timeout(BUSY)
                .connect_lazy_with(options(file).read_only(true).create_if_missing(false)),
        };
        MIGRATIONS.run(&db.writer).await.with_context(|| {
            format!(
                "the schema of {} cannot be brought up to date; is this binary older than the data?",
                file.display()
            )
        })?;
        Ok(db)
    }

    /// Closes both pools; committed work is in the file.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }
}

/// A pool of exactly one writing connection.
///
/// # Errors
/// The file cannot be opened.
pub async fn writer(file: &Path) -> anyhow::Result<SqlitePool> {
    SqlitePoolOptions::new()
        .max_connections(1)
        .acquire_timeout(Duration::from_secs(30))
        .connect_with(options(file))
        .await
        .with_context(|| format!("cannot open the database {}", file.display()))
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
