//! Links that show one job's result for a short time, for another page's frame: no key, no session, nothing stored.
//!
//! A link is `vsl_KEY.EXPIRES.MAC`: the id of the key that made it, seconds since 1970, and HMAC-SHA-256 over job and time
//! under the key's stored digest, which never leaves the database. So it holds on every machine of the service, for that one
//! job, and dies with its time or with its key. Rejected: a table of links (a write for each look, docs/adr/0071).

use super::{Caller, Principal, Role, unauthorized};
use crate::db::{Db, Scope, args};
use crate::error::Problem;
use crate::media::{base64, base64_bytes};
use ring::hmac;
use std::time::{SystemTime, UNIX_EPOCH};
use uuid::Uuid;

/// Begins every link's token.
pub const LINK_PREFIX: &str = "vsl_";
/// Longest life of a link, seconds.
pub const LONGEST: u64 = 86_400;

/// What a key signs with, if it is valid: its stored digest, and its tenant.
async fn secret(db: &Db, key: &str) -> Result<Option<(hmac::Key, String)>, Problem> {
    let sql = "SELECT digest, tenant FROM api_key WHERE id = $1 AND revoked_at IS NULL";
    let Some(row) = db.row(Scope::System, sql, args![key]).await? else { return Ok(None) };
    let digest: Vec<u8> = row.get("digest")?;
    Ok(Some((hmac::Key::new(hmac::HMAC_SHA256, &digest), row.get("tenant")?)))
}

fn message(job: Uuid, expires: u64) -> Vec<u8> {
    format!("vasculum link to {job} until {expires}").into_bytes()
}

/// Seconds since 1970. A link's time may be off by what the machines' clocks are.
fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// A token that shows `job` for `seconds`, made with the caller's key; and when it ends, seconds since 1970. `None`: the
/// caller came without an API key.
///
/// # Errors
/// The database's.
pub async fn sign(db: &Db, who: &Principal, job: Uuid, seconds: u64) -> Result<Option<(String, u64)>, Problem> {
    let Some((key, _)) = secret(db, &who.actor).await? else { return Ok(None) };
    let expires = now() + seconds.min(LONGEST);
    // URL-safe: the token stands in an address.
    let mac = base64(hmac::sign(&key, &message(job, expires)).as_ref());
    let mac = mac.trim_end_matches('=').replace('+', "-").replace('/', "_");
    Ok(Some((format!("{LINK_PREFIX}{}.{expires}.{mac}", who.actor), expires)))
}

/// The caller of a token, who may read that job alone.
///
/// # Errors
/// `auth.link`: forged, over, made by a key that is revoked, or used for something else than reading its job.
pub(super) async fn caller(db: &Db, token: &str, path: &str, safe: bool) -> Result<Caller, Problem> {
    let refused = || unauthorized("auth.link", "This link is over or was made for something else. Ask for a new one.");
    let mut parts = token.trim_start_matches(LINK_PREFIX).split('.');
    let (Some(id), Some(expires), Some(mac), None) = (parts.next(), parts.next(), parts.next(), parts.next()) else {
        return Err(refused());
    };
    let expires: u64 = expires.parse().map_err(|_| refused())?;
    let mac = base64_bytes(&mac.replace('-', "+").replace('_', "/")).ok_or_else(refused)?;
    let job = path.strip_prefix("/v1/jobs/").and_then(|rest| Uuid::parse_str(rest.split('/').next()?).ok());
    let (Some(job), true, true) = (job, safe, expires > now()) else { return Err(refused()) };
    let Some((key, tenant)) = secret(db, id).await? else { return Err(refused()) };
    hmac::verify(&key, &message(job, expires), &mac).map_err(|_| refused())?;
    Ok(Caller(Principal { tenant, role: Role::Read, actor: id.to_owned(), max_bytes: None }))
}
