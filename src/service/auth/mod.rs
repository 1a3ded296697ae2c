//! Who calls: API keys, and what a role may do.
//!
//! A key is `vsk_` and 256 random bits in hexadecimal; only its SHA-256 is stored (nothing of low entropy, so no slow
//! hash). It comes as `Authorization: Bearer` or, for the portal's own page, as an HttpOnly SameSite=Strict cookie
//! that `POST /v1/session` sets; a changing call by cookie must come from the same origin. Whatever else comes as a bearer
//! is a token of the configured identity provider ([`oidc`]), or nothing.

mod callers;
mod jwks;
pub mod keys;
pub mod links;
mod oidc;
mod pace;
pub mod tenants;

pub(crate) use callers::Callers;
pub use oidc::Provider;

use crate::config::Auth;
use crate::db::{Db, Scope, args};
use crate::error::Problem;
use crate::state::State;
use crate::store::hex;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode, header};
use sha2::{Digest as _, Sha256};
use uuid::Uuid;

/// Begins every API key.
pub const KEY_PREFIX: &str = "vsk_";
/// The portal's cookie.
pub const COOKIE: &str = "vasculum_key";
/// The tenant of a service that knows only one.
pub const DEFAULT_TENANT: &str = "default";

/// What a key may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Send scans and read one's results.
    Upload,
    /// Read only.
    Read,
    /// Everything.
    Admin,
    /// Read the audit only.
    Auditor,
}

/// What a call wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// See jobs and results.
    Read,
    /// Create, cancel, retry or erase jobs.
    Change,
    /// Read the audit.
    Audit,
    /// Make and revoke keys, set what holds for the tenant.
    Administer,
}

impl Role {
    /// The role of a word.
    pub fn of(word: &str) -> Option<Self> {
        [Self::Upload, Self::Read, Self::Admin, Self::Auditor].into_iter().find(|role| role.as_str() == word)
    }

    /// The word in the table and on the command line.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Read => "read",
            Self::Admin => "admin",
            Self::Auditor => "auditor",
        }
    }

    /// Whether this role may do that.
    pub fn may(self, action: Action) -> bool {
        match action {
            Action::Read => self != Self::Auditor,
            Action::Change => matches!(self, Self::Upload | Self::Admin),
            Action::Audit => matches!(self, Self::Auditor | Self::Admin),
            Action::Administer => self == Self::Admin,
        }
    }
}

/// The caller, as an extractor: a handler that takes it cannot be reached without one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Principal {
    /// Whose jobs are seen.
    pub tenant: String,
    /// What may be done.
    pub role: Role,
    /// Which key: its id, for the audit. `oidc:` and the subject of a token; `open` for a service without keys.
    pub actor: String,
    /// Largest upload of this key, bytes.
    pub max_bytes: Option<u64>,
}

/// A new random key.
///
/// # Errors
/// The operating system has no random bytes.
pub fn new_key() -> Result<String, getrandom::Error> {
    let mut bytes = [0_u8; 32];
    getrandom::fill(&mut bytes)?;
    Ok(format!("{KEY_PREFIX}{}", hex(&bytes)))
}

/// Makes the first admin key and returns it, or `None` when there is a key already.
///
/// # Errors
/// The database's; no random bytes.
pub async fn first_key(db: &Db) -> anyhow::Result<Option<String>> {
    let key = new_key().map_err(|e| anyhow::anyhow!("no random bytes for a key: {e}"))?;
    let sql = "INSERT INTO api_key (id, tenant, role, label, digest, created_at) \
               SELECT $1, $2, 'admin', 'first start', $3, now_ms() \
               WHERE NOT EXISTS (SELECT 1 FROM api_key WHERE revoked_at IS NULL)";
    let made = db.run(Scope::System, sql, args![Uuid::now_v7(), DEFAULT_TENANT, digest(&key)]).await?;
    Ok((made > 0).then_some(key))
}

fn digest(key: &str) -> Vec<u8> {
    Sha256::digest(key.as_bytes()).to_vec()
}

/// The principal of a key, or a 401.
async fn principal(state: &State, key: &str) -> Result<Principal, Problem> {
    let found = state.callers.found(state.queue.db(), digest(key)).await?;
    let Some(found) = found else {
        return Err(unauthorized("auth.key", "This API key is unknown or revoked. Ask the operator for a new one."));
    };
    let role = Role::of(&found.role).ok_or_else(|| Problem::internal("a key with an unknown role"))?;
    if let Some(most) = found.requests_per_minute {
        pace::count(&found.id, most)?;
    }
    let max_bytes = found.max_bytes.and_then(|n| u64::try_from(n).ok());
    Ok(Principal { tenant: found.tenant, role, actor: found.id, max_bytes })
}

/// The caller of an API key or of a token.
///
/// # Errors
/// `auth.key`, `auth.token` and what else the check says; the database's.
pub async fn known(state: &State, secret: &str) -> Result<Principal, Problem> {
    match &state.provider {
        Some(provider) if !secret.starts_with(KEY_PREFIX) => provider.principal(state.queue.db(), secret).await,
        _ => principal(state, secret).await,
    }
}

