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
    let mut child = Command::new(program())
        .args([folder.join("data"), PathBuf::from("python3"), support::script(folder)])
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
