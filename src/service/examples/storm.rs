//! The kill storm: server, workers and their children are killed by `kill -9` at random while jobs come in.
//!
//! `storm run sqlite|postgres --kills N --jobs N [--seed N] [--minutes N]` (`cargo xtask storm` calls it). At the end
//! every job that was answered with 202 must be in a final state with at most one success, every artefact must have its
//! digest, and the store must hold nothing that no row names. PostgreSQL itself is stopped in immediate mode 20 times.
//! The other modes are the processes that are killed: `storm serve`, `storm work`, `storm exec-job`.

use anyhow::{Context as _, Result, bail, ensure};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use service::{Auth, Config};
use sha2::{Digest as _, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

#[path = "../tests/support/postgres.rs"]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, dead_code, unreachable_pub, missing_docs)]
mod postgres;

/// Processes that work beside the server.
const WORKERS: usize = 2;
/// Callers that send jobs at the same time.
const CALLERS: usize = 6;
/// Times that PostgreSQL is stopped at once.
const CRASHES: usize = 20;
/// After the last kill, how long no job may end while some are open: a backlog may take its time, a job that stands may not
/// (on a busy machine 20,000 jobs on PostgreSQL were still draining after 300 s).
const SETTLE: Duration = Duration::from_secs(60);

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words.first().map(String::as_str) {
        Some("exec-job") => exec_job(&words[1..]),
        Some("serve") => process(service::serve(config(&words[1..])?)),
        Some("work") => process(service::work(config(&words[1..])?)),
        Some("run") => tokio::runtime::Runtime::new()?.block_on(storm(&words[1..])),
        _ => bail!("storm run sqlite|postgres --kills N --jobs N [--seed N] [--minutes N]"),
    }
}

fn process(work: impl Future<Output = Result<()>>) -> Result<()> {
    tokio::runtime::Runtime::new()?.block_on(work)
}

/// `DATA_DIR STORE DATABASE|- PORT`.
fn config(words: &[String]) -> Result<Config> {
    let [data, store, database, port] = words else { bail!("DATA_DIR STORE DATABASE PORT") };
    Ok(Config {
        data_dir: data.into(),
        store_url: Some(format!("file:{store}")),
        database_url: (database != "-").then(|| database.clone()),
        listen: ([127, 0, 0, 1], port.parse()?).into(),
        auth: Auth::None,
        workers: 2,
        sweep_seconds: 0,
        ..Config::default()
    })
}

/// A short job: a digest of its input, after up to 40 ms.
fn exec_job(words: &[String]) -> Result<()> {
    let value = |name: &str| -> Result<PathBuf> {
        let at = words.iter().position(|w| w == name).context("an argument is missing")?;
        Ok(PathBuf::from(words.get(at + 1).context("an argument is missing")?))
    };
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        std::process::exit(130);
    });
    let bytes = std::fs::read(value("--input")?.join("a.png"))?;
    println!("{{\"stage\":\"read\",\"progress\":0.5}}");
    std::thread::sleep(Duration::from_millis(u64::from(bytes.first().copied().unwrap_or(0)) % 40));
    let out = value("--out")?;
    let part = out.with_extension("part");
    std::fs::create_dir_all(&part)?;
    std::fs::write(part.join("result.json"), format!("{{\"seen\":\"{}\"}}", service::store::digest(&bytes)))?;
    std::fs::rename(part, out)?;
    Ok(())
}

/// A seeded generator (xorshift64*): the storm is the same for the same seed but for the machine's timing.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        usize::try_from((self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) % n as u64).unwrap_or(0)
    }
}

/// Where everything lies.
struct Place {
    folder: tempfile::TempDir,
    database: String,
    port: u16,
}

