//! The queue's promises, each test on SQLite and on PostgreSQL.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[macro_use]
mod support;

use service::auth::tenants;
use service::db::{Db, Scope};
use service::queue::{Beat, Closing, Finished, JobState, NewJob, Page, Queue, Room, Several, Submitted, Verdict};
use service::{Config, Problem};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};
use support::queues::{Bench, add, claim, new, sql, state, success};
use uuid::Uuid;

on_both! {
    a_job_goes_from_queue_to_success
    every_job_is_claimed_by_exactly_one
    a_lost_lease_writes_nothing
    an_expired_lease_is_taken_back
    a_poison_job_is_started_as_often_as_allowed
    priority_and_waiting_share_one_scale
    a_tenant_stays_under_its_cap
    a_job_waits_for_memory
    a_key_makes_one_job
    a_key_makes_several_jobs_together
    finished_jobs_are_found_by_time_and_kind
    a_failed_unit_leaves_the_others_alone
    cancel_by_filter
    retry_and_hand_back
    retention_ends
    webhooks_get_a_message_in_the_same_commit
    a_tenant_sees_its_own_only
    a_tenant_s_name_is_no_statement
    pages_follow_the_key
    workers_are_on_the_roll
    a_newer_schema_is_refused
    a_backup_holds_every_job
    hints_travel_or_are_not_needed
    the_order_of_claims_does_not_slow_with_the_backlog
}

async fn a_job_goes_from_queue_to_success(b: Bench) {
    let q = &b.queue;
    let id = add(q, |_| {}).await;
    let held = claim(q).await.unwrap();
    assert_eq!((held.uuid(), held.attempt, held.fence), (id, 1, 1));
    let beat = Beat { stages: vec!["fit".into()], stage: Some("fit".into()), progress: 0.5, eta_s: None, moved: true };
    assert_eq!(q.beat(id, held.fence, &beat).await.unwrap(), Verdict::Run);
    assert_eq!(q.close(&held, &success()).await.unwrap(), Some(JobState::Succeeded));
    let row = q.job("default", id).await.unwrap().unwrap();
    assert_eq!((row.state, row.progress), (JobState::Succeeded, 1.0));
    assert!(row.created_at <= row.started_at.unwrap() && row.started_at <= row.finished_at);
    let names: Vec<_> = q.artefacts(id).await.unwrap().into_iter().map(|a| a.name).collect();
    assert_eq!(names, ["a.csv", "result.json"]);
    let events: Vec<_> = q.events(id, 0, 99).await.unwrap().into_iter().map(|e| (e.kind, e.state)).collect();
    let states = [JobState::Queued, JobState::Running, JobState::Running, JobState::Succeeded];
    assert_eq!(events.iter().map(|e| e.1).collect::<Vec<_>>(), states);
    assert_eq!(events[2].0, "stage");
    assert_eq!(q.counts(None).await.unwrap().succeeded, 1);
    assert!(claim(q).await.is_none());
}

async fn every_job_is_claimed_by_exactly_one(b: Bench) {
    let q = &b.queue;
    let mut ids = BTreeSet::new();
    for _ in 0..120 {
        ids.insert(add(q, |_| {}).await);
    }
    let workers = (0..16).map(|k| {
        let q = q.clone();
        tokio::spawn(async move {
            let mut mine = Vec::new();
            while let Some(held) = q.claim(&format!("w{k}"), Room::Any).await.unwrap() {
                assert_eq!((held.attempt, held.fence), (1, 1));
                assert_eq!(q.close(&held, &success()).await.unwrap(), Some(JobState::Succeeded));
                mine.push(held.uuid());
            }
            mine
        })
    });
    let mut claimed = Vec::new();
    for worker in workers.collect::<Vec<_>>() {
        claimed.extend(worker.await.unwrap());
    }
    // A claimer that met only rows locked by others goes away: what it left is still there.
    while let Some(held) = claim(q).await {
        claimed.push(held.uuid());
    }
    assert_eq!(claimed.len(), ids.len());
    assert_eq!(claimed.into_iter().collect::<BTreeSet<_>>(), ids);
}

