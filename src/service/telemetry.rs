//! Metrics: names, the recorder, and the gauges that are read at scrape time. Logs go through `tracing`; the binary
//! installs the subscriber.

use crate::error::Problem;
use crate::state::{State, UPLOAD_UNIT};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use std::sync::OnceLock;

/// Requests by method, route and status.
pub const REQUESTS: &str = "vasculum_http_requests_total";
/// Duration of requests, seconds.
pub const DURATION: &str = "vasculum_http_request_duration_seconds";
/// Jobs by state, at scrape.
const JOBS: &str = "vasculum_jobs";
/// Age of the oldest queued job, seconds.
const OLDEST: &str = "vasculum_oldest_queued_seconds";
/// Jobs held by this process.
const HELD: &str = "vasculum_jobs_held";
/// Workers that spoke within the last minute, on every machine.
const WORKERS: &str = "vasculum_workers";
/// Free space of the data folder's disk, bytes.
const DISK: &str = "vasculum_disk_free_bytes";
/// Memory left for uploads, bytes.
const UPLOADS: &str = "vasculum_upload_memory_free_bytes";
/// From 1 ms to a minute.
const BUCKETS: &[f64] = &[0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 60.0];

/// The recorder's handle. The recorder is one per process and is installed at the first call.
pub fn recorder() -> PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    HANDLE
        .get_or_init(|| {
            let builder = PrometheusBuilder::new();
            // The buckets are not empty, which is the only reason for an error.
            let recorder = builder
                .set_buckets_for_metric(Matcher::Full(DURATION.to_owned()), BUCKETS)
                .unwrap_or_default()
                .build_recorder();
            let handle = recorder.handle();
            if metrics::set_global_recorder(recorder).is_err() {
                tracing::warn!("another metrics recorder is installed; /metrics shows only gauges");
            }
            metrics::describe_counter!(REQUESTS, "HTTP requests by method, route and status");
            metrics::describe_histogram!(DURATION, "HTTP request duration in seconds");
            metrics::describe_gauge!(JOBS, "Jobs by state");
            metrics::describe_gauge!(OLDEST, "Age of the oldest queued job in seconds");
            metrics::describe_gauge!(WORKERS, "Workers that spoke within the last minute, on every machine");
            metrics::describe_gauge!(DISK, "Free space of the data folder's disk in bytes");
            metrics::describe_gauge!(UPLOADS, "Memory left for uploads in bytes");
            metrics::describe_gauge!(HELD, "Jobs held by the workers of this process");
            handle
        })
        .clone()
}

/// The text of /metrics, gauges read now.
///
/// # Errors
/// The database's.
pub async fn scrape(state: &State) -> Result<String, Problem> {
    let counts = state.queue.counts(None).await?;
    let by_state = [
        ("queued", counts.queued),
        ("running", counts.running),
        ("succeeded", counts.succeeded),
        ("failed", counts.failed),
        ("cancelled", counts.cancelled),
    ];
    for (name, count) in by_state {
        metrics::gauge!(JOBS, "state" => name).set(as_f64(count));
    }
    metrics::gauge!(OLDEST).set(as_f64(counts.oldest_queued_ms) / 1000.0);
    let held = state.worker.as_ref().map_or(0, |w| w.heartbeat.held());
    metrics::gauge!(HELD).set(as_f64(i64::try_from(held).unwrap_or(i64::MAX)));
    let workers = state.queue.workers().await?.len();
    metrics::gauge!(WORKERS).set(as_f64(i64::try_from(workers).unwrap_or(i64::MAX)));
    let disk = crate::http::disk_free(state);
    metrics::gauge!(DISK).set(as_f64(i64::try_from(disk).unwrap_or(i64::MAX)));
    let uploads = state.uploads.available_permits() as u64 * UPLOAD_UNIT;
    metrics::gauge!(UPLOADS).set(as_f64(i64::try_from(uploads).unwrap_or(i64::MAX)));
    state.metrics.run_upkeep();
    Ok(state.metrics.render())
}

/// Counts and bytes below 2^53 are exact in f64.
#[allow(clippy::cast_precision_loss)]
fn as_f64(count: i64) -> f64 {
    count as f64
}
