//! The public keys of an identity provider, fetched when needed and kept for a while.
//!
//! A token names its key (`kid`). A name that is not in the set may be that of a new key, so the set is fetched again for
//! it, but at most once in [`crate::config::Oidc::refresh_seconds`]: strangers with invented names must not make this
//! service a hammer on the provider. The answer is bounded in size and time, and a redirect is an error: where the keys
//! are is the operator's word alone. A set that cannot be renewed counts for [`STALE`]; after that nobody gets in.

use crate::config::Oidc;
use anyhow::{Context as _, ensure};
use futures::StreamExt as _;
use jsonwebtoken::jwk::{Jwk, PublicKeyUse};
use jsonwebtoken::{Algorithm, DecodingKey};
use serde::Deserialize;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// A set of this age is fetched again before it is used.
const FRESH: Duration = Duration::from_secs(600);
/// A set of this age is not used any more, whatever the provider's trouble.
const STALE: Duration = Duration::from_secs(3600);
/// Shortest time between fetches after one that failed.
const AFTER_FAULT: Duration = Duration::from_secs(5);
/// Longest time of a fetch.
const PATIENCE: Duration = Duration::from_secs(5);
/// Largest set, bytes; Microsoft's, the largest known, has 20 kB.
const LARGEST: usize = 256 << 10;
/// Most keys of a set.
const MOST: usize = 64;

/// A key and what it may be used for.
#[derive(Debug)]
pub(super) struct Key {
    id: String,
    /// The algorithm that the set names for it.
    algorithm: Option<Algorithm>,
    pub(super) decoding: DecodingKey,
}

impl Key {
    /// Whether a token of this algorithm may be checked with it: a token does not choose what a key is for.
    pub(super) fn fits(&self, algorithm: Algorithm) -> bool {
        self.algorithm.map_or(self.decoding.family() == algorithm.family(), |own| own == algorithm)
    }
}

#[derive(Debug, Default)]
struct Set {
    keys: Vec<Arc<Key>>,
    fetched: Option<Instant>,
}

/// Why there is no key.
#[derive(Debug)]
pub(super) enum Lack {
    /// The provider has no key of this name.
    Unknown,
    /// The provider does not answer, and no set is left that counts.
    Away,
}

/// The provider's keys.
#[derive(Debug)]
pub(super) struct Keys {
    url: String,
    refresh: Duration,
    client: reqwest::Client,
    set: RwLock<Arc<Set>>,
    /// When the last fetch began, and whether it failed. Held while fetching, so that one caller fetches for all.
    tried: tokio::sync::Mutex<Option<(Instant, bool)>>,
}

impl Keys {
    /// # Errors
    /// The HTTP client cannot be made.
    pub(super) fn new(settings: &Oidc) -> anyhow::Result<Self> {
        let client = reqwest::Client::builder()
            .redirect(reqwest::redirect::Policy::none())
            .timeout(PATIENCE)
            .build()
            .context("no client for the identity provider's keys")?;
        Ok(Self {
            url: settings.jwks_url.clone(),
            refresh: Duration::from_secs(settings.refresh_seconds),
            client,
            set: RwLock::default(),
            tried: tokio::sync::Mutex::default(),
        })
    }

    /// The key of this name.
    pub(super) async fn key(&self, id: &str) -> Result<Arc<Key>, Lack> {
        let set = self.now();
        if let (Some(key), true) = (find(&set, id), younger(&set, FRESH)) {
            return Ok(key);
        }
        self.renew(&set).await;
        let set = self.now();
        if !younger(&set, STALE) {
            return Err(Lack::Away);
        }
        find(&set, id).ok_or(Lack::Unknown)
    }

    fn now(&self) -> Arc<Set> {
        Arc::clone(&self.set.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Fetches the set unless that was done a moment ago, by this caller or another.
    async fn renew(&self, seen: &Arc<Set>) {
        let mut tried = self.tried.lock().await;
        let pause = |failed| if failed { AFTER_FAULT.min(self.refresh) } else { self.refresh };
        let soon = tried.is_some_and(|(at, failed)| at.elapsed() < pause(failed));
        if soon || !Arc::ptr_eq(seen, &self.now()) {
            return;
        }
        let fetched = self.fetch().await;
        *tried = Some((Instant::now(), fetched.is_err()));
        match fetched {
            Ok(keys) => {
                tracing::info!(keys = keys.len(), "fetched the identity provider's keys");
                let set = Arc::new(Set { keys, fetched: Some(Instant::now()) });
                *self.set.write().unwrap_or_else(PoisonError::into_inner) = set;
            }
            Err(error) => {
                tracing::warn!(cause = %format!("{error:#}"), "the identity provider's keys cannot be fetched")
            }
        }
    }

    async fn fetch(&self) -> anyhow::Result<Vec<Arc<Key>>> {
        let answer = self.client.get(&self.url).header("accept", "application/json").send().await?;
        ensure!(answer.status().as_u16() == 200, "{} answers {}", self.url, answer.status());
        let mut bytes = Vec::new();
        let mut parts = answer.bytes_stream();
        while let Some(part) = parts.next().await {
            bytes.extend_from_slice(&part?);
            ensure!(bytes.len() <= LARGEST, "the answer is larger than {LARGEST} bytes");
        }
        let keys = read(&bytes)?;
        ensure!(!keys.is_empty(), "{} names no key that could be used", self.url);
        Ok(keys)
    }
}

fn find(set: &Set, id: &str) -> Option<Arc<Key>> {
    set.keys.iter().find(|key| key.id == id).map(Arc::clone)
}

fn younger(set: &Set, age: Duration) -> bool {
    set.fetched.is_some_and(|at| at.elapsed() < age)
}

/// The usable keys of a set; one that is not understood is left out, because a set may hold keys for others.
fn read(bytes: &[u8]) -> anyhow::Result<Vec<Arc<Key>>> {
    #[derive(Deserialize)]
    struct Document {
        keys: Vec<serde_json::Value>,
    }
    let document: Document = serde_json::from_slice(bytes).context("the answer is no JSON Web Key Set")?;
    let usable = document.keys.into_iter().take(MOST).filter_map(|value| {
        let jwk: Jwk = serde_json::from_value(value).ok()?;
        if matches!(jwk.common.public_key_use, Some(ref kind) if *kind != PublicKeyUse::Signature) {
            return None;
        }
        let named = jwk.common.key_algorithm.map(|name| name.to_string().parse::<Algorithm>());
        // An algorithm that is not one of a signature's makes the key one for something else.
        let algorithm = named.transpose().ok()?;
        let decoding = DecodingKey::from_jwk(&jwk).ok()?;
        Some(Arc::new(Key { id: jwk.common.key_id?, algorithm, decoding }))
    });
    Ok(usable.collect())
}