async fn a_lost_lease_writes_nothing(b: Bench) {
    let q = &b.queue;
    let id = add(q, |_| {}).await;
    let first = claim(q).await.unwrap();
    sql(q, "UPDATE job SET lease_until = 0").await;
    assert_eq!(q.rescue(&[]).await.unwrap(), [id]);
    let second = claim(q).await.unwrap();
    assert!(second.fence > first.fence);
    assert_eq!(q.beat(id, first.fence, &Beat::default()).await.unwrap(), Verdict::Lost);
    assert_eq!(q.close(&first, &success()).await.unwrap(), None);
    assert!(q.artefacts(id).await.unwrap().is_empty());
    assert_eq!(q.close(&second, &success()).await.unwrap(), Some(JobState::Succeeded));
    // Asked again, as after a commit whose answer was lost: the same answer, and nothing is written twice.
    assert_eq!(q.close(&second, &success()).await.unwrap(), Some(JobState::Succeeded));
    assert_eq!(q.close(&second, &Closing::Cancelled).await.unwrap(), Some(JobState::Succeeded));
    assert_eq!(q.close(&first, &success()).await.unwrap(), None);
    assert_eq!(q.artefacts(id).await.unwrap().len(), 2);
    let ends = q.events(id, 0, 99).await.unwrap().into_iter().filter(|e| e.state == JobState::Succeeded).count();
    assert_eq!(ends, 1);
    let erased = add(q, |_| {}).await;
    let held = claim(q).await.unwrap();
    assert!(q.erase("default", erased).await.unwrap());
    assert_eq!(q.close(&held, &success()).await.unwrap(), None);
}

async fn an_expired_lease_is_taken_back(b: Bench) {
    let q = &b.queue;
    let (kept, cancelled) = (add(q, |_| {}).await, add(q, |_| {}).await);
    let held = claim(q).await.unwrap();
    claim(q).await.unwrap();
    q.cancel("default", cancelled).await.unwrap();
    assert!(q.rescue(&[]).await.unwrap().is_empty(), "a living lease is left alone");
    sql(q, "UPDATE job SET lease_until = 0").await;
    assert_eq!(q.beat(kept, held.fence, &Beat::default()).await.unwrap(), Verdict::Run, "late, but nobody took it");
    assert_eq!(q.rescue(&[]).await.unwrap(), [cancelled]);
    assert_eq!(state(q, cancelled).await, JobState::Cancelled);
    assert_eq!(q.rescue(&["w".to_owned()]).await.unwrap(), [kept], "a dead owner's job goes back at once");
    assert_eq!(state(q, kept).await, JobState::Queued);
}

async fn a_poison_job_is_started_as_often_as_allowed(b: Bench) {
    let q = &b.queue;
    let id = add(q, |_| {}).await;
    for attempt in 1..=3 {
        let held = claim(q).await.unwrap();
        assert_eq!(held.attempt, attempt);
        assert_eq!(q.rescue(&["w".to_owned()]).await.unwrap(), [id]);
    }
    assert!(claim(q).await.is_none());
    let row = q.job("default", id).await.unwrap().unwrap();
    assert_eq!(row.state, JobState::Failed);
    assert!(row.error.unwrap().contains("job.crashed"));
    // A crash that the worker saw counts the same, with a pause between.
    let id = add(q, |_| {}).await;
    for _ in 1..=3 {
        let held = claim(q).await.unwrap();
        q.close(&held, &Closing::Crashed("signal 9".into())).await.unwrap();
        assert!(claim(q).await.is_none(), "the pause holds");
        sql(q, "UPDATE job SET run_at = 0").await;
    }
    assert_eq!(state(q, id).await, JobState::Failed);
}

async fn priority_and_waiting_share_one_scale(b: Bench) {
    let q = &b.queue;
    let low = add(q, |j| j.priority = -1).await;
    let usual = add(q, |_| {}).await;
    let high = add(q, |j| j.priority = 10).await;
    let later = add(q, |j| j.priority = 10).await;
    // As if it had waited for eleven minutes: one minute more than ten steps of priority are worth.
    let old = add(q, |_| {}).await;
    let wait = "UPDATE job SET rank = rank - 660000 WHERE id = $1";
    q.db().run(Scope::System, wait, vec![service::db::Value::from(old)]).await.unwrap();
    let mut order = Vec::new();
    while let Some(held) = claim(q).await {
        order.push(held.uuid());
    }
    assert_eq!(order, [old, high, later, usual, low]);
}

