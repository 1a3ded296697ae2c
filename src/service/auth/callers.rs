//! Keys that callers send, looked up in the database.
//!
//! A revoked key must stop counting at once, whichever process revoked it. So what was found is remembered only until the next
//! commit of anybody: a database that can say so for less than a read ([`Version`]; SQLite does) is asked for its version at every
//! call, and a key found at that very version needs no look. Elsewhere (PostgreSQL) every call looks, many of them together.
//! Rejected: a time for which a key is believed.

use crate::db::{Db, MOST, Scope, Together, Value, Version};
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Keys remembered at the same time, some hundred bytes each.
const REMEMBERED: usize = 4096;

/// A key's row.
#[derive(Clone, Debug)]
pub(crate) struct Found {
    pub(super) id: String,
    pub(super) tenant: String,
    pub(super) role: String,
    pub(super) max_bytes: Option<i64>,
    pub(super) requests_per_minute: Option<i64>,
}

/// Keys by their digests.
type Keys = BTreeMap<Vec<u8>, Found>;

/// Callers whose keys are looked up.
#[derive(Debug, Default)]
pub(crate) struct Callers {
    together: Together<Vec<u8>, Found>,
    known: Mutex<Option<(Version, Keys)>>,
}

impl Callers {
    /// The key of this digest, if it counts.
    pub(super) async fn found(&self, db: &Db, digest: Vec<u8>) -> sqlx::Result<Option<Found>> {
        // Asked before the look: what is committed between the two makes the found key an old one, never the other way round.
        let version = db.version()?;
        let known = self
            .known()
            .as_ref()
            .and_then(|(of, keys)| if Some(of) == version.as_ref() { keys.get(&digest).cloned() } else { None });
        if known.is_some() {
            return Ok(known);
        }
        let found = self.together.row(digest.clone(), |_, _| true, |digests| counting(db, digests)).await?;
        if let (Some(version), Some(found)) = (version, &found) {
            self.remember(version, digest, found.clone());
        }
        Ok(found)
    }

    fn remember(&self, version: Version, digest: Vec<u8>, found: Found) {
        let mut known = self.known();
        match known.as_mut() {
            Some((of, keys)) if *of == version && keys.len() < REMEMBERED => {
                keys.insert(digest, found);
            }
            _ => *known = Some((version, BTreeMap::from([(digest, found)]))),
        }
    }

    fn known(&self) -> MutexGuard<'_, Option<(Version, Keys)>> {
        // A version and its keys are replaced whole.
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

const KEYS: &str = "SELECT id, tenant, role, max_bytes, requests_per_minute, digest FROM api_key \
    WHERE revoked_at IS NULL AND digest IN ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16, $17, \
    $18, $19, $20, $21, $22, $23, $24, $25, $26, $27, $28, $29, $30, $31, $32)";

/// Keys that count, by digest.
async fn counting(db: &Db, digests: Vec<Vec<u8>>) -> sqlx::Result<Keys> {
    let Some(last) = digests.last().cloned() else { return Ok(BTreeMap::new()) };
    let mut values: Vec<Value> = digests.into_iter().map(Value::from).collect();
    values.resize(MOST, Value::from(last));
    let rows = db.rows(Scope::System, KEYS, values).await?;
    let read = |row: &crate::db::Row| {
        let found = Found {
            id: row.get("id")?,
            tenant: row.get("tenant")?,
            role: row.get("role")?,
            max_bytes: row.get("max_bytes")?,
            requests_per_minute: row.get("requests_per_minute")?,
        };
        Ok((row.get("digest")?, found))
    };
    rows.iter().map(read).collect()
}
