//! Webhooks: messages from the outbox, signed, sent until they arrive.
//!
//! A message is written in the transaction of the job's end (queue/finish.rs), so none is lost and none tells of what
//! was not committed; it is sent at least once, and `webhook-id` lets the receiver drop a second copy. Signed as
//! Standard Webhooks 1.0 says: HMAC-SHA-256 over `id.timestamp.body`. A body holds the job's id and state only.
//!
//! The address comes from a user, so it must not reach into our own network: names are resolved here, every address
//! that is not public is refused, the connection goes to the address that was checked (a second resolution could answer
//! otherwise), and redirects are not followed.

use crate::config::Config;
use crate::db::{Db, Scope, args};
use crate::error::Problem;
use crate::media::{base64, rfc3339};
use axum::http::StatusCode;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// Begins every secret, as Standard Webhooks says.
const SECRET_PREFIX: &str = "whsec_";
/// Between looks at the outbox.
const POLL: Duration = Duration::from_secs(1);
/// A receiver that takes longer has failed.
const PATIENCE: Duration = Duration::from_secs(10);
/// A sender holds a message for this long, ms; beyond it another may send it.
const HOLD_MS: i64 = 30_000;
/// Pauses before the next attempts, ms: 5 s, 30 s, 2 min, 10 min, 1 h, 4 h, 12 h, 24 h; then the message is dropped.
const PAUSES_MS: [i64; 8] = [5_000, 30_000, 120_000, 600_000, 3_600_000, 14_400_000, 43_200_000, 86_400_000];
/// Most webhooks of a tenant.
pub(crate) const MOST: usize = 20;

/// A new secret and its key bytes in base 64.
///
/// # Errors
/// The operating system has no random bytes.
pub(crate) fn new_secret() -> Result<String, getrandom::Error> {
    let mut bytes = [0_u8; 32];
    getrandom::fill(&mut bytes)?;
    Ok(format!("{SECRET_PREFIX}{}", base64(&bytes)))
}

/// The `webhook-signature` of a message.
///
/// # Errors
/// A secret that was not made here.
pub fn signature(secret: &str, id: &str, timestamp: u64, body: &str) -> Result<String, Problem> {
    let bad = || Problem::internal("a webhook's secret cannot be read");
    let key = secret.strip_prefix(SECRET_PREFIX).and_then(crate::media::base64_bytes).ok_or_else(bad)?;
    let mut mac = Hmac::<Sha256>::new_from_slice(&key).map_err(|_| bad())?;
    mac.update(format!("{id}.{timestamp}.{body}").as_bytes());
    Ok(format!("v1,{}", base64(&mac.finalize().into_bytes())))
}

/// Where a message may go: the address and the public IP behind its name.
///
/// # Errors
/// `webhook.url`: not https, or a name that leads into a network that is not public.
pub(crate) async fn target(config: &Config, url: &str) -> Result<(reqwest::Url, SocketAddr), Problem> {
    let refuse = |why: &str| {
        Problem::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            "webhook.url",
            format!("This address cannot be a webhook: {why}."),
        )
    };
    let parsed = reqwest::Url::parse(url).map_err(|_| refuse("it is no URL"))?;
    let host = parsed.host_str().ok_or_else(|| refuse("it names no host"))?.to_owned();
    if !parsed.username().is_empty() || parsed.password().is_some() {
        return Err(refuse("it carries a user name or password"));
    }
    let port = parsed.port_or_known_default().ok_or_else(|| refuse("its scheme is not https"))?;
    let trusted = config.webhook_hosts.contains(&host);
    if parsed.scheme() != "https" && !(trusted && parsed.scheme() == "http") {
        return Err(refuse("its scheme is not https"));
    }
    let name = host.trim_matches(['[', ']']).to_owned();
    let found = tokio::net::lookup_host((name.as_str(), port)).await.map_err(|_| refuse("its host is not known"))?;
    let found: Vec<SocketAddr> = found.collect();
    if !trusted && found.iter().any(|address| !is_public(address.ip())) {
        return Err(refuse(
            "its host lies in a network that is not public; the operator may allow it by --webhook-host",
        ));
    }
    let address = found.first().copied().ok_or_else(|| refuse("its host has no address"))?;
    Ok((parsed, address))
}

