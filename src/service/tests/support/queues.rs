//! A queue on either database, and what tests do with one.

use service::Config;
use service::db::{Db, Scope};
use service::queue::{ArtefactRow, Claim, Closing, JobState, NewJob, Published, Queue, Room, Submitted};
use uuid::Uuid;

/// A queue on a database of its own.
pub struct Bench {
    pub queue: Queue,
    pub config: Config,
    pub folder: tempfile::TempDir,
}

pub async fn sqlite() -> Option<Bench> {
    let folder = tempfile::TempDir::new().unwrap();
    let config = super::config(folder.path());
    std::fs::create_dir_all(&config.data_dir).unwrap();
    Some(Bench { queue: Queue::new(Db::open(&config).await.unwrap()), config, folder })
}

pub async fn postgres() -> Option<Bench> {
    let cluster = tokio::task::spawn_blocking(super::postgres::cluster).await.unwrap()?;
    let folder = tempfile::TempDir::new().unwrap();
    let config = Config { database_url: Some(cluster.database()), ..super::config(folder.path()) };
    Some(Bench { queue: Queue::new(Db::open(&config).await.unwrap()), config, folder })
}

/// Every test on each database.
#[allow(unused_macros)]
macro_rules! on_both {
    ($($name:ident)*) => {
        mod on_sqlite {
            $(#[tokio::test(flavor = "multi_thread")]
            async fn $name() {
                super::$name(crate::support::queues::sqlite().await.unwrap()).await;
            })*
        }
        mod on_postgres {
            $(#[tokio::test(flavor = "multi_thread")]
            async fn $name() {
                if let Some(bench) = crate::support::queues::postgres().await {
                    super::$name(bench).await;
                }
            })*
        }
    };
}

pub fn new(tenant: &str) -> NewJob {
    NewJob {
        id: Uuid::now_v7(),
        tenant: tenant.to_owned(),
        priority: 0,
        plan: "{}".to_owned(),
        input_digest: "sha256:0".to_owned(),
        input_files: 1,
        input_bytes: 1,
        memory_mb: 0,
        trace_id: "t".to_owned(),
        idempotency_key: None,
        parent: None,
    }
}

pub async fn add(queue: &Queue, change: impl FnOnce(&mut NewJob)) -> Uuid {
    let mut job = new("default");
    change(&mut job);
    assert!(matches!(queue.submit(&job).await.unwrap(), Submitted::New(_)));
    job.id
}

pub async fn claim(queue: &Queue) -> Option<Claim> {
    queue.claim("w", Room::Any).await.unwrap()
}

pub fn success() -> Closing {
    let artefact = |name: &str| ArtefactRow {
        name: name.to_owned(),
        media_type: "application/json".to_owned(),
        bytes: 2,
        digest: "sha256:1".to_owned(),
        object_key: format!("k/{name}"),
    };
    Closing::Succeeded(Published { artefacts: vec![artefact("result.json"), artefact("a.csv")] })
}

pub async fn sql(queue: &Queue, sql: &'static str) {
    queue.db().run(Scope::System, sql, Vec::new()).await.unwrap();
}

pub async fn state(queue: &Queue, id: Uuid) -> JobState {
    queue.job("default", id).await.unwrap().unwrap().state
}
