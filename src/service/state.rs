//! What every request handler shares.

use crate::audit::{self, Entry};
use crate::auth::{Callers, Principal, Provider};
use crate::config::Config;
use crate::db::{Scope, args};
use crate::error::Problem;
use crate::queue::Queue;
use crate::store::Store;
use crate::traces::Traces;
use crate::worker::Worker;
use metrics_exporter_prometheus::PrometheusHandle;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// The unit of the upload budget, bytes.
pub const UPLOAD_UNIT: u64 = 1 << 20;

/// How long the answer to a cancel waits for the store.
const PATIENCE: Duration = Duration::from_secs(2);

/// Shared state; cheap to clone.
#[derive(Clone, Debug)]
pub struct State {
    /// Settings.
    pub config: Arc<Config>,
    /// The job table.
    pub queue: Queue,
    /// The artefacts.
    pub store: Store,
    /// The workers of this process, if any.
    pub worker: Option<Arc<Worker>>,
    /// Callers whose keys are looked up at the same time.
    pub(crate) callers: Arc<Callers>,
    /// Who checks bearer tokens that are no API keys.
    pub provider: Option<Arc<Provider>>,
    /// Memory for uploads, in units of [`UPLOAD_UNIT`].
    pub uploads: Arc<Semaphore>,
    /// Ends streams and long polls.
    pub shutdown: CancellationToken,
    /// Renders /metrics.
    pub metrics: PrometheusHandle,
    /// Where traces go.
    pub traces: Traces,
    /// The address really listened on.
    pub address: SocketAddr,
}

impl State {
    /// Writes into the audit that `who` sent a job, and into the job who that was; gives back the name.
    ///
    /// # Errors
    /// The database's.
    pub async fn audit_sent(&self, who: &Principal, trace: &str, job: &str) -> Result<Option<String>, Problem> {
        let (line, id) = (entry(who, trace, "job.create", job), job.to_owned());
        let name = "UPDATE job SET sent_by = COALESCE((SELECT label FROM api_key WHERE id = $2), $2) WHERE id = $1 \
                    RETURNING sent_by";
        let named = self.queue.db().write(Scope::System, move |tx| {
            Box::pin(async move {
                let row = tx.row(name, args![&id, &line.actor]).await?;
                audit::append(tx, &line).await?;
                row.map(|row| row.get("sent_by")).transpose()
            })
        });
        Ok(named.await?)
    }

    /// Writes who did what into the audit; without the line, the caller must not go on.
    ///
    /// # Errors
    /// The database's.
    pub async fn audit(&self, who: &Principal, trace: &str, action: &str, object: &str) -> Result<(), Problem> {
        Ok(audit::write(self.queue.db(), entry(who, trace, action, object)).await?)
    }

    /// Erases what is stored of a cancelled job; whether the store did. The cancel is committed and must be answered: what a store
    /// leaves that does not answer is the sweep's.
    pub(crate) async fn forget(&self, id: Uuid) -> bool {
        match tokio::time::timeout(PATIENCE, self.store.erase_job(id)).await {
            Ok(Ok(())) => return true,
            Ok(Err(error)) => tracing::warn!(job = %id, %error, "a cancelled job's scan waits for the sweep"),
            Err(_) => {
                tracing::warn!(job = %id, "a cancelled job's scan waits for the sweep: the store does not answer")
            }
        }
        false
    }
}

fn entry(who: &Principal, trace: &str, action: &str, object: &str) -> Entry {
    Entry {
        tenant: who.tenant.clone(),
        actor: who.actor.clone(),
        action: action.to_owned(),
        object: object.to_owned(),
        outcome: "ok".to_owned(),
        trace_id: trace.to_owned(),
    }
}
