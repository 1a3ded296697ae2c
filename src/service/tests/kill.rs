//! A server that dies without a word.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::{Value, json};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// A server process that ends with its test, however that ends.
struct Process(Child);

impl Process {
    /// SIGKILL: no word, no clean-up.
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The example `serve`, built beside this test.
fn program() -> PathBuf {
    let deps = std::env::current_exe().unwrap();
    deps.parent().unwrap().parent().unwrap().join("examples/serve")
}

fn start(folder: &Path) -> (Process, String) {
    start_as(folder, "")
}

/// A worker process without a server.
fn worker(folder: &Path) -> Process {
    let child = Command::new(program())
        .args([folder.join("data"), PathBuf::from("python3"), support::script(folder)])
        .arg("work")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    Process(child)
}

fn start_as(folder: &Path, mode: &str) -> (Process, String) {
    let mut child = Command::new(program())
        .args([folder.join("data"), PathBuf::from("python3"), support::script(folder)])
        .arg(mode)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let base = line.trim().strip_prefix("listening on ").unwrap().to_owned();
    assert_eq!(std::fs::read_to_string(folder.join("data/listen")).unwrap().trim(), base);
    (Process(child), base)
}

async fn digests(client: &reqwest::Client, base: &str, id: &str) -> Value {
    let list = client.get(format!("{base}/v1/jobs/{id}/artefacts")).send().await.unwrap();
    let items = support::json(list).await["items"].clone();
    items.as_array().unwrap().iter().map(|a| json!([a["name"], a["digest"]])).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_server_finishes_its_job_after_restart() {
    let folder = tempfile::TempDir::new().unwrap();
    let client = support::client();
    let (mut server, base) = start(folder.path());
    let send = |base: String| {
        let request = support::upload(&client, &base, &json!({"seconds": 1.5}));
        async move { support::json(request.send().await.unwrap()).await["id"].as_str().unwrap().to_owned() }
    };
    let whole = send(base.clone()).await;
    support::ended(&client, &base, &whole).await;
    let wanted = digests(&client, &base, &whole).await;

    let killed = send(base.clone()).await;
    loop {
        let job = client.get(format!("{base}/v1/jobs/{killed}")).send().await.unwrap();
        if support::json(job).await["state"] == "running" {
            break;
        }
    }
    server.kill();

    let (mut server, base) = start(folder.path());
    let job = support::ended(&client, &base, &killed).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)));
    assert_eq!(digests(&client, &base, &killed).await, wanted);
    server.kill();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stopped_worker_loses_its_job_and_cannot_write_when_woken() {
    use rustix::process::{Pid, Signal, kill_process};
    let folder = tempfile::TempDir::new().unwrap();
    let client = support::client();
    let (mut server, base) = start_as(folder.path(), "idle");
    let mut stopped = worker(folder.path());
    let sent = support::upload(&client, &base, &json!({"seconds": 1.0})).send().await.unwrap();
    let id = support::json(sent).await["id"].as_str().unwrap().to_owned();
    while support::json(client.get(format!("{base}/v1/jobs/{id}")).send().await.unwrap()).await["state"] != "running" {
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    let pid = Pid::from_raw(i32::try_from(stopped.0.id()).unwrap()).unwrap();
    kill_process(pid, Signal::STOP).unwrap();
    let begun = std::time::Instant::now();
    let mut other = worker(folder.path());
    loop {
        let job = support::json(client.get(format!("{base}/v1/jobs/{id}")).send().await.unwrap()).await;
        if job["attempt"] == 2 {
            break;
        }
        assert!(begun.elapsed() < std::time::Duration::from_secs(15), "not taken back: {job}");
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    assert_eq!(support::ended(&client, &base, &id).await["state"], "succeeded");
    let wanted = digests(&client, &base, &id).await;
    kill_process(pid, Signal::CONT).unwrap();
    // Long enough for the woken one to publish, if it could.
    tokio::time::sleep(std::time::Duration::from_millis(1500)).await;
    assert_eq!(digests(&client, &base, &id).await, wanted);
    let attempts = std::fs::read_dir(folder.path().join(format!("data/store/jobs/{id}/artefacts"))).unwrap();
    assert_eq!(attempts.count(), 1, "the woken worker left files behind");
    let job = support::json(client.get(format!("{base}/v1/jobs/{id}")).send().await.unwrap()).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(2)));
    for process in [&mut stopped, &mut other, &mut server] {
        process.kill();
    }
}