async fn a_tenant_stays_under_its_cap(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "ward", Some(2), None).await.unwrap();
    let ward = tenants::list(q.db()).await.unwrap().pop().unwrap();
    assert_eq!((ward.id.as_str(), ward.max_running, ward.keep_ms), ("ward", Some(2), None));
    for _ in 0..6 {
        add(q, |j| {
            j.tenant = "ward".into();
            j.priority = 50;
        })
        .await;
    }
    let other = add(q, |_| {}).await;
    let tries = (0..8).map(|_| {
        let q = q.clone();
        tokio::spawn(async move { q.claim("w", Room::Any).await.unwrap() })
    });
    let mut held = Vec::new();
    for one in tries.collect::<Vec<_>>() {
        held.extend(one.await.unwrap());
    }
    while let Some(more) = claim(q).await {
        held.push(more);
    }
    assert_eq!(held.iter().filter(|h| h.tenant == "ward").count(), 2);
    assert!(held.iter().any(|h| h.uuid() == other), "a full tenant does not hold others back");
    let first = held.iter().find(|h| h.tenant == "ward").unwrap();
    q.close(first, &success()).await.unwrap();
    assert_eq!(claim(q).await.unwrap().tenant, "ward");
}

async fn a_job_waits_for_memory(b: Bench) {
    let q = &b.queue;
    let large = add(q, |j| j.memory_mb = 8000).await;
    let small = add(q, |j| j.memory_mb = 500).await;
    let first = q.claim("w", Room::Memory(4000)).await.unwrap().unwrap();
    assert_eq!((first.uuid(), first.memory_mb), (small, 500));
    assert!(q.claim("w", Room::Memory(3500)).await.unwrap().is_none());
    assert_eq!(q.wanted_memory().await.unwrap(), 8000);
    assert_eq!(q.claim("idle", Room::Any).await.unwrap().unwrap().uuid(), large);
}

async fn a_key_makes_one_job(b: Bench) {
    let q = &b.queue;
    let job = NewJob { idempotency_key: Some("k".into()), ..new("default") };
    let tries = (0..12).map(|_| {
        let (q, job) = (q.clone(), NewJob { id: Uuid::now_v7(), ..job.clone() });
        tokio::spawn(async move { q.submit(&job).await.unwrap() })
    });
    let (mut fresh, mut ids) = (0, BTreeSet::new());
    for one in tries.collect::<Vec<_>>() {
        match one.await.unwrap() {
            Submitted::New(row) => {
                fresh += 1;
                ids.insert(row.id);
            }
            Submitted::Replayed(row) => {
                ids.insert(row.id);
            }
            Submitted::Mismatch(row) => panic!("{row:?}"),
        }
    }
    assert_eq!((fresh, ids.len()), (1, 1));
    let other = NewJob { id: Uuid::now_v7(), plan: "{\"a\":1}".into(), ..job.clone() };
    assert!(matches!(q.submit(&other).await.unwrap(), Submitted::Mismatch(_)));
    tenants::set(q.db(), "ward", None, None).await.unwrap();
    let elsewhere = NewJob { id: Uuid::now_v7(), tenant: "ward".into(), ..job };
    assert!(matches!(q.submit(&elsewhere).await.unwrap(), Submitted::New(_)), "a key belongs to its tenant");
}

async fn a_key_makes_several_jobs_together(b: Bench) {
    let q = &b.queue;
    let plan = |text: &str| NewJob { plan: text.to_owned(), idempotency_key: Some("k".into()), ..new("default") };
    let three = || [plan("{}"), plan("{\"a\":1}"), plan("{\"a\":2}")];
    let tries = (0..6)
        .map(|_| (q.clone(), three()))
        .map(|(q, jobs)| tokio::spawn(async move { q.submit_together(&jobs).await.unwrap() }));
    let (mut fresh, mut seen) = (0, BTreeSet::new());
    for one in tries.collect::<Vec<_>>() {
        let (Several::New(rows) | Several::Replayed(rows)) = one.await.unwrap() else {
            panic!("it is the same request")
        };
        fresh += usize::from(seen.insert(rows.iter().map(|row| row.id.clone()).collect::<Vec<_>>()));
        assert_eq!(rows.iter().map(|row| row.plan.as_str()).collect::<Vec<_>>(), ["{}", "{\"a\":1}", "{\"a\":2}"]);
    }
    assert_eq!((fresh, q.jobs("default", &Page { limit: 9, ..Page::default() }).await.unwrap().len()), (1, 3));
    for odd in [&three()[..2], &[plan("{}"), plan("{}"), plan("{}")], &[&three()[..], &[plan("{\"a\":3}")]].concat()] {
        assert!(matches!(q.submit_together(odd).await.unwrap(), Several::Mismatch(_)));
    }
    assert!(matches!(q.submit(&plan("{}")).await.unwrap(), Submitted::Mismatch(_)), "one job is another request");
    // One that cannot be written takes the others with it.
    let taken = new("default");
    assert!(matches!(q.submit(&taken).await.unwrap(), Submitted::New(_)));
    assert!(q.submit_together(&[new("default"), taken, new("default")]).await.is_err());
    assert_eq!(q.jobs("default", &Page { limit: 9, ..Page::default() }).await.unwrap().len(), 4);
}

