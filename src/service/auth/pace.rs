//! Requests per minute of a key, counted in this process by a bucket that refills steadily.
//!
//! Behind several API servers each counts for itself, so a key may have its rate once per server. A bucket holds as many
//! requests as the key may send in a minute, so a burst passes and a flood does not.

use crate::error::Problem;
use axum::http::StatusCode;
use std::collections::BTreeMap;
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::Instant;

/// Milliseconds in a minute: the unit in which a bucket is filled, so that whole numbers suffice.
const MINUTE_MS: i64 = 60_000;

struct Bucket {
    /// Requests left, in units of 1/60,000.
    left: i64,
    at: Instant,
}

static BUCKETS: LazyLock<Mutex<BTreeMap<String, Bucket>>> = LazyLock::new(Mutex::default);

/// Counts one request of a key that may send `most` a minute.
///
/// # Errors
/// `auth.rate` (429) with the time after which there is room again.
pub(super) fn count(key: &str, most: i64) -> Result<(), Problem> {
    let most = most.max(1);
    let now = Instant::now();
    let mut buckets = BUCKETS.lock().unwrap_or_else(PoisonError::into_inner);
    let bucket = buckets.entry(key.to_owned()).or_insert(Bucket { left: most * MINUTE_MS, at: now });
    let passed = i64::try_from(now.duration_since(bucket.at).as_millis()).unwrap_or(MINUTE_MS).min(MINUTE_MS);
    bucket.left = (bucket.left + passed * most).min(most * MINUTE_MS);
    bucket.at = now;
    if bucket.left >= MINUTE_MS {
        bucket.left -= MINUTE_MS;
        return Ok(());
    }
    let seconds = ((MINUTE_MS - bucket.left) / most / 1000).max(0) + 1;
    Err(Problem::new(
        StatusCode::TOO_MANY_REQUESTS,
        "auth.rate",
        format!("This key may send {most} requests a minute. Send again after {seconds} s."),
    )
    .with_header("retry-after", seconds.to_string()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_burst_passes_and_a_flood_does_not() {
        for _ in 0..30 {
            count("k", 30).unwrap();
        }
        let refused = count("k", 30).unwrap_err();
        assert_eq!((refused.status, refused.code.as_str()), (429, "auth.rate"));
        assert!(count("other", 30).is_ok());
    }
}
