//! Claiming, beating and rescuing: how a job is held by exactly one worker.
//!
//! Order: the smallest `rank` first, where rank = creation time - priority x [`super::AGEING_MS`]. Because waiting and
//! priority are on one scale, the order of two queued jobs never changes and an index holds it: a drain costs the same
//! with 10^3 and 10^6 jobs queued. A tenant at its cap of running jobs is passed over whole, never scanned.

use super::{LEASE_MS, Queue};
use crate::db::{Db, MOST, Row, Scope, Tx, args};
use std::sync::LazyLock;
use uuid::Uuid;

/// A job that this worker holds until its lease runs out.
#[derive(Clone, Debug)]
pub struct Claim {
    /// Job id.
    pub id: String,
    /// Owner of the job.
    pub tenant: String,
    /// The number that every later write must carry.
    pub fence: i64,
    /// Which start this is, from 1.
    pub attempt: i64,
    /// Starts allowed.
    pub max_attempts: i64,
    /// plan.json text.
    pub plan: String,
    /// `sha256:` of the input's manifest.
    pub input_digest: String,
    /// Memory that the job is expected to need, MiB; 0 when unknown.
    pub memory_mb: i64,
    /// Trace of the request that made the job.
    pub trace_id: String,
    /// The earlier job whose scan or result it takes.
    pub parent: Option<String>,
}

impl Claim {
    /// The id as a UUID (the table holds nothing else).
    pub fn uuid(&self) -> Uuid {
        Uuid::parse_str(&self.id).unwrap_or_default()
    }

    fn of(row: &Row) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.get("id")?,
            tenant: row.get("tenant")?,
            fence: row.get("fence")?,
            attempt: row.get("attempt")?,
            max_attempts: row.get("max_attempts")?,
            plan: row.get("plan")?,
            input_digest: row.get("input_digest")?,
            memory_mb: row.get("memory_mb")?,
            trace_id: row.get("trace_id")?,
            parent: row.get("parent")?,
        })
    }
}

/// What a worker has room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Room {
    /// Any job: nothing runs here, so waiting for more memory would be in vain.
    Any,
    /// Jobs that need at most so many MiB.
    Memory(i64),
}

/// What a worker tells at a beat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Beat {
    /// Stages entered since the last beat, oldest first.
    pub stages: Vec<String>,
    /// Stage that runs.
    pub stage: Option<String>,
    /// 0 to 1.
    pub progress: f64,
    /// Seconds left.
    pub eta_s: Option<f64>,
    /// Whether progress changed since the last beat.
    pub moved: bool,
}

/// What a beat answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Go on.
    Run,
    /// The owner wants it ended.
    Cancel,
    /// Somebody else holds the job, or it was erased: stop and write nothing.
    Lost,
}

/// The tenant whose best job is the best of all tenants that may run one more, and the one after it: up to the best job of
/// that one the first one's jobs are the best of all.
const NEXT_TENANTS: &str = "SELECT tenant, max_running, best FROM (\
    SELECT t.id AS tenant, t.max_running AS max_running, (SELECT j.rank FROM job j WHERE j.tenant = t.id \
        AND j.state = 'queued' AND j.run_at <= now_ms() AND j.memory_mb <= $1 ORDER BY j.rank, j.id LIMIT 1) AS best \
    FROM tenant t WHERE t.max_running IS NULL OR t.max_running > \
        (SELECT COUNT(*) FROM job r WHERE r.tenant = t.id AND r.state = 'running')) AS ready \
    WHERE best IS NOT NULL ORDER BY best LIMIT 2";

/// What a claim of several jobs says before and after their number. The number is written out, so that the planner knows it:
/// of a number that it does not know it expects a tenth of all that wait, and reads the whole table for them.
const TAKE: [&str; 2] = [
    "WITH next (next_id) AS MATERIALIZED (SELECT id FROM job WHERE tenant = $3 AND state = 'queued' \
     AND run_at <= now_ms() AND memory_mb <= $4 AND rank <= $5 ORDER BY rank, id LIMIT ",
    " FOR UPDATE SKIP LOCKED) UPDATE job SET state = 'running', attempt = attempt + 1, fence = fence + 1, \
     lease_owner = $1, stage = NULL, progress = 0, eta_s = NULL, revision = revision + 1, started_at = now_ms(), \
     lease_until = now_ms() + $2 FROM next WHERE id = next_id RETURNING *",
];
static TAKES: LazyLock<[String; MOST]> =
    LazyLock::new(|| std::array::from_fn(|k| format!("{}{}{}", TAKE[0], k + 1, TAKE[1])));

/// What one slot asks for.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    owner: String,
    room: Room,
}

