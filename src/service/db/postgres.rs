//! PostgreSQL: the database of several machines.
//!
//! Two pools: the service's own statements run with the tenant `*`, those of a request in a transaction that sets the
//! caller's tenant, and row level security hides every other row even from a statement that forgets to ask. Claims
//! skip rows that another worker has locked. LISTEN carries hints only; nothing is lost when one is.

use super::value::bound;
use super::{Database, Output, Row, Scope, Tx, Value, Version, Work, migration_fault};
use anyhow::Context as _;
use async_trait::async_trait;
use sqlx::Connection as _;
use sqlx::postgres::{PgConnectOptions, PgListener, PgPool, PgPoolOptions};
use std::str::FromStr as _;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc::UnboundedSender;
use uuid::Uuid;

/// How long a caller waits for a connection before it hears that the database is away.
const PATIENCE: Duration = Duration::from_secs(5);
/// How long a connection that answered is taken to be there still.
const TRUSTED: Duration = Duration::from_secs(1);
/// Statements that a connection keeps prepared: all there are, with those over several rows in each size.
const STATEMENTS: usize = 256;
/// The channel of hints.
const CHANNEL: &str = "vasculum_job";
/// Ids in one notice: a payload holds less than 8000 bytes.
const IDS: usize = 200;

static MIGRATIONS: sqlx::migrate::Migrator = sqlx::migrate!("../../migrations/postgres");

/// A PostgreSQL database.
#[derive(Debug)]
pub(super) struct Postgres {
    options: PgConnectOptions,
    pool: PgPool,
}

impl Postgres {
    /// Connects and applies the migrations (one process at a time: sqlx takes an advisory lock).
    pub(super) async fn open(url: &str, connections: u32) -> anyhow::Result<Self> {
        let options = PgConnectOptions::from_str(url).context("the database address cannot be read")?;
        let options = options.application_name("vasculum").statement_cache_capacity(STATEMENTS);
        let place = format!("{} at {}", options.get_database().unwrap_or("postgres"), options.get_host());
        let pool =
            pool(&options, connections).await.with_context(|| format!("cannot connect to the database {place}"))?;
        let newest = MIGRATIONS.iter().map(|m| m.version).max().unwrap_or(0);
        MIGRATIONS.run(&pool).await.map_err(|error| migration_fault(error, newest, &place))?;
        Ok(Self { options, pool })
    }
}

async fn pool(options: &PgConnectOptions, connections: u32) -> sqlx::Result<PgPool> {
    PgPoolOptions::new()
        .max_connections(connections)
        .acquire_timeout(PATIENCE)
        .test_before_acquire(false)
        .before_acquire(|connection, idle| {
            Box::pin(async move {
                // A question before every use costs as much as the use; one that has just answered is trusted.
                let trusted = idle.idle_for < TRUSTED;
                if !trusted {
                    connection.ping().await?;
                }
                Ok(true)
            })
        })
        .after_connect(|connection, _| {
            Box::pin(async move {
                // A statement that hangs (a lock, a dead disk) must not hold a request for ever. Every statement finds
                // its few rows by an index: a plan that is kept from when a table was small would read it whole later
                // (100,000 jobs in one statement after 30 took minutes), and compiling a claim whose cost the planner
                // overestimated took 25 ms each time.
                sqlx::raw_sql(
                    "SET vasculum.tenant = '*'; SET statement_timeout = '30s'; SET standard_conforming_strings = on; \
                     SET enable_seqscan = off; SET jit = off; SET idle_in_transaction_session_timeout = '30s'",
                )
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .connect_with(options.clone())
        .await
}

/// The words that begin a transaction of this scope, in one message.
fn beginning(scope: Scope<'_>) -> sqlx::AssertSqlSafe<String> {
    sqlx::AssertSqlSafe(match scope {
        Scope::System => "BEGIN".to_owned(),
        // A message of several statements takes no arguments. Within a plain literal only the quote means anything
        // (`standard_conforming_strings`, which every connection sets).
        Scope::Tenant(tenant) => format!("BEGIN; SET LOCAL vasculum.tenant = '{}'", tenant.replace('\'', "''")),
    })
}

#[async_trait]
impl Database for Postgres {
    async fn read(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        let rows = if scope == Scope::System {
            bound!(sql, args).fetch_all(&self.pool).await?
        } else {
            let mut tx = self.pool.begin_with(beginning(scope)).await?;
            let rows = bound!(sql, args).fetch_all(&mut *tx).await?;
            tx.commit().await?;
            rows
        };
        Ok(rows.into_iter().map(Row::Postgres).collect())
    }

    async fn write(&self, scope: Scope<'_>, work: Work) -> sqlx::Result<Output> {
        let mut tx = self.pool.begin_with(beginning(scope)).await?;
        let output = work(&mut Tx::Postgres(&mut tx)).await?;
        tx.commit().await?;
        Ok(output)
    }

    async fn change(&self, scope: Scope<'_>, sql: &'static str, args: Vec<Value>) -> sqlx::Result<Vec<Row>> {
        // One statement is a transaction, whether it reads or writes.
        self.read(scope, sql, args).await
    }

    fn version(&self) -> sqlx::Result<Option<Version>> {
        Ok(None)
    }

    async fn for_thread(&self) -> sqlx::Result<Arc<dyn Database>> {
        let pool = pool(&self.options, 1).await?;
        Ok(Arc::new(Self { options: self.options.clone(), pool }))
    }

    async fn tell(&self, jobs: &[Uuid]) -> sqlx::Result<()> {
        for some in jobs.chunks(IDS) {
            let ids: Vec<String> = some.iter().map(|id| id.simple().to_string()).collect();
            sqlx::query("SELECT pg_notify($1, $2)").bind(CHANNEL).bind(ids.join(",")).execute(&self.pool).await?;
        }
        Ok(())
    }

    async fn listen(&self, heard: UnboundedSender<Uuid>) -> sqlx::Result<()> {
        let pool = pool(&self.options, 1).await?;
        let mut listener = PgListener::connect_with(&pool).await?;
        listener.listen(CHANNEL).await?;
        loop {
            let notice = listener.recv().await?;
            for id in notice.payload().split(',').filter_map(|id| Uuid::parse_str(id).ok()) {
                if heard.send(id).is_err() {
                    return Ok(());
                }
            }
        }
    }

    async fn backup(&self, _file: &std::path::Path) -> anyhow::Result<()> {
        anyhow::bail!("PostgreSQL is backed up by its own tools: see deploy/backup.sh (pg_dump)")
    }

    async fn close(&self) {
        self.pool.close().await;
    }
}
