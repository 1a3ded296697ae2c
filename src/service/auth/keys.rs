//! Making, listing and revoking API keys.

use super::{DEFAULT_TENANT, Role, digest, new_key};
use crate::audit::{self, Entry};
use crate::db::{Db, Scope, args};
use uuid::Uuid;

/// A key to make.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewKey {
    /// What it is for.
    pub label: String,
    /// What it may do.
    pub role: Role,
    /// Whose jobs it sees; the tenant is made if it is new.
    pub tenant: String,
    /// Requests in a minute; no bound without.
    pub requests_per_minute: Option<i64>,
    /// Largest upload, bytes; the service's own bound without.
    pub max_bytes: Option<i64>,
}

impl Default for NewKey {
    fn default() -> Self {
        Self {
            label: "key".to_owned(),
            role: Role::Admin,
            tenant: DEFAULT_TENANT.to_owned(),
            requests_per_minute: None,
            max_bytes: None,
        }
    }
}

/// A key as it is listed: never the key itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeyRow {
    /// Its id, by which it is revoked.
    pub id: String,
    /// Whose jobs it sees.
    pub tenant: String,
    /// What it may do.
    pub role: String,
    /// What it is for.
    pub label: String,
    /// When it was made, ms since 1970.
    pub created_at: i64,
    /// When it was revoked, ms since 1970.
    pub revoked_at: Option<i64>,
}

/// Makes a key and returns it; only its digest is stored, so it cannot be shown again.
///
/// # Errors
/// The database's; no random bytes.
pub async fn create(db: &Db, new: NewKey) -> anyhow::Result<String> {
    let key = new_key().map_err(|e| anyhow::anyhow!("no random bytes for a key: {e}"))?;
    let stored = digest(&key);
    db.write(Scope::System, move |tx| {
        Box::pin(async move {
            let tenant = "INSERT INTO tenant (id, name, created_at) VALUES ($1, $1, now_ms()) ON CONFLICT (id) DO NOTHING";
            tx.run(tenant, args![&new.tenant]).await?;
            let id = Uuid::now_v7();
            let key = "INSERT INTO api_key (id, tenant, role, label, digest, created_at, requests_per_minute, max_bytes) \
                       VALUES ($1, $2, $3, $4, $5, now_ms(), $6, $7)";
            let values = args![
                id,
                &new.tenant,
                new.role.as_str(),
                &new.label,
                stored,
                new.requests_per_minute,
                new.max_bytes
            ];
            tx.run(key, values).await?;
            audit::append(tx, &Entry::of_operator(&new.tenant, "key.create", &id.to_string())).await
        })
    })
    .await?;
    Ok(key)
}

/// Every key, oldest first.
///
/// # Errors
/// The database's.
pub async fn list(db: &Db) -> anyhow::Result<Vec<KeyRow>> {
    let sql = "SELECT id, tenant, role, label, created_at, revoked_at FROM api_key ORDER BY id";
    let rows = db.rows(Scope::System, sql, Vec::new()).await?;
    let read = |row: &crate::db::Row| {
        Ok(KeyRow {
            id: row.get("id")?,
            tenant: row.get("tenant")?,
            role: row.get("role")?,
            label: row.get("label")?,
            created_at: row.get("created_at")?,
            revoked_at: row.get("revoked_at")?,
        })
    };
    Ok(rows.iter().map(read).collect::<sqlx::Result<_>>()?)
}

/// Revokes a key at once; whether there was one to revoke.
///
/// # Errors
/// The database's.
pub async fn revoke(db: &Db, id: &str) -> anyhow::Result<bool> {
    let id = id.to_owned();
    let revoked = db.write(Scope::System, move |tx| {
        Box::pin(async move {
            let sql = "UPDATE api_key SET revoked_at = now_ms() WHERE id = $1 AND revoked_at IS NULL RETURNING tenant";
            let Some(row) = tx.row(sql, args![&id]).await? else { return Ok(false) };
            audit::append(tx, &Entry::of_operator(&row.get::<String>("tenant")?, "key.revoke", &id)).await?;
            Ok(true)
        })
    });
    Ok(revoked.await?)
}
