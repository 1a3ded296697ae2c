//! Starting and stopping: locks, database, rescue, sweep, workers, listener.

use crate::auth;
use crate::config::{Auth, Config};
use crate::db::Db;
use crate::http;
use crate::keeping;
use crate::queue::Queue;
use crate::state::{State, UPLOAD_UNIT};
use crate::store::Store;
use crate::telemetry;
use crate::tls::Identity;
use crate::traces::Traces;
use crate::worker::{Heartbeat, Isolation, Memory, Owner, Worker};
use anyhow::{Context as _, bail};
use std::fs::{File, TryLockError};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// How long open connections may go on after the stop.
const FAREWELL: Duration = Duration::from_secs(3);

/// A running service. Dropping it without [`Server::stop`] leaves jobs to be taken back at the next start.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    scheme: &'static str,
    first_key: Option<String>,
    shutdown: CancellationToken,
    tasks: JoinSet<()>,
    db: Db,
    /// Held open for its lock.
    _lock: File,
}

impl Server {
    /// Opens everything, takes back what a dead process left, and listens.
    ///
    /// # Errors
    /// The data folder is in use or cannot be written; the address is taken; no keys on an address beyond loopback.
    pub async fn start(config: Config) -> anyhow::Result<Self> {
        if config.auth == Auth::None && !config.listen.ip().is_loopback() {
            bail!("refusing to serve {} without keys: leave out --no-auth, or listen on 127.0.0.1", config.listen);
        }
        let begun = std::time::SystemTime::now();
        crate::tls::provide();
        let config = Arc::new(config);
        std::fs::create_dir_all(&config.data_dir)
            .with_context(|| format!("cannot make the data folder {}", config.data_dir.display()))?;
        anyhow::ensure!(
            !config.is_shared() || config.workers == 0 || config.store_url.is_some(),
            "workers of several machines need one store: give --store-url with PostgreSQL (or --workers 0)"
        );
        let provider = config.oidc.as_ref().map(auth::Provider::new).transpose()?.map(Arc::new);
        let identity = config.tls.as_ref().map(Identity::read).transpose()?.map(Arc::new);
        let lock = lock(&config.data_dir)?;
        let listener =
            TcpListener::bind(config.listen).await.with_context(|| format!("cannot listen on {}", config.listen))?;
        let address = listener.local_addr()?;
        let shutdown = CancellationToken::new();
        let mut tasks = JoinSet::new();
        let parts = Parts::open(&config).await?;
        let first_key = match config.auth {
            Auth::Required => auth::first_key(parts.queue.db()).await?,
            Auth::None => None,
        };
        let (traces, carrier) = Traces::new(config.otlp_endpoint.as_deref(), shutdown.clone())?;
        tasks.spawn(async move {
            if let Some(carrier) = carrier {
                carrier.await
            }
        });
        let worker = parts.work(&config, &traces, &shutdown, &mut tasks).await?;
        tasks.spawn(keeping::keep(
            parts.queue.clone(),
            parts.store.clone(),
            Arc::clone(&config),
            begun,
            shutdown.clone(),
        ));
        tasks.spawn(parts.queue.clone().carry_hints(shutdown.clone()));
        tasks.spawn(crate::webhooks::deliver(parts.queue.db().clone(), Arc::clone(&config), shutdown.clone()));
        let state = State {
            uploads: Arc::new(Semaphore::new(upload_units(&config))),
            config: Arc::clone(&config),
            queue: parts.queue,
            store: parts.store,
            worker,
            callers: Arc::default(),
            provider,
            shutdown: shutdown.clone(),
            metrics: telemetry::recorder(),
            traces,
            address,
        };
        let db = state.queue.db().clone();
        if let Some(identity) = &identity {
            tasks.spawn(Arc::clone(identity).follow(shutdown.clone()));
        }
        let scheme = if identity.is_some() { "https" } else { "http" };
        tasks.spawn(http::listen(listener, identity, http::router(state), shutdown.clone()));
        std::fs::write(config.data_dir.join("listen"), format!("{scheme}://{address}\n"))?;
        Ok(Self { address, scheme, first_key, shutdown, tasks, db, _lock: lock })
    }

    /// The address really listened on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// `https` with a certificate, else `http`.
    pub fn scheme(&self) -> &'static str {
        self.scheme
    }

    /// The admin key that this start made; shown once and stored nowhere.
    pub fn first_key(&self) -> Option<&str> {
        self.first_key.as_deref()
    }

    /// Stops: no new requests, children killed and their jobs handed back, everything committed.
    pub async fn stop(mut self) {
        self.shutdown.cancel();
        let ended = async { while self.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(FAREWELL, ended).await.is_err() {
            tracing::info!("closing connections that did not end");
            self.tasks.shutdown().await;
        }
        self.db.close().await;
    }
}

/// Queue and store of a configuration.
struct Parts {
    queue: Queue,
    store: Store,
}