async fn finished_jobs_are_found_by_time_and_kind(b: Bench) {
    let q = &b.queue;
    let mut done = Vec::new();
    for plan in ["{}", "{\"variant\": {\"changes\": []}}", "{}"] {
        let id = add(q, |job| job.plan = plan.to_owned()).await;
        let held = claim(q).await.unwrap();
        q.close(&held, &success()).await.unwrap();
        done.insert(0, id.to_string());
    }
    let waiting = add(q, |_| {}).await;
    sql(q, "UPDATE job SET created_at = 1000 * (SELECT COUNT(*) FROM job AS older WHERE older.id <= job.id)").await;
    let all = || Finished { after: i64::MIN, before: i64::MAX, kind: "", limit: 9 };
    let found = async |wanted: Finished| -> Vec<String> {
        q.finished("default", &wanted).await.unwrap().into_iter().map(|row| row.job).collect()
    };
    assert_eq!(found(all()).await, done);
    assert_eq!(found(Finished { limit: 2, ..all() }).await, done[..2]);
    assert_eq!(found(Finished { kind: "variant", ..all() }).await, done[1..2]);
    assert_eq!(found(Finished { after: 1000, before: 3000, ..all() }).await, done[1..]);
    assert!(q.finished("ward", &all()).await.unwrap().is_empty());
    assert!(q.finished_job("default", waiting).await.unwrap().is_none(), "it has no result");
    let first = Uuid::parse_str(&done[0]).unwrap();
    assert_eq!(q.finished_job("default", first).await.unwrap().unwrap().artefact.name, "result.json");
    assert!(q.finished_job("ward", first).await.unwrap().is_none());
}

async fn a_failed_unit_leaves_the_others_alone(b: Bench) {
    let q = &b.queue;
    let tries = (0..20).map(|k| {
        let q = q.clone();
        tokio::spawn(async move {
            // Every second one names a tenant that does not exist.
            let job = new(if k % 2 == 0 { "default" } else { "nobody" });
            (q.submit(&job).await.is_ok(), job.id)
        })
    });
    for (k, one) in tries.collect::<Vec<_>>().into_iter().enumerate() {
        let (accepted, id) = one.await.unwrap();
        assert_eq!(accepted, k % 2 == 0);
        assert_eq!(q.is_known(id).await.unwrap().is_some(), accepted);
    }
}

async fn cancel_by_filter(b: Bench) {
    let q = &b.queue;
    let running = add(q, |j| j.priority = 5).await;
    claim(q).await.unwrap();
    let mut queued = Vec::new();
    for _ in 0..3 {
        queued.push(add(q, |_| {}).await);
    }
    tenants::set(q.db(), "ward", None, None).await.unwrap();
    let foreign = add(q, |j| j.tenant = "ward".into()).await;
    assert!(q.cancel_all("default", None, Some(0)).await.unwrap().is_empty(), "none is so old");
    assert_eq!(q.cancel_all("default", Some(JobState::Queued), None).await.unwrap(), queued);
    assert_eq!(q.cancel_all("default", None, None).await.unwrap(), [running]);
    assert!(q.job("default", running).await.unwrap().unwrap().cancel_requested);
    assert_eq!(state(q, queued[0]).await, JobState::Cancelled);
    assert_eq!(q.is_known(foreign).await.unwrap(), Some(JobState::Queued));
}

async fn retry_and_hand_back(b: Bench) {
    let q = &b.queue;
    let id = add(q, |_| {}).await;
    let held = claim(q).await.unwrap();
    assert_eq!(q.close(&held, &Closing::HandedBack).await.unwrap(), Some(JobState::Queued));
    let held = claim(q).await.unwrap();
    assert_eq!(held.attempt, 1, "a start that was handed back is not counted");
    assert!(q.retry("default", id).await.unwrap().is_none(), "a running job cannot be retried");
    let fault = Problem::new(axum::http::StatusCode::UNPROCESSABLE_ENTITY, "stack.black", "black");
    assert_eq!(q.close(&held, &Closing::Failed(fault)).await.unwrap(), Some(JobState::Failed));
    assert!(q.retry("ward", id).await.unwrap().is_none(), "nor by another tenant");
    let row = q.retry("default", id).await.unwrap().unwrap();
    assert_eq!((row.state, row.attempt, row.error), (JobState::Queued, 0, None));
}

