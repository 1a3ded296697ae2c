//! Tenants: made, bounded and listed by the operator.

use crate::audit::{self, Entry};
use crate::db::{Db, Scope, args};

/// A tenant and its bounds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TenantRow {
    /// Its name.
    pub id: String,
    /// Its jobs that may run at the same time; no bound without.
    pub max_running: Option<i64>,
    /// How long its ended jobs are kept, ms; for ever without.
    pub keep_ms: Option<i64>,
}

/// Sets what a tenant may do; `None` lifts the bound. Makes the tenant if it is new. Jobs that have ended already keep
/// the end of retention that they have.
///
/// # Errors
/// The database's.
pub async fn set(db: &Db, tenant: &str, max_running: Option<i64>, keep_ms: Option<i64>) -> sqlx::Result<()> {
    let tenant = tenant.to_owned();
    let written = db.write(Scope::System, move |tx| {
        Box::pin(async move {
            let sql = "INSERT INTO tenant (id, name, max_running, retention_ms, created_at) \
                VALUES ($1, $1, $2, $3, now_ms()) ON CONFLICT (id) DO UPDATE SET \
                max_running = excluded.max_running, retention_ms = excluded.retention_ms";
            tx.run(sql, args![&tenant, max_running, keep_ms]).await?;
            audit::append(tx, &Entry::of_operator(&tenant, "tenant.set", &tenant)).await
        })
    });
    written.await
}

/// Every tenant, by name.
///
/// # Errors
/// The database's.
pub async fn list(db: &Db) -> sqlx::Result<Vec<TenantRow>> {
    let sql = "SELECT id, max_running, retention_ms FROM tenant ORDER BY id";
    let read = |row: &crate::db::Row| {
        Ok(TenantRow { id: row.get("id")?, max_running: row.get("max_running")?, keep_ms: row.get("retention_ms")? })
    };
    db.rows(Scope::System, sql, Vec::new()).await?.iter().map(read).collect()
}