impl Parts {
    async fn open(config: &Config) -> anyhow::Result<Self> {
        let queue = Queue::new(Db::open(config).await?);
        let store = Store::open(config)?;
        Ok(Self { queue, store })
    }

    /// Registers as a holder of leases, takes back the jobs of dead ones, and starts the worker slots.
    async fn work(
        &self,
        config: &Arc<Config>,
        traces: &Traces,
        shutdown: &CancellationToken,
        tasks: &mut JoinSet<()>,
    ) -> anyhow::Result<Option<Arc<Worker>>> {
        let owner = Arc::new(Owner::register(&config.data_dir)?);
        let dead = owner.dead()?;
        let rescued = self.queue.rescue(&dead).await?;
        if !rescued.is_empty() {
            tracing::warn!(jobs = rescued.len(), "taken back from a process that died");
        }
        dead.iter().for_each(|name| owner.forget(name));
        if config.workers == 0 {
            return Ok(None);
        }
        let worker = Arc::new(Worker {
            config: Arc::clone(config),
            queue: self.queue.clone(),
            store: self.store.clone(),
            heartbeat: Heartbeat::start(&self.queue, Arc::clone(&owner))?,
            owner,
            memory: Memory::new(config.memory_mb, config.workers),
            isolation: Isolation::default(),
            traces: traces.clone(),
            shutdown: shutdown.clone(),
        });
        tasks.spawn(Arc::clone(&worker).roll());
        for _ in 0..config.workers {
            tasks.spawn(Arc::clone(&worker).slot());
        }
        Ok(Some(worker))
    }
}

fn upload_units(config: &Config) -> usize {
    let units = config.upload_memory.max(config.max_body).div_ceil(UPLOAD_UNIT) + 1;
    usize::try_from(units).unwrap_or(usize::MAX).min(Semaphore::MAX_PERMITS)
}

/// Two servers on one folder would each think the other's jobs its own.
fn lock(data_dir: &Path) -> anyhow::Result<File> {
    let file = File::create(data_dir.join("server.lock"))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            bail!("another server uses the data folder {}: stop it, or give another --data-dir", data_dir.display())
        }
        Err(TryLockError::Error(error)) => Err(error).context("cannot lock the data folder"),
    }
}

/// Serves API, portal and workers until SIGINT or SIGTERM. Prints `listening on http://...` (or `https://...`) on stdout, and at the
/// first start the admin key with a portal link that carries it.
///
/// # Errors
/// See [`Server::start`].
pub async fn serve(config: Config) -> anyhow::Result<()> {
    let server = Server::start(config).await?;
    let scheme = server.scheme();
    say(&format!("listening on {scheme}://{}", server.address()))?;
    if let Some(key) = server.first_key() {
        say(&format!("admin key (shown once): {key}"))?;
        say(&format!("portal: {scheme}://{}/#key={key}", server.address()))?;
    }
    stop_signal().await?;
    tracing::info!("stopping");
    server.stop().await;
    Ok(())
}

/// Works on the jobs of the same data folder without serving, until SIGINT or SIGTERM.
///
/// # Errors
/// The database or the store cannot be opened; `workers` is 0.
pub async fn work(config: Config) -> anyhow::Result<()> {
    if config.workers == 0 {
        bail!("a worker needs --workers 1 or more");
    }
    crate::tls::provide();
    let config = Arc::new(config);
    std::fs::create_dir_all(&config.data_dir)?;
    let parts = Parts::open(&config).await?;
    let shutdown = CancellationToken::new();
    let mut tasks = JoinSet::new();
    let (traces, carrier) = Traces::new(config.otlp_endpoint.as_deref(), shutdown.clone())?;
    tasks.spawn(async move {
        if let Some(carrier) = carrier {
            carrier.await
        }
    });
    let worker = parts.work(&config, &traces, &shutdown, &mut tasks).await?;
    tasks.spawn(parts.queue.clone().carry_hints(shutdown.clone()));
    say(&format!("working on {} jobs at a time", config.workers))?;
    stop_signal().await?;
    shutdown.cancel();
    while tasks.join_next().await.is_some() {}
    drop(worker);
    parts.queue.db().close().await;
    Ok(())
}

fn say(line: &str) -> std::io::Result<()> {
    use std::io::Write as _;
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

async fn stop_signal() -> std::io::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        _ = terminate.recv() => Ok(()),
        interrupt = tokio::signal::ctrl_c() => interrupt,
    }
}

/// Bring the database to this version's schema.
///
/// # Errors
/// The database cannot be opened, or holds a newer schema.
pub async fn migrate(config: Config) -> anyhow::Result<()> {
    std::fs::create_dir_all(&config.data_dir)?;
    Db::open(&config).await?.close().await;
    Ok(())
}

/// The database of a configuration, for the operator's own commands (keys, audit, backup).
///
/// # Errors
/// It cannot be opened, or holds a newer schema.
pub async fn open_database(config: &Config) -> anyhow::Result<Db> {
    std::fs::create_dir_all(&config.data_dir)?;
    Db::open(config).await
}
