//! Calls that come at the same time share a statement: each must get what it would have got alone. On both databases.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[macro_use]
mod support;

use futures::future::join_all;
use service::auth::tenants;
use service::db::{Scope, Value};
use service::queue::{ArtefactRow, Closing, JobState, NewJob, Published, Queue, Room, Submitted};
use std::collections::{BTreeMap, BTreeSet};
use support::queues::{Bench, add, claim, new, sql, state, success};
use uuid::Uuid;

on_both! {
    slots_that_ask_together_get_the_next_jobs
    ends_that_come_together_are_told_apart
    jobs_that_come_together_are_told_apart
    an_end_in_a_group_has_its_consequences
    an_erased_job_takes_its_events_along
}

async fn count(queue: &Queue, sql: &'static str, values: Vec<Value>) -> i64 {
    queue.db().row(Scope::System, sql, values).await.unwrap().unwrap().get("n").unwrap()
}

async fn slots_that_ask_together_get_the_next_jobs(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "capped", Some(3), None).await.unwrap();
    tenants::set(q.db(), "ward", None, None).await.unwrap();
    // In turns of the three tenants, in another order than that of their ids.
    let mut ranks = BTreeMap::new();
    for k in 0..36_i64 {
        let tenant = ["default", "capped", "ward"][k.unsigned_abs() as usize % 3];
        let (id, rank) = (add(q, |job| job.tenant = tenant.to_owned()).await, (k * 7) % 36);
        let values = vec![Value::from(id), Value::from(rank)];
        q.db().run(Scope::System, "UPDATE job SET rank = $2 WHERE id = $1", values).await.unwrap();
        ranks.insert(rank, (id, tenant));
    }
    // The next twenty, but for those of the full tenant behind its third.
    let mut capped = 0;
    let may = |(id, tenant): &(Uuid, &str)| {
        capped += i32::from(*tenant == "capped");
        (*tenant != "capped" || capped <= 3).then_some(*id)
    };
    let next: Vec<Uuid> = ranks.values().filter_map(may).collect();
    let claims = join_all((0..20).map(|_| q.claim("w", Room::Any))).await;
    let claims: Vec<_> = claims.into_iter().map(|claim| claim.unwrap().expect("a job for every slot")).collect();
    assert!(claims.iter().all(|held| (held.fence, held.attempt) == (1, 1)));
    let claimed: BTreeSet<Uuid> = claims.iter().map(service::queue::Claim::uuid).collect();
    assert_eq!(claimed, next[..20].iter().copied().collect());
    // Two slots more than jobs: the last ones get none.
    let rest = join_all((0..next.len() - 18).map(|_| q.claim("w", Room::Any))).await;
    assert_eq!(rest.iter().filter(|claim| claim.as_ref().unwrap().is_some()).count(), next.len() - 20);
    assert_eq!(count(q, "SELECT COUNT(*) AS n FROM job WHERE state = 'running'", Vec::new()).await, 27);
}

async fn ends_that_come_together_are_told_apart(b: Bench) {
    let q = &b.queue;
    let mut holds = Vec::new();
    for _ in 0..24 {
        add(q, |_| {}).await;
        holds.push(claim(q).await.unwrap());
    }
    // One lease is lost and held again, one job is being cancelled, one end cannot be written, one is a failure.
    let lost = holds[3].clone();
    q.rescue(&[]).await.unwrap();
    q.db()
        .run(Scope::System, "UPDATE job SET lease_until = 0 WHERE id = $1", vec![Value::from(&lost.id)])
        .await
        .unwrap();
    assert_eq!(q.rescue(&[]).await.unwrap(), [lost.uuid()]);
    let again = claim(q).await.unwrap();
    assert_eq!(again.id, lost.id);
    q.cancel("default", holds[7].uuid()).await.unwrap();
    let twice = |name: &str| ArtefactRow {
        name: name.to_owned(),
        media_type: "text/csv".to_owned(),
        bytes: 1,
        digest: "sha256:2".to_owned(),
        object_key: "k".to_owned(),
    };
    let impossible = Closing::Succeeded(Published { artefacts: vec![twice("a.csv"), twice("a.csv")] });
    let ends: Vec<_> = (0..24)
        .map(|k| match k {
            11 => impossible.clone(),
            15 => Closing::Crashed("signal 9".into()),
            _ => success(),
        })
        .collect();
    let told = join_all(holds.iter().zip(&ends).map(|(held, end)| q.close(held, end))).await;
    for (k, told) in told.into_iter().enumerate() {
        let wanted = match k {
            3 => None,
            7 => Some(JobState::Cancelled),
            15 => Some(JobState::Queued),
            11 => {
                assert!(told.is_err(), "an end whose artefacts have one name");
                assert_eq!(state(q, holds[k].uuid()).await, JobState::Running);
                continue;
            }
            _ => Some(JobState::Succeeded),
        };
        assert_eq!(told.unwrap(), wanted, "hold {k}");
        assert_eq!(
            q.artefacts(holds[k].uuid()).await.unwrap().len(),
            if wanted == Some(JobState::Succeeded) { 2 } else { 0 }
        );
    }
    assert_eq!(q.close(&again, &success()).await.unwrap(), Some(JobState::Succeeded));
}