/// Whether an address is reachable from everywhere: no loopback, private, link-local, shared, test or multicast network.
fn is_public(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(v4) => {
            let [a, b, c, _] = v4.octets();
            !(v4.is_private()
                || v4.is_loopback()
                || v4.is_link_local()
                || v4.is_multicast()
                || v4.is_broadcast()
                || v4.is_documentation()
                || a == 0
                || a >= 240
                || (a == 100 && (64..128).contains(&b))
                || (a == 192 && b == 0 && c == 0)
                || (a == 198 && (18..20).contains(&b)))
        }
        IpAddr::V6(v6) => {
            // Addresses that carry an IPv4 one (mapped, compatible, NAT64, 6to4) are judged by it.
            let s = v6.segments();
            let inner = |hi: u16, lo: u16| IpAddr::V4((u32::from(hi) << 16 | u32::from(lo)).into());
            if let Some(v4) = v6.to_ipv4() {
                return is_public(IpAddr::V4(v4));
            }
            if s[0] == 0x64 && s[1] == 0xff9b {
                return is_public(inner(s[6], s[7]));
            }
            if s[0] == 0x2002 {
                return is_public(inner(s[1], s[2]));
            }
            // Global unicast is 2000::/3; of it 2001:db8::/32 is documentation and 2001::/23 special.
            s[0] & 0xe000 == 0x2000 && !(s[0] == 0x2001 && (s[1] == 0xdb8 || s[1] < 0x200))
        }
    }
}

struct Message {
    id: String,
    url: String,
    secret: String,
    body: String,
    attempt: i64,
}

/// Sends what is due until shutdown. Several servers may send beside each other: a message is held by one at a time.
pub(crate) async fn deliver(db: Db, config: Arc<Config>, shutdown: CancellationToken) {
    while !shutdown.is_cancelled() {
        let sent = match next(&db).await {
            Ok(Some(message)) => {
                if let Err(error) = one(&db, &config, &message).await {
                    tracing::warn!(message = %message.id, %error, "outbox not written");
                }
                true
            }
            Ok(None) => false,
            Err(error) => {
                tracing::warn!(%error, "outbox not read");
                false
            }
        };
        if !sent {
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = tokio::time::sleep(POLL) => {}
            }
        }
    }
}

/// Holds the next message that is due.
async fn next(db: &Db) -> sqlx::Result<Option<Message>> {
    if db.row(Scope::System, "SELECT id FROM outbox WHERE run_at <= now_ms() LIMIT 1", Vec::new()).await?.is_none() {
        return Ok(None);
    }
    db.write(Scope::System, |tx| {
        Box::pin(async move {
            let hold = "UPDATE outbox SET run_at = now_ms() + $1, attempt = attempt + 1 WHERE id = \
                        (SELECT id FROM outbox WHERE run_at <= now_ms() ORDER BY run_at, id LIMIT 1 FOR UPDATE SKIP LOCKED) \
                        RETURNING id, webhook, body, attempt";
            let Some(row) = tx.row(hold, args![HOLD_MS]).await? else { return Ok(None) };
            let hook = "SELECT url, secret FROM webhook WHERE id = $1";
            let hook = tx.row(hook, args![row.get::<String>("webhook")?]).await?.ok_or(sqlx::Error::RowNotFound)?;
            Ok(Some(Message {
                id: row.get("id")?,
                url: hook.get("url")?,
                secret: hook.get("secret")?,
                body: row.get("body")?,
                attempt: row.get("attempt")?,
            }))
        })
    })
    .await
}

async fn one(db: &Db, config: &Config, message: &Message) -> sqlx::Result<()> {
    let Err(fault) = send(config, message).await else {
        db.run(Scope::System, "DELETE FROM outbox WHERE id = $1", args![&message.id]).await?;
        return Ok(());
    };
    let pause = usize::try_from(message.attempt - 1).ok().and_then(|k| PAUSES_MS.get(k));
    tracing::info!(message = %message.id, attempt = message.attempt, %fault, "webhook not delivered");
    match pause {
        Some(pause) => {
            let later = "UPDATE outbox SET run_at = now_ms() + $2, fault = $3 WHERE id = $1";
            db.run(Scope::System, later, args![&message.id, *pause, fault]).await?;
        }
        None => {
            tracing::warn!(message = %message.id, "webhook given up");
            db.run(Scope::System, "DELETE FROM outbox WHERE id = $1", args![&message.id]).await?;
        }
    }
    Ok(())
}

async fn send(config: &Config, message: &Message) -> Result<(), String> {
    let (url, address) = target(config, &message.url).await.map_err(|p| p.detail)?;
    let body = body(&message.body).ok_or("the message cannot be read")?;
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let signature = signature(&message.secret, &message.id, now, &body).map_err(|p| p.detail)?;
    let client = reqwest::Client::builder()
        .redirect(reqwest::redirect::Policy::none())
        .timeout(PATIENCE)
        .no_proxy()
        .resolve(url.host_str().unwrap_or_default(), address)
        .build()
        .map_err(|e| e.to_string())?;
    let answer = client
        .post(url)
        .header("content-type", "application/json")
        .header("webhook-id", &message.id)
        .header("webhook-timestamp", now.to_string())
        .header("webhook-signature", signature)
        .body(body)
        .send()
        .await
        .map_err(|e| e.without_url().to_string())?;
    if answer.status().is_success() { Ok(()) } else { Err(format!("the receiver answered {}", answer.status())) }
}

