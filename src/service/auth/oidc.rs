//! Bearer tokens of an identity provider (OpenID Connect): signature, issuer, audience and time are checked here, and
//! the token's claims say tenant and role.
//!
//! Only signatures by a private key count (RS256, ES256, EdDSA): `none` and the HMAC family, with which a public key
//! could be made a secret, are refused before a key is looked for. A tenant must exist already (`vasculum key create
//! --tenant`): a claim makes none. Nothing of a token but its `sub` is kept, in the audit.

use super::jwks::{Keys, Lack};
use super::{Principal, Role};
use crate::config::Oidc;
use crate::db::{Db, Scope, args};
use crate::error::Problem;
use anyhow::ensure;
use axum::http::StatusCode;
use jsonwebtoken::{Algorithm, Validation, decode, decode_header};
use serde_json::{Map, Value};

/// Algorithms that count.
const ALGORITHMS: [Algorithm; 3] = [Algorithm::RS256, Algorithm::ES256, Algorithm::EdDSA];
/// How far the provider's clock may be off, seconds.
const LEEWAY: u64 = 30;
/// Longest token, bytes.
const LONGEST: usize = 16 << 10;
/// Longest `sub`; OpenID Connect allows no more.
const LONGEST_SUBJECT: usize = 255;
/// Roles from the strongest; of several in a claim the first one counts.
const STRONGEST: [Role; 4] = [Role::Admin, Role::Upload, Role::Read, Role::Auditor];

/// Checks tokens of one provider.
#[derive(Debug)]
pub struct Provider {
    settings: Oidc,
    keys: Keys,
}

impl Provider {
    /// A provider by its settings; its keys are fetched with the first token.
    ///
    /// # Errors
    /// Keys from a host by plain http: whoever stands between could put his own there. Loopback is excepted.
    pub fn new(settings: &Oidc) -> anyhow::Result<Self> {
        let url = reqwest::Url::parse(&settings.jwks_url)
            .map_err(|e| anyhow::anyhow!("--oidc-jwks-url {}: {e}", settings.jwks_url))?;
        let loopback = matches!(url.host_str(), Some("localhost" | "127.0.0.1" | "[::1]"));
        ensure!(
            url.scheme() == "https" || (url.scheme() == "http" && loopback),
            "--oidc-jwks-url must begin with https:// (http:// only on this machine)"
        );
        ensure!(!settings.issuer.is_empty() && !settings.audience.is_empty(), "OIDC needs an issuer and an audience");
        Ok(Self { settings: settings.clone(), keys: Keys::new(settings)? })
    }

    /// The caller that a token names.
    ///
    /// # Errors
    /// `auth.token` (401) when it does not count; `auth.tenant`, `auth.role` (403) when its claims name none of ours;
    /// `auth.provider` (503) when its key cannot be fetched.
    pub(super) async fn principal(&self, db: &Db, token: &str) -> Result<Principal, Problem> {
        let claims = self.claims(token).await?;
        let subject = claims.get("sub").and_then(Value::as_str).unwrap_or_default();
        if subject.is_empty() || subject.len() > LONGEST_SUBJECT || subject.chars().any(char::is_control) {
            return Err(refused("it names no subject"));
        }
        let role = role_of(claim(&claims, &self.settings.role_claim)).ok_or_else(|| {
            let detail = format!(
                "The token's claim `{}` names none of the roles upload, read, admin and auditor. Ask the operator.",
                self.settings.role_claim
            );
            Problem::new(StatusCode::FORBIDDEN, "auth.role", detail)
        })?;
        let tenant = match claim(&claims, &self.settings.tenant_claim).and_then(Value::as_str) {
            Some(named) => db.row(Scope::System, "SELECT id FROM tenant WHERE id = $1", args![named]).await?,
            None => None,
        };
        let tenant = tenant.ok_or_else(|| {
            let detail = format!(
                "The token's claim `{}` names no tenant of this service. Ask the operator.",
                self.settings.tenant_claim
            );
            Problem::new(StatusCode::FORBIDDEN, "auth.tenant", detail)
        })?;
        Ok(Principal { tenant: tenant.get("id")?, role, actor: format!("oidc:{subject}"), max_bytes: None })
    }