fn unauthorized(code: &str, detail: &str) -> Problem {
    Problem::new(StatusCode::UNAUTHORIZED, code, detail).with_header("www-authenticate", "Bearer realm=\"vasculum\"")
}

/// The key of a request's headers.
enum Sent<'a> {
    Bearer(&'a str),
    Cookie(&'a str),
}

fn sent(headers: &HeaderMap) -> Option<Sent<'_>> {
    if let Some(value) = headers.get(header::AUTHORIZATION) {
        let (scheme, key) = value.to_str().ok()?.split_once(' ')?;
        return scheme.eq_ignore_ascii_case("bearer").then(|| Sent::Bearer(key.trim()));
    }
    headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'))
        .find_map(|pair| pair.trim().strip_prefix(COOKIE)?.strip_prefix('='))
        .map(Sent::Cookie)
}

/// A page of another origin may make the browser send our cookie in spite of SameSite (an old browser): refuse it.
fn same_origin(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|v: &axum::http::HeaderValue| v.to_str().ok());
    match (text(header::ORIGIN), text(header::HOST)) {
        (None, _) => true,
        (Some(origin), Some(host)) => origin.split_once("://").is_some_and(|(_, from)| from == host),
        (Some(_), None) => false,
    }
}

/// A caller who is known, before it is known what for: a handler says what it wants by [`Caller::may`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller(Principal);

impl Caller {
    /// The principal, whatever its role: for calls that only say who it is.
    pub fn known(self) -> Principal {
        self.0
    }

    /// The principal, if its role may do that.
    ///
    /// # Errors
    /// `auth.role`.
    pub fn may(self, action: Action) -> Result<Principal, Problem> {
        if self.0.role.may(action) {
            Ok(self.0)
        } else {
            Err(Problem::new(
                StatusCode::FORBIDDEN,
                "auth.role",
                "This key or token may not do that. Ask the operator.",
            ))
        }
    }
}

impl FromRequestParts<State> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &State) -> Result<Self, Problem> {
        let safe = parts.method.is_safe();
        if state.config.auth == Auth::None {
            return Ok(Self(Principal {
                tenant: DEFAULT_TENANT.to_owned(),
                role: Role::Admin,
                actor: "open".to_owned(),
                max_bytes: None,
            }));
        }
        match sent(&parts.headers) {
            None => Err(unauthorized(
                "auth.missing",
                "This call needs an API key: send the header Authorization: Bearer vsk_...",
            )),
            Some(Sent::Cookie(_)) if !safe && !same_origin(&parts.headers) => Err(Problem::new(
                StatusCode::FORBIDDEN,
                "auth.origin",
                "A page of another origin may not change anything here by cookie.",
            )),
            Some(Sent::Bearer(token)) if token.starts_with(links::LINK_PREFIX) => {
                links::caller(state.queue.db(), token, parts.uri.path(), safe).await
            }
            Some(Sent::Bearer(key) | Sent::Cookie(key)) => Ok(Self(known(state, key).await?)),
        }
    }
}

/// A caller who may administer the tenant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Administrator(pub Principal);

impl FromRequestParts<State> for Administrator {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &State) -> Result<Self, Problem> {
        Caller::from_request_parts(parts, state).await?.may(Action::Administer).map(Self)
    }
}

impl FromRequestParts<State> for Principal {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &State) -> Result<Self, Problem> {
        let action = if parts.method.is_safe() { Action::Read } else { Action::Change };
        Caller::from_request_parts(parts, state).await?.may(action)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_long_and_differ() {
        let (a, b) = (new_key().unwrap(), new_key().unwrap());
        assert_ne!(a, b);
        assert_eq!(a.len(), KEY_PREFIX.len() + 64);
    }

    #[test]
    fn a_bearer_goes_before_a_cookie() {
        let mut headers = HeaderMap::new();
        headers.insert(header::COOKIE, "a=b; vasculum_key=vsk_c".parse().unwrap());
        assert!(matches!(sent(&headers), Some(Sent::Cookie("vsk_c"))));
        headers.insert(header::AUTHORIZATION, "bearer vsk_b".parse().unwrap());
        assert!(matches!(sent(&headers), Some(Sent::Bearer("vsk_b"))));
        headers.insert(header::AUTHORIZATION, "Basic dXNlcg==".parse().unwrap());
        assert!(sent(&headers).is_none());
    }

    #[test]
    fn another_origin_is_seen() {
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, "127.0.0.1:8080".parse().unwrap());
        assert!(same_origin(&headers));
        headers.insert(header::ORIGIN, "http://127.0.0.1:8080".parse().unwrap());
        assert!(same_origin(&headers));
        headers.insert(header::ORIGIN, "http://evil.example".parse().unwrap());
        assert!(!same_origin(&headers));
    }
}