async fn retention_ends(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "default", None, Some(60_000)).await.unwrap();
    let id = add(q, |_| {}).await;
    let held = claim(q).await.unwrap();
    q.close(&held, &success()).await.unwrap();
    let row = q.job("default", id).await.unwrap().unwrap();
    assert_eq!(row.expires_at, row.finished_at.map(|t| t + 60_000));
    assert!(q.expired(9).await.unwrap().is_empty());
    sql(q, "UPDATE job SET expires_at = 1").await;
    assert_eq!(q.expired(9).await.unwrap(), [("default".to_owned(), id)]);
}

async fn webhooks_get_a_message_in_the_same_commit(b: Bench) {
    let q = &b.queue;
    sql(q, "INSERT INTO webhook (id, tenant, url, secret, created_at) VALUES ('h', 'default', 'https://x', 's', 0)")
        .await;
    let id = add(q, |_| {}).await;
    let held = claim(q).await.unwrap();
    q.close(&held, &success()).await.unwrap();
    let rows = q.db().rows(Scope::System, "SELECT body FROM outbox", Vec::new()).await.unwrap();
    assert_eq!(rows.len(), 1);
    let body: serde_json::Value = serde_json::from_str(&rows[0].get::<String>("body").unwrap()).unwrap();
    assert_eq!((&body["id"], &body["state"]), (&id.to_string().into(), &"succeeded".into()));
}

async fn a_tenant_sees_its_own_only(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "ward", None, None).await.unwrap();
    let id = add(q, |_| {}).await;
    assert!(q.job("ward", id).await.unwrap().is_none());
    assert!(q.jobs("ward", &Page { limit: 9, ..Page::default() }).await.unwrap().is_empty());
    assert!(q.cancel("ward", id).await.unwrap().is_none());
    assert!(!q.erase("ward", id).await.unwrap());
    assert_eq!(q.counts(Some("ward")).await.unwrap().queued, 0);
    assert_eq!(state(q, id).await, JobState::Queued);
    if b.config.database_url.is_some() {
        // A statement that forgets the tenant is stopped by the database itself.
        let all = "SELECT id FROM job";
        assert_eq!(q.db().rows(Scope::Tenant("ward"), all, Vec::new()).await.unwrap().len(), 0);
        assert_eq!(q.db().rows(Scope::Tenant("default"), all, Vec::new()).await.unwrap().len(), 1);
        assert_eq!(q.db().rows(Scope::Tenant("ward"), "SELECT id FROM event", Vec::new()).await.unwrap().len(), 0);
        assert_eq!(q.db().run(Scope::Tenant("ward"), "DELETE FROM job", Vec::new()).await.unwrap(), 0);
    }
}

async fn a_tenant_s_name_is_no_statement(b: Bench) {
    let q = &b.queue;
    add(q, |_| {}).await;
    for name in ["'; SET vasculum.tenant = '*", "\\'; SET vasculum.tenant = '*'; --", "Saint John's", "$1 \\ {}"] {
        tenants::set(q.db(), name, None, None).await.unwrap();
        let id = add(q, |j| j.tenant = name.into()).await;
        assert_eq!(q.job(name, id).await.unwrap().unwrap().tenant, name);
        assert_eq!(q.counts(Some(name)).await.unwrap().queued, 1);
        if b.config.database_url.is_some() {
            let all = q.db().rows(Scope::Tenant(name), "SELECT id FROM job", Vec::new()).await.unwrap();
            assert_eq!(all.len(), 1, "{name}");
        }
    }
}

async fn pages_follow_the_key(b: Bench) {
    let q = &b.queue;
    let mut ids = Vec::new();
    for _ in 0..7 {
        ids.push(add(q, |_| {}).await);
    }
    ids.reverse();
    let (mut seen, mut before) = (Vec::new(), None);
    loop {
        let page =
            q.jobs("default", &Page { before, limit: 3, state: Some(JobState::Queued), parent: None }).await.unwrap();
        if page.is_empty() {
            break;
        }
        seen.extend(page.iter().map(|row| Uuid::parse_str(&row.id).unwrap()));
        before = seen.last().copied();
    }
    assert_eq!(seen, ids);
}