    /// The claims of a token that counts.
    async fn claims(&self, token: &str) -> Result<Map<String, Value>, Problem> {
        if token.len() > LONGEST {
            return Err(refused("it is too long"));
        }
        let header = decode_header(token).map_err(|_| refused("it is no signed token"))?;
        if !ALGORITHMS.contains(&header.alg) {
            return Err(refused("only RS256, ES256 and EdDSA count"));
        }
        let id = header.kid.ok_or_else(|| refused("it does not name its key"))?;
        let key = self.keys.key(&id).await.map_err(|lack| match lack {
            Lack::Unknown => refused("the identity provider has no such key"),
            Lack::Away => away(),
        })?;
        if !key.fits(header.alg) {
            return Err(refused("its key is for another algorithm"));
        }
        let mut rules = Validation::new(header.alg);
        rules.set_issuer(&[&self.settings.issuer]);
        rules.set_audience(&[&self.settings.audience]);
        rules.set_required_spec_claims(&["exp", "iss", "aud", "sub"]);
        rules.validate_nbf = true;
        rules.leeway = LEEWAY;
        match decode::<Map<String, Value>>(token, &key.decoding, &rules) {
            Ok(data) => Ok(data.claims),
            Err(error) => {
                tracing::debug!(%error, "a token is refused");
                Err(refused("signature, issuer, audience or time do not fit"))
            }
        }
    }
}

fn refused(why: &str) -> Problem {
    Problem::new(
        StatusCode::UNAUTHORIZED,
        "auth.token",
        format!("This token does not count: {why}. Ask the identity provider for a new one."),
    )
    .with_header("www-authenticate", "Bearer realm=\"vasculum\", error=\"invalid_token\"")
}

fn away() -> Problem {
    Problem::new(
        StatusCode::SERVICE_UNAVAILABLE,
        "auth.provider",
        "The identity provider's keys cannot be fetched at the moment. Try again.",
    )
    .with_header("retry-after", "5")
}

/// A claim by its name, or by a path of names with dots between (`realm_access.roles`).
fn claim<'a>(claims: &'a Map<String, Value>, name: &str) -> Option<&'a Value> {
    if let Some(value) = claims.get(name) {
        return Some(value);
    }
    let (first, rest) = name.split_once('.')?;
    claim(claims.get(first)?.as_object()?, rest)
}

/// The strongest role that a claim names, as one word or as a list.
fn role_of(claim: Option<&Value>) -> Option<Role> {
    let words: Vec<&str> = match claim? {
        Value::String(word) => vec![word],
        Value::Array(list) => list.iter().filter_map(Value::as_str).collect(),
        _ => return None,
    };
    STRONGEST.into_iter().find(|role| words.contains(&role.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn claims_are_found_by_name_and_by_path() {
        let claims =
            json!({"https://ward.example/tenant": "north", "realm_access": {"roles": ["x", "read", "upload"]}});
        let claims = claims.as_object().unwrap();
        assert_eq!(claim(claims, "https://ward.example/tenant").and_then(Value::as_str), Some("north"));
        assert_eq!(role_of(claim(claims, "realm_access.roles")), Some(Role::Upload));
        assert_eq!(role_of(claim(claims, "realm_access")), None);
        assert_eq!(claim(claims, "realm_access.tenant"), None);
        assert_eq!(role_of(Some(&json!("root"))), None);
    }

    #[test]
    fn keys_come_by_tls_or_from_this_machine() {
        let settings =
            |url: &str| Oidc { issuer: "i".into(), audience: "a".into(), jwks_url: url.into(), ..Oidc::default() };
        crate::tls::provide();
        for good in ["https://id.example/keys", "http://127.0.0.1:1/keys", "http://localhost/keys"] {
            assert!(Provider::new(&settings(good)).is_ok(), "{good}");
        }
        for bad in ["http://id.example/keys", "ftp://127.0.0.1/keys", "keys", "http://127.0.0.1.evil.example/keys"] {
            assert!(Provider::new(&settings(bad)).is_err(), "{bad}");
        }
    }
}
