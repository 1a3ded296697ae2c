//! Retention, and the roll of workers.

use super::Queue;
use crate::db::{Row, Scope, args};
use uuid::Uuid;

/// A worker that has not been seen for this long is no longer listed, ms.
const FORGOTTEN_MS: i64 = 60_000;

/// A process that works on jobs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WorkerRow {
    /// Its name in `lease_owner`.
    pub id: String,
    /// Machine.
    pub host: String,
    /// Version of its binary.
    pub version: String,
    /// Jobs that it can run at the same time.
    pub slots: i64,
    /// Jobs that it runs.
    pub busy: i64,
    /// Memory that it may give to jobs, MiB.
    pub memory_mb: i64,
    /// What stands between its jobs and the network; unknown before the first job.
    pub isolation: Option<String>,
    /// Start, ms since 1970.
    pub started_at: i64,
    /// Last word, ms since 1970.
    pub seen_at: i64,
}

impl WorkerRow {
    fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.get("id")?,
            host: row.get("host")?,
            version: row.get("version")?,
            slots: row.get("slots")?,
            busy: row.get("busy")?,
            memory_mb: row.get("memory_mb")?,
            isolation: row.get("isolation")?,
            started_at: row.get("started_at")?,
            seen_at: row.get("seen_at")?,
        })
    }
}

impl Queue {
    /// Jobs whose retention is over, as tenant and id, at most `limit`.
    ///
    /// # Errors
    /// The database's.
    pub async fn expired(&self, limit: i64) -> sqlx::Result<Vec<(String, Uuid)>> {
        let sql = "SELECT tenant, id FROM job WHERE expires_at IS NOT NULL AND expires_at < now_ms() \
                   ORDER BY expires_at LIMIT $1";
        let rows = self.db().rows(Scope::System, sql, args![limit]).await?;
        rows.iter().map(|row| Ok((row.get("tenant")?, parsed(row.get("id")?)?))).collect()
    }

    /// Writes a worker into the roll, or renews its line; forgets those that went without a word.
    ///
    /// # Errors
    /// The database's.
    pub async fn enrol(&self, worker: &WorkerRow) -> sqlx::Result<()> {
        let row = worker.clone();
        self.db()
            .write(Scope::System, move |tx| {
                Box::pin(async move {
                    let line = "INSERT INTO worker (id, host, version, slots, busy, memory_mb, isolation, started_at, seen_at) \
                        VALUES ($1, $2, $3, $4, $5, $6, $7, now_ms(), now_ms()) ON CONFLICT (id) DO UPDATE SET \
                        busy = excluded.busy, memory_mb = excluded.memory_mb, isolation = excluded.isolation, \
                        seen_at = now_ms()";
                    let values =
                        args![&row.id, &row.host, &row.version, row.slots, row.busy, row.memory_mb, &row.isolation];
                    tx.run(line, values).await?;
                    tx.run("DELETE FROM worker WHERE seen_at < now_ms() - $1", args![FORGOTTEN_MS]).await?;
                    Ok(())
                })
            })
            .await
    }

    /// Takes workers off the roll.
    ///
    /// # Errors
    /// The database's.
    pub async fn strike_off(&self, id: &str) -> sqlx::Result<()> {
        self.db().run(Scope::System, "DELETE FROM worker WHERE id = $1", args![id]).await?;
        Ok(())
    }

    /// The roll.
    ///
    /// # Errors
    /// The database's.
    pub async fn workers(&self) -> sqlx::Result<Vec<WorkerRow>> {
        let sql = "SELECT * FROM worker WHERE seen_at >= now_ms() - $1 ORDER BY id";
        self.db().rows(Scope::System, sql, args![FORGOTTEN_MS]).await?.iter().map(WorkerRow::of).collect()
    }
}

fn parsed(id: String) -> sqlx::Result<Uuid> {
    Uuid::parse_str(&id).map_err(|e| sqlx::Error::Decode(e.into()))
}