impl Queue {
    /// Claims the next job that may run and fits into `room`, or `None`.
    ///
    /// Slots of one worker that ask at the same time claim together. No job passes another one by that: those that are
    /// claimed together are the next ones.
    ///
    /// # Errors
    /// The database's.
    pub async fn claim(&self, owner: &str, room: Room) -> sqlx::Result<Option<Claim>> {
        let alike = |a: &Wanted, b: &Wanted| a.room == b.room && a.owner == b.owner;
        let db = self.db().clone();
        let write = move |wanted: Vec<Wanted>| {
            let db = db.clone();
            async move { claimed(&db, &wanted).await }
        };
        let claim = self.claims.call(Wanted { owner: owner.to_owned(), room }, alike, write).await?;
        if let Some(claim) = &claim {
            self.hint(claim.uuid());
        }
        Ok(claim)
    }

    /// Renews the lease, writes the progress and reads whether the job is to end: one statement, plus its events.
    ///
    /// # Errors
    /// The database's.
    pub async fn beat(&self, id: Uuid, fence: i64, beat: &Beat) -> sqlx::Result<Verdict> {
        let told = beat.clone();
        let verdict = self
            .db()
            .write(Scope::System, move |tx| Box::pin(async move { beaten(tx, id, fence, &told).await }))
            .await?;
        if beat.moved && verdict != Verdict::Lost {
            self.hint(id);
        }
        Ok(verdict)
    }

    /// Takes jobs back whose lease ran out, and all jobs of `dead` owners at once. Those with attempts left are
    /// queued again, the others fail with `job.crashed`, a cancelled one is cancelled. Returns their ids.
    ///
    /// # Errors
    /// The database's.
    pub async fn rescue(&self, dead: &[String]) -> sqlx::Result<Vec<Uuid>> {
        let expired = "SELECT id FROM job WHERE state = 'running' AND lease_until < now_ms() LIMIT 1";
        if dead.is_empty() && self.db().row(Scope::System, expired, Vec::new()).await?.is_none() {
            return Ok(Vec::new());
        }
        let dead = dead.to_vec();
        let ids = self.db().write(Scope::System, move |tx| Box::pin(async move { rescued(tx, &dead).await })).await?;
        ids.iter().for_each(|id| self.hint(*id));
        Ok(ids)
    }

    /// The whole memory that waiting and running jobs are expected to need, MiB: for scaling out.
    ///
    /// # Errors
    /// The database's.
    pub async fn wanted_memory(&self) -> sqlx::Result<i64> {
        let sql = "SELECT CAST(COALESCE(SUM(memory_mb), 0) AS BIGINT) AS mb FROM job WHERE state = 'queued'";
        self.db().row(Scope::System, sql, Vec::new()).await?.map_or(Ok(0), |row| row.get("mb"))
    }
}

/// Jobs for slots that ask for the same, in their order; `None` for the last ones where there are not enough.
async fn claimed(db: &Db, wanted: &[Wanted]) -> sqlx::Result<Vec<Option<Claim>>> {
    let mut claims: Vec<Option<Claim>> = Vec::with_capacity(wanted.len());
    if let Some(Wanted { owner, room }) = wanted.first() {
        let memory = match room {
            Room::Any => i64::MAX,
            Room::Memory(mb) => *mb,
        };
        while claims.len() < wanted.len() {
            // What an earlier round claimed must not be lost by a fault of a later one: its slots work on it.
            let some = match next(db, owner, memory, wanted.len() - claims.len()).await {
                Ok(some) => some,
                Err(error) if claims.is_empty() => return Err(error),
                Err(_) => break,
            };
            if some.is_empty() {
                break;
            }
            claims.extend(some.into_iter().map(Some));
        }
    }
    claims.resize(wanted.len(), None);
    Ok(claims)
}

/// The next jobs, at least one if there is one, at most so many.
async fn next(db: &Db, owner: &str, memory: i64, most: usize) -> sqlx::Result<Vec<Claim>> {
    // An idle worker only reads: it takes no write lock and costs no commit.
    let tenants = db.rows(Scope::System, NEXT_TENANTS, args![memory]).await?;
    if tenants.is_empty() {
        return Ok(Vec::new());
    }
    let taking = Taking { owner: owner.to_owned(), memory, most };
    let work = db.write(Scope::System, move |tx| Box::pin(async move { taking.taken(tx, tenants).await }));
    work.await?.iter().map(Claim::of).collect()
}

/// How many jobs, and for whom.
struct Taking {
    owner: String,
    memory: i64,
    most: usize,
}

