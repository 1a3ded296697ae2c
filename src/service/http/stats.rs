//! How busy the service is.

use crate::auth::Principal;
use crate::error::Problem;
use crate::state::{State, UPLOAD_UNIT};
use axum::Json;
use axum::extract::State as Shared;
use serde::Serialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(stats))
}

/// Jobs per state.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct JobCounts {
    queued: i64,
    running: i64,
    succeeded: i64,
    failed: i64,
    cancelled: i64,
}

/// Figures of the queue and of this process.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Stats {
    /// The caller's jobs.
    jobs: JobCounts,
    /// Age of the caller's oldest queued job, seconds.
    oldest_queued_s: f64,
    /// Jobs that this process can run at the same time.
    workers: usize,
    /// Jobs that this process holds.
    workers_busy: usize,
    /// Memory left for uploads, bytes.
    upload_memory_free: u64,
    /// Free space of the data folder's disk, bytes.
    disk_free: u64,
}

/// Counts jobs and says what is free.
#[utoipa::path(get, path = "/v1/stats", operation_id = "read_stats", tag = "monitoring", security(("key" = [])), responses(
    (status = 200, description = "Figures", body = Stats)
))]
async fn stats(Shared(state): Shared<State>, who: Principal) -> Result<Json<Stats>, Problem> {
    let counts = state.queue.counts(Some(&who.tenant)).await?;
    // Milliseconds of any real age are exact in f64.
    #[allow(clippy::cast_precision_loss)]
    let oldest_queued_s = counts.oldest_queued_ms as f64 / 1000.0;
    Ok(Json(Stats {
        jobs: JobCounts {
            queued: counts.queued,
            running: counts.running,
            succeeded: counts.succeeded,
            failed: counts.failed,
            cancelled: counts.cancelled,
        },
        oldest_queued_s,
        workers: if state.worker.is_some() { state.config.workers } else { 0 },
        workers_busy: state.worker.as_ref().map_or(0, |w| w.heartbeat.held()),
        upload_memory_free: state.uploads.available_permits() as u64 * UPLOAD_UNIT,
        disk_free: super::health::disk_free(&state),
    }))
}