impl Place {
    fn start(&self, k: usize) -> Result<Child> {
        // With SQLite all share one data folder; with PostgreSQL each process stands for a machine of its own.
        let data = if self.database == "-" { "data".to_owned() } else { format!("data{k}") };
        let mode = if k == 0 { "serve" } else { "work" };
        Ok(Command::new(std::env::current_exe()?)
            .arg(mode)
            .arg(self.folder.path().join(data))
            .arg(self.folder.path().join("store"))
            .args([self.database.as_str(), &self.port.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(if std::env::var_os("STORM_LOUD").is_some() { Stdio::inherit() } else { Stdio::null() })
            .spawn()?)
    }

    fn base(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }
}

fn number(words: &[String], name: &str, usual: usize) -> Result<usize> {
    match words.iter().position(|w| w == name) {
        Some(at) => Ok(words.get(at + 1).context("a number is missing")?.parse()?),
        None => Ok(usual),
    }
}

async fn storm(words: &[String]) -> Result<()> {
    service::tls::provide();
    let on_postgres = words.first().is_some_and(|w| w == "postgres");
    let (kills, jobs) = (number(words, "--kills", 1000)?, number(words, "--jobs", 20_000)?);
    let mut dice = Dice(number(words, "--seed", 1)? as u64 | 1);
    let deadline = Instant::now() + Duration::from_secs(60 * number(words, "--minutes", 120)? as u64);
    let cluster = if on_postgres { Some(postgres::cluster().context("PostgreSQL is not installed")?) } else { None };
    let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let database = cluster.map_or_else(|| "-".to_owned(), postgres::Cluster::database);
    let place = Place { folder: tempfile::TempDir::new()?, database, port };
    let accepted: Arc<Mutex<BTreeMap<String, u8>>> = Arc::default();
    let sent = Arc::new(AtomicUsize::new(0));
    let stop = Arc::new(AtomicBool::new(false));
    let mut callers = Vec::new();
    for caller in 0..CALLERS {
        let call = Caller {
            base: place.base(),
            accepted: Arc::clone(&accepted),
            sent: Arc::clone(&sent),
            stop: Arc::clone(&stop),
            jobs,
        };
        callers.push(tokio::spawn(call.run(caller)));
    }
    let mut processes = (0..=WORKERS).map(|k| place.start(k)).collect::<Result<Vec<_>>>()?;
    let (mut killed, mut crashed) = ([0_usize; 3], 0);
    let begun = Instant::now();
    let mut done = 0;
    while (done < kills || sent.load(Ordering::Relaxed) < jobs) && Instant::now() < deadline {
        tokio::time::sleep(Duration::from_millis(40 + dice.below(260) as u64)).await;
        if done >= kills {
            revive(&place, &mut processes)?;
            continue;
        }
        match dice.below(4) {
            0 => killed[0] += strike(&place, &mut processes, 0)?,
            1 => killed[1] += strike(&place, &mut processes, 1 + dice.below(WORKERS))?,
            _ => {
                let family: Vec<u32> = processes.iter().flat_map(|p| children(p.id())).collect();
                if !family.is_empty() {
                    killed[2] += usize::from(kill(family[dice.below(family.len())]));
                }
            }
        }
        revive(&place, &mut processes)?;
        done = killed.iter().sum();
        if let Some(cluster) = cluster
            && crashed < CRASHES
            && done * CRASHES >= kills * (crashed + 1)
        {
            tokio::task::block_in_place(|| cluster.crash());
            crashed += 1;
        }
    }
    stop.store(true, Ordering::Relaxed);
    let stopped = Instant::now();
    for caller in callers {
        while !caller.is_finished() {
            ensure!(stopped.elapsed() < SETTLE, "a job was neither accepted nor refused for {SETTLE:?}");
            revive(&place, &mut processes)?;
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        caller.await??;
    }
    let accepted = std::mem::take(&mut *accepted.lock().unwrap_or_else(PoisonError::into_inner));
    println!(
        "{} jobs accepted; killed: server {}, workers {}, children {}; database stopped {crashed} times; {:.0} s",
        accepted.len(),
        killed[0],
        killed[1],
        killed[2],
        begun.elapsed().as_secs_f64()
    );
    let outcome = settle(&place, &mut processes, &accepted).await;
    for process in &mut processes {
        process.kill()?;
        process.wait()?;
    }
    outcome
}

/// Starts again what has died.
fn revive(place: &Place, processes: &mut [Child]) -> Result<()> {
    for (k, process) in processes.iter_mut().enumerate() {
        if process.try_wait()?.is_some() {
            *process = place.start(k)?;
        }
    }
    Ok(())
}

fn strike(place: &Place, processes: &mut [Child], k: usize) -> Result<usize> {
    let hit = kill(processes[k].id());
    processes[k].wait()?;
    processes[k] = place.start(k)?;
    Ok(usize::from(hit))
}

fn kill(id: u32) -> bool {
    let pid = i32::try_from(id).ok().and_then(Pid::from_raw);
    pid.is_some_and(|pid| kill_process(pid, Signal::KILL).is_ok())
}

fn children(parent: u32) -> Vec<u32> {
    let Ok(tasks) = std::fs::read_dir(format!("/proc/{parent}/task")) else { return Vec::new() };
    let lists = tasks.flatten().filter_map(|task| std::fs::read_to_string(task.path().join("children")).ok());
    lists.flat_map(|list| list.split_whitespace().filter_map(|id| id.parse().ok()).collect::<Vec<u32>>()).collect()
}

/// Sends jobs, each until it has an answer, under one Idempotency-Key.
struct Caller {
    base: String,
    accepted: Arc<Mutex<BTreeMap<String, u8>>>,
    sent: Arc<AtomicUsize>,
    stop: Arc<AtomicBool>,
    jobs: usize,
}

impl Caller {
    async fn run(self, caller: usize) -> Result<()> {
        let client = reqwest::Client::builder().timeout(Duration::from_secs(10)).build()?;
        let mut k = 0_usize;
        while !self.stop.load(Ordering::Relaxed) {
            if self.sent.load(Ordering::Relaxed) >= self.jobs {
                tokio::time::sleep(Duration::from_millis(20)).await;
                continue;
            }
            k += 1;
            let byte = u8::try_from((caller * 37 + k * 11) % 251)?;
            let key = format!("{caller}-{k}");
            // Also when the storm is over: a job whose answer was lost exists, and would pass for an orphan.
            loop {
                let part = reqwest::multipart::Part::bytes(vec![byte; 64]).file_name("a.png");
                let form = reqwest::multipart::Form::new().part("input", part);
                let request = client.post(format!("{}/v1/jobs", self.base)).header("idempotency-key", &key);
                let Ok(response) = request.multipart(form).send().await else {
                    tokio::time::sleep(Duration::from_millis(30)).await;
                    continue;
                };
                let status = response.status().as_u16();
                if status >= 500 {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    continue;
                }
                // An answer whose body was cut off is asked for again under the same key.
                let Ok(body) = response.bytes().await else { continue };
                ensure!(status == 202 || status == 200, "{status}: {}", String::from_utf8_lossy(&body));
                let job: Value = serde_json::from_slice(&body)?;
                let id = job["id"].as_str().context("no id")?.to_owned();
                self.accepted.lock().unwrap_or_else(PoisonError::into_inner).insert(id, byte);
                self.sent.fetch_add(1, Ordering::Relaxed);
                break;
            }
        }
        Ok(())
    }
}

/// Waits for the end of everything and looks at every promise.
async fn settle(place: &Place, processes: &mut [Child], accepted: &BTreeMap<String, u8>) -> Result<()> {
    let client = reqwest::Client::new();
    let begun = Instant::now();
    let (mut fewest, mut since) = (i64::MAX, Instant::now());
    loop {
        revive(place, processes)?;
        if let Ok(stats) = json(&client, &format!("{}/v1/stats", place.base())).await {
            let count = |state: &str| stats["jobs"][state].as_i64().unwrap_or(i64::MAX / 2);
            let open = count("queued") + count("running");
            if open == 0 {
                break;
            }
            if open < fewest {
                (fewest, since) = (open, Instant::now());
            }
        }
        ensure!(since.elapsed() < SETTLE, "{fewest} jobs are open and none has ended for {SETTLE:?}");
        tokio::time::sleep(Duration::from_millis(300)).await;
    }
    println!("everything ended {:.1} s after the last kill", begun.elapsed().as_secs_f64());
    // The next start sweeps.
    strike(place, processes, 0)?;
    while json(&client, &format!("{}/readyz", place.base())).await.is_err() {
        revive(place, processes)?;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let (mut succeeded, mut failed, mut named) = (0, 0, BTreeSet::new());
    for (id, byte) in accepted {
        let base = format!("{}/v1/jobs/{id}", place.base());
        let job = json(&client, &base).await.with_context(|| format!("job {id} was answered with 202 and is lost"))?;
        match job["state"].as_str() {
            Some("succeeded") => succeeded += 1,
            // Three of its starts met a kill.
            Some("failed")
                if job["error"]["code"] == "job.crashed"
                    && !job["error"]["detail"].to_string().contains("could not run it") =>
            {
                failed += 1;
                continue;
            }
            _ => bail!("job {id} ended as {job}"),
        }
        let events = client.get(format!("{base}/events")).header("accept", "application/json").send().await?;
        let events: Value = serde_json::from_slice(&events.bytes().await?)?;
        let successes = events["items"].as_array().context("no events")?.iter();
        let successes = successes.filter(|e| e["event"] == "state" && e["data"]["state"] == "succeeded").count();
        ensure!(successes == 1, "job {id} succeeded {successes} times");
        let list = json(&client, &format!("{base}/artefacts")).await?;
        for artefact in list["items"].as_array().context("no artefacts")? {
            let name = artefact["name"].as_str().context("no name")?;
            let answer = client.get(format!("{base}/artefacts/{name}")).send().await?;
            let status = answer.status();
            let bytes = answer.bytes().await?;
            ensure!(status.is_success(), "{name} of job {id}: {status} {}", String::from_utf8_lossy(&bytes));
            let digest = format!("sha256:{}", service::store::hex(&Sha256::digest(&bytes)));
            ensure!(artefact["digest"] == digest, "{name} of job {id} has digest {digest}: {artefact}");
            let right = service::store::digest(&[*byte; 64]);
            ensure!(String::from_utf8_lossy(&bytes).contains(&right), "job {id} holds another job's result");
            named.insert(format!("{id}/{name}"));
        }
    }
    let left = orphans(&place.folder.path().join("store"), &named).await?;
    println!(
        "{succeeded} succeeded once each, {failed} failed after three killed starts, {} artefacts right, {left} orphans",
        named.len()
    );
    ensure!(left == 0, "{left} objects that no row names are left after the sweep");
    Ok(())
}

/// Stored artefacts that no row names, once the sweep has had its time.
async fn orphans(store: &Path, named: &BTreeSet<String>) -> Result<usize> {
    let begun = Instant::now();
    loop {
        let mut count = 0;
        for job in std::fs::read_dir(store.join("jobs"))?.flatten() {
            let id = job.file_name().to_string_lossy().into_owned();
            let attempts = std::fs::read_dir(job.path().join("artefacts")).into_iter().flatten().flatten();
            let files: Vec<String> = attempts
                .flat_map(|attempt| std::fs::read_dir(attempt.path()).into_iter().flatten().flatten())
                .map(|file| format!("{id}/{}", file.file_name().to_string_lossy()))
                .collect();
            count += files.len() - usize::from(files.iter().any(|file| named.contains(file)));
        }
        if count == 0 || begun.elapsed() > Duration::from_secs(60) {
            return Ok(count);
        }
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
}

async fn json(client: &reqwest::Client, url: &str) -> Result<Value> {
    let response = client.get(url).send().await?;
    ensure!(response.status().is_success(), "{url}: {}", response.status());
    Ok(serde_json::from_slice(&response.bytes().await?)?)
}