async fn jobs_that_come_together_are_told_apart(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "ward", None, None).await.unwrap();
    let earlier = NewJob { idempotency_key: Some("k0".into()), ..new("default") };
    assert!(matches!(q.submit(&earlier).await.unwrap(), Submitted::New(_)));
    // Four of each key, two tenants, and some without a key.
    let jobs: Vec<NewJob> = (0..40)
        .map(|k| NewJob {
            idempotency_key: (k % 5 < 4).then(|| format!("k{}", k % 5)),
            ..new(if k < 20 { "default" } else { "ward" })
        })
        .collect();
    let told = join_all(jobs.iter().map(|job| q.submit(job))).await;
    let (mut fresh, mut replayed) = (BTreeSet::new(), BTreeMap::<_, BTreeSet<String>>::new());
    for (job, told) in jobs.iter().zip(told) {
        match told.unwrap() {
            Submitted::New(row) => {
                assert_eq!((row.id.clone(), &row.tenant), (job.id.to_string(), &job.tenant));
                if job.idempotency_key.is_some() {
                    replayed
                        .entry((job.tenant.clone(), job.idempotency_key.clone()))
                        .or_default()
                        .insert(row.id.clone());
                }
                fresh.insert(row.id);
            }
            Submitted::Replayed(row) => {
                replayed.entry((job.tenant.clone(), job.idempotency_key.clone())).or_default().insert(row.id);
            }
            Submitted::Mismatch(row) => panic!("{row:?}"),
        }
    }
    // Eight without a key, three new keys of one tenant and four of the other.
    assert_eq!(fresh.len(), 8 + 3 + 4);
    assert!(replayed.values().all(|ids| ids.len() == 1), "one job for each key: {replayed:?}");
    assert!(replayed[&("default".to_owned(), Some("k0".to_owned()))].contains(&earlier.id.to_string()));
    assert_eq!(count(q, "SELECT COUNT(*) AS n FROM event", Vec::new()).await, 16, "each job's event, and no other");
}

async fn an_end_in_a_group_has_its_consequences(b: Bench) {
    let q = &b.queue;
    tenants::set(q.db(), "ward", None, Some(60_000)).await.unwrap();
    sql(q, "INSERT INTO webhook (id, tenant, url, secret, created_at) VALUES ('h', 'ward', 'u', 's', 0), ('i', 'ward', 'u', 's', 0)").await;
    for k in 0..16 {
        add(q, |job| job.tenant = if k % 2 == 0 { "ward" } else { "default" }.to_owned()).await;
    }
    let holds: Vec<_> = join_all((0..16).map(|_| q.claim("w", Room::Any)))
        .await
        .into_iter()
        .map(|held| held.unwrap().unwrap())
        .collect();
    let end = success();
    for told in join_all(holds.iter().map(|held| q.close(held, &end))).await {
        assert_eq!(told.unwrap(), Some(JobState::Succeeded));
    }
    let kept = "SELECT COUNT(*) AS n FROM job WHERE tenant = 'ward' AND expires_at = finished_at + 60000";
    assert_eq!(count(q, kept, Vec::new()).await, 8);
    assert_eq!(count(q, "SELECT COUNT(*) AS n FROM job WHERE expires_at IS NOT NULL", Vec::new()).await, 8);
    assert_eq!(
        count(q, "SELECT COUNT(*) AS n FROM outbox", Vec::new()).await,
        16,
        "one message for each webhook and end"
    );
    for held in &holds {
        let states: Vec<_> = q.events(held.uuid(), 0, 9).await.unwrap().into_iter().map(|event| event.state).collect();
        assert_eq!(states, [JobState::Queued, JobState::Running, JobState::Succeeded]);
        let messages = "SELECT COUNT(*) AS n FROM outbox WHERE body LIKE '%' || $1 || '%succeeded%'";
        let wanted = if held.tenant == "ward" { 2 } else { 0 };
        assert_eq!(count(q, messages, vec![Value::from(&held.id)]).await, wanted);
    }
}

async fn an_erased_job_takes_its_events_along(b: Bench) {
    let q = &b.queue;
    let (gone, kept) = (add(q, |_| {}).await, add(q, |_| {}).await);
    q.cancel("default", gone).await.unwrap();
    assert!(q.erase("default", gone).await.unwrap());
    let of = "SELECT COUNT(*) AS n FROM event WHERE job = $1";
    assert_eq!(count(q, of, vec![Value::from(gone)]).await, 0);
    assert_eq!(count(q, of, vec![Value::from(kept)]).await, 1);
}