impl Taking {
    /// Jobs of one tenant after the other in one transaction, `tenants` being what [`NEXT_TENANTS`] said before it.
    async fn taken(&self, tx: &mut Tx<'_>, mut tenants: Vec<Row>) -> sqlx::Result<Vec<Row>> {
        let mut rows = Vec::new();
        while let Some(first) = tenants.first() {
            let (tenant, cap): (String, Option<i64>) = (first.get("tenant")?, first.get("max_running")?);
            if cap.is_some() && !rows.is_empty() {
                // The row of one capped tenant at most is locked, so that two workers never wait for each other's.
                break;
            }
            let left = self.most - rows.len();
            let places = match cap {
                Some(cap) => left.min(places(tx, &tenant, cap).await?),
                None => left,
            };
            let until = tenants.get(1).map_or(Ok(i64::MAX), |second| second.get("best"))?;
            let mut some = self.of_tenant(tx, &tenant, until, places).await?;
            if some.is_empty() && places > 0 && until < i64::MAX {
                // Another worker holds those up to the next tenant's: one of the later ones is better than none.
                some = self.of_tenant(tx, &tenant, i64::MAX, 1).await?;
            }
            let raced = some.is_empty();
            rows.extend(some);
            if raced || cap.is_some() || rows.len() >= self.most {
                break;
            }
            tenants = tx.rows(NEXT_TENANTS, args![self.memory]).await?;
        }
        Ok(rows)
    }

    /// At most so many jobs of a tenant with ranks up to `until`.
    async fn of_tenant(&self, tx: &mut Tx<'_>, tenant: &str, until: i64, most: usize) -> sqlx::Result<Vec<Row>> {
        let Some(sql) = most.checked_sub(1).and_then(|k| TAKES.get(k)) else { return Ok(Vec::new()) };
        tx.rows(sql, args![&self.owner, LEASE_MS, tenant, self.memory, until]).await
    }
}

/// How many more jobs of a tenant may run now.
async fn places(tx: &mut Tx<'_>, tenant: &str, cap: i64) -> sqlx::Result<usize> {
    // Two workers may both have seen the last free place: the tenant's row lets one of them count at a time.
    tx.row("SELECT id FROM tenant WHERE id = $1 FOR NO KEY UPDATE", args![tenant]).await?;
    let count = "SELECT COUNT(*) AS n FROM job WHERE tenant = $1 AND state = 'running'";
    let running: i64 = tx.row(count, args![tenant]).await?.map_or(Ok(0), |row| row.get("n"))?;
    Ok(usize::try_from(cap - running).unwrap_or(0))
}

async fn beaten(tx: &mut Tx<'_>, id: Uuid, fence: i64, beat: &Beat) -> sqlx::Result<Verdict> {
    let renew = "UPDATE job SET stage = $3, progress = $4, eta_s = $5, revision = revision + $6, \
                 lease_until = now_ms() + $7 WHERE id = $1 AND fence = $2 AND state = 'running' \
                 RETURNING cancel_requested";
    let values = args![id, fence, &beat.stage, beat.progress, beat.eta_s, i64::from(beat.moved), LEASE_MS];
    let Some(row) = tx.row(renew, values).await? else { return Ok(Verdict::Lost) };
    for stage in &beat.stages {
        let told = "INSERT INTO event (job, kind, state, stage, progress, eta_s, at) \
                    VALUES ($1, 'stage', 'running', $2, $3, $4, now_ms())";
        tx.run(told, args![id, stage, beat.progress, beat.eta_s]).await?;
    }
    if beat.moved && beat.stages.is_empty() {
        let told = "INSERT INTO event (job, kind, state, stage, progress, eta_s, at) \
                    VALUES ($1, 'progress', 'running', $2, $3, $4, now_ms())";
        tx.run(told, args![id, &beat.stage, beat.progress, beat.eta_s]).await?;
    }
    Ok(if row.flag("cancel_requested")? { Verdict::Cancel } else { Verdict::Run })
}

async fn rescued(tx: &mut Tx<'_>, dead: &[String]) -> sqlx::Result<Vec<Uuid>> {
    let expired = "SELECT id FROM job WHERE state = 'running' AND lease_until < now_ms() FOR UPDATE SKIP LOCKED";
    let theirs = "SELECT id FROM job WHERE state = 'running' AND lease_owner = $1 FOR UPDATE SKIP LOCKED";
    let mut lost = tx.rows(expired, Vec::new()).await?;
    for owner in dead {
        lost.extend(tx.rows(theirs, args![owner]).await?);
    }
    let back = "UPDATE job SET state = CASE WHEN cancel_requested = 1 THEN 'cancelled' \
        WHEN attempt >= max_attempts THEN 'failed' ELSE 'queued' END, \
        error = CASE WHEN cancel_requested = 0 AND attempt >= max_attempts THEN $2 END, \
        finished_at = CASE WHEN cancel_requested = 1 OR attempt >= max_attempts THEN now_ms() END, \
        fence = fence + 1, lease_owner = NULL, lease_until = NULL, revision = revision + 1 \
        WHERE id = $1 AND state = 'running'";
    let problem = super::finish::crashed("its worker ended or lost its lease").body();
    let mut ids = Vec::new();
    for row in &lost {
        let id: String = row.get("id")?;
        if tx.run(back, args![&id, &problem]).await? > 0 {
            ids.extend(Uuid::parse_str(&id).ok());
        }
    }
    Ok(ids)
}