/// The payload of Standard Webhooks for what the outbox holds.
fn body(held: &str) -> Option<String> {
    let held: serde_json::Value = serde_json::from_str(held).ok()?;
    let state = held["state"].as_str()?;
    Some(
        serde_json::json!({
            "type": format!("job.{state}"),
            "timestamp": rfc3339(held["at"].as_i64()?)?,
            "data": {"id": held["id"], "state": state, "href": format!("/v1/jobs/{}", held["id"].as_str()?)}
        })
        .to_string(),
    )
}

/// A webhook as it is listed: never its secret.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct WebhookRow {
    pub(crate) id: String,
    pub(crate) url: String,
    pub(crate) created_at: i64,
}

/// Adds a webhook of a tenant; `None` when it has [`MOST`] already.
pub(crate) async fn add(db: &Db, tenant: &str, url: &str, secret: &str) -> sqlx::Result<Option<Uuid>> {
    if list(db, tenant).await?.len() >= MOST {
        return Ok(None);
    }
    let id = Uuid::now_v7();
    let sql = "INSERT INTO webhook (id, tenant, url, secret, created_at) VALUES ($1, $2, $3, $4, now_ms())";
    db.run(Scope::Tenant(tenant), sql, args![id, tenant, url, secret]).await?;
    Ok(Some(id))
}

/// The webhooks of a tenant.
pub(crate) async fn list(db: &Db, tenant: &str) -> sqlx::Result<Vec<WebhookRow>> {
    let sql = "SELECT id, url, created_at FROM webhook WHERE tenant = $1 ORDER BY id";
    let rows = db.rows(Scope::Tenant(tenant), sql, args![tenant]).await?;
    let read = |row: &crate::db::Row| {
        Ok(WebhookRow { id: row.get("id")?, url: row.get("url")?, created_at: row.get("created_at")? })
    };
    rows.iter().map(read).collect()
}

/// Removes a webhook and what waits for it; whether there was one.
pub(crate) async fn remove(db: &Db, tenant: &str, id: Uuid) -> sqlx::Result<bool> {
    let sql = "DELETE FROM webhook WHERE id = $1 AND tenant = $2";
    Ok(db.run(Scope::Tenant(tenant), sql, args![id, tenant]).await? > 0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_signature_is_that_of_the_specification() {
        // The example of the Standard Webhooks specification's libraries.
        let signed = signature(
            "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
            "msg_p5jXN8AQM9LWM0D4loKWxJek",
            1_614_265_330,
            "{\"test\": 2432232314}",
        );
        assert_eq!(signed.unwrap(), "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }

    #[test]
    fn only_public_addresses_pass() {
        for inside in [
            "127.0.0.1",
            "10.0.0.1",
            "172.16.9.9",
            "192.168.1.1",
            "169.254.169.254",
            "100.64.0.1",
            "0.0.0.0",
            "224.0.0.1",
            "255.255.255.255",
            "198.18.0.1",
            "::1",
            "::",
            "fe80::1",
            "fc00::1",
            "::ffff:127.0.0.1",
            "64:ff9b::7f00:1",
            "2002:7f00:1::",
            "2001:db8::1",
            "ff02::1",
            "::7f00:1",
        ] {
            assert!(!is_public(inside.parse().unwrap()), "{inside}");
        }
        for outside in ["1.1.1.1", "8.8.8.8", "2606:4700:4700::1111", "::ffff:8.8.8.8", "172.32.0.1"] {
            assert!(is_public(outside.parse().unwrap()), "{outside}");
        }
    }

    #[tokio::test]
    async fn addresses_into_our_own_network_are_refused() {
        let config = Config::default();
        for bad in [
            "http://example.com/",
            "https://127.0.0.1/",
            "https://[::1]/",
            "https://localhost/",
            "file:///etc/passwd",
            "https://u:p@example.com/",
            "https://0x7f000001/",
            "https://2130706433/",
            "nonsense",
        ] {
            assert_eq!(target(&config, bad).await.unwrap_err().code, "webhook.url", "{bad}");
        }
        let trusting = Config { webhook_hosts: vec!["localhost".to_owned()], ..Config::default() };
        assert!(target(&trusting, "http://localhost:1/").await.is_ok());
    }
}