async fn workers_are_on_the_roll(b: Bench) {
    let q = &b.queue;
    let mut worker = service::queue::WorkerRow {
        id: "w".into(),
        host: "h".into(),
        version: "1".into(),
        slots: 2,
        busy: 0,
        memory_mb: 100,
        isolation: None,
        started_at: 0,
        seen_at: 0,
    };
    q.enrol(&worker).await.unwrap();
    (worker.busy, worker.isolation) = (1, Some("filter".into()));
    q.enrol(&worker).await.unwrap();
    let roll = q.workers().await.unwrap();
    assert_eq!((roll.len(), roll[0].busy, roll[0].isolation.as_deref()), (1, 1, Some("filter")));
    assert!(roll[0].seen_at > 0);
    q.strike_off("w").await.unwrap();
    assert!(q.workers().await.unwrap().is_empty());
}

async fn a_newer_schema_is_refused(b: Bench) {
    Db::open(&b.config).await.unwrap().close().await;
    let later = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time) \
                 SELECT 9999, 'later', success, checksum, 0 FROM _sqlx_migrations WHERE version = 1";
    sql(&b.queue, later).await;
    let refused = format!("{:#}", Db::open(&b.config).await.unwrap_err());
    assert!(refused.contains("9999") && refused.contains("older than the data"), "{refused}");
}

async fn a_backup_holds_every_job(b: Bench) {
    let id = add(&b.queue, |_| {}).await;
    let file = b.folder.path().join("copy.sqlite");
    let copied = b.queue.db().backup(&file).await;
    if b.config.database_url.is_some() {
        assert!(copied.unwrap_err().to_string().contains("pg_dump"));
        return;
    }
    copied.unwrap();
    assert!(b.queue.db().backup(&file).await.is_err(), "a backup is never written over");
    let config = Config { database_url: Some(format!("sqlite:{}", file.display())), ..b.config.clone() };
    let restored = Queue::new(Db::open(&config).await.unwrap());
    assert_eq!(claim(&restored).await.unwrap().uuid(), id);
}

async fn hints_travel_or_are_not_needed(b: Bench) {
    let other = Queue::new(Db::open(&b.config).await.unwrap());
    let stop = tokio_util::sync::CancellationToken::new();
    let carriers = [b.queue.clone(), other.clone()].map(|q| tokio::spawn(q.carry_hints(stop.clone())));
    let mut heard = other.changes();
    let begun = Instant::now();
    // A listener that is not there yet misses the first ones.
    while b.config.database_url.is_some() {
        let id = add(&b.queue, |_| {}).await;
        if let Ok(got) = tokio::time::timeout(Duration::from_millis(300), heard.recv()).await {
            assert!(b.queue.is_known(got.unwrap()).await.unwrap().is_some());
            break;
        }
        assert!(begun.elapsed() < Duration::from_secs(10), "no hint of {id} came");
    }
    stop.cancel();
    for carrier in carriers {
        carrier.await.unwrap();
    }
}

async fn the_order_of_claims_does_not_slow_with_the_backlog(b: Bench) {
    let q = &b.queue;
    macro_rules! fill {
        ($from:literal, $to:literal) => {
            concat!(
                "INSERT INTO job (id, tenant, kind, state, plan, input_digest, input_files, input_bytes, trace_id, rank, \
                 run_at, created_at) WITH RECURSIVE n(k) AS (SELECT ",
                $from,
                " UNION ALL SELECT k + 1 FROM n WHERE k < ",
                $to,
                ") SELECT 'x' || CAST(k AS TEXT), 'default', 'r', 'queued', '{}', 'd', 1, 1, 't', k, 0, 0 FROM n"
            )
        };
    }
    tenants::set(q.db(), "ward", Some(0), None).await.unwrap();
    let mut quickest = Vec::new();
    for (from, fill) in [(1, fill!(1, 30)), (31, fill!(31, 100_000))] {
        sql(q, fill).await;
        if b.config.database_url.is_some() {
            sql(q, "ANALYZE job").await;
        }
        let mut took = Vec::new();
        for k in from..from + 30 {
            let begun = Instant::now();
            assert_eq!(claim(q).await.unwrap().id, format!("x{k}"));
            took.push(begun.elapsed());
        }
        quickest.extend(took.into_iter().min());
    }
    // Through the index it is the commit that counts; a scan or a sort of 100,000 rows takes 70 ms and more, every time. The
    // quickest of 30 tells, on a busy machine too.
    assert!(quickest[1] < 3 * quickest[0] + Duration::from_millis(12), "{quickest:?} per claim");
}
