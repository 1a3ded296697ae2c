//! A running job's process as the kernel sees it: no network, no secrets in its environment, a folder of its own.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod serving;

use serde_json::Value;
use std::fs;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
const BINARY: &str = env!("CARGO_BIN_EXE_vasculum");

struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The process of the job that works in this folder.
fn job_process(data: &Path) -> PathBuf {
    let begun = Instant::now();
    let works =
        |process: &PathBuf| fs::read_link(process.join("cwd")).is_ok_and(|cwd| cwd.starts_with(data.join("work")));
    loop {
        let processes = fs::read_dir("/proc").unwrap().flatten().map(|entry| entry.path());
        if let Some(found) = processes.into_iter().find(works) {
            return found;
        }
        assert!(begun.elapsed() < Duration::from_secs(30), "no job runs");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn status(process: &Path, field: &str) -> String {
    let text = fs::read_to_string(process.join("status")).unwrap();
    text.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':')).unwrap().trim().to_owned()
}

async fn sent(client: &reqwest::Client, address: &str, scan: &Path) -> String {
    let mut form = reqwest::multipart::Form::new();
    for entry in fs::read_dir(scan.join("dicom")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        form = form.part("input", reqwest::multipart::Part::bytes(fs::read(&path).unwrap()).file_name(name));
    }
    let request =
        client.post(format!("{address}/v1/jobs")).header("traceparent", format!("00-{TRACE}-00f067aa0ba902b7-01"));
    let answer = request.multipart(form).send().await.unwrap();
    assert_eq!(answer.status(), 202);
    answer.headers()["location"].to_str().unwrap().to_owned()
}

/// Whether a shell in the network of this process reaches the port.
fn reaches(process: &Path, port: u16) -> bool {
    let net = format!("--net={}", process.join("ns/net").display());
    let connect = format!("exec 3<>/dev/tcp/127.0.0.1/{port}");
    Command::new("nsenter").args([&net, "bash", "-c", &connect]).output().unwrap().status.success()
}

async fn looked_at(command: impl FnOnce(&mut Command)) {
    service::tls::provide();
    let folder = TempDir::new().unwrap();
    // Also for the user that is nobody.
    fs::set_permissions(folder.path(), std::os::unix::fs::PermissionsExt::from_mode(0o777)).unwrap();
    let scan = folder.path().join("scan");
    let made = Command::new(BINARY).args(["phantom", "anastomosis", "--out"]).arg(&scan).output().unwrap();
    assert!(made.status.success());
    let data = folder.path().join("data");
    // The target folder may lie in a home that only its owner may enter.
    let binary = folder.path().join("vasculum");
    fs::copy(BINARY, &binary).unwrap();
    let (server, address) = serving::serve(&binary, &data, |serve| {
        serve.env("VASCULUM_S3_SECRET_ACCESS_KEY", "hush").env("DATABASE_PASSWORD", "hush");
        command(serve);
    });
    let server = Server(server);
    let client = reqwest::Client::new();
    let job = sent(&client, &address, &scan).await;
    let process = job_process(&fs::canonicalize(&data).unwrap());

    // Its barriers are up once it has said so.
    let begun = Instant::now();
    let told = loop {
        let roll: Value = client.get(format!("{address}/v1/workers")).send().await.unwrap().json().await.unwrap();
        if let Some(barriers) = roll["items"][0]["isolation"].as_str() {
            break barriers.to_owned();
        }
        assert!(begun.elapsed() < Duration::from_secs(10), "the job says nothing: {roll}");
    };
    assert_ne!(told, "none", "neither a namespace nor a filter is permitted here");
    if told.contains("namespace") {
        let net = |process: &Path| fs::read_link(process.join("ns/net")).unwrap();
        assert_ne!(net(&process), net(Path::new("/proc/self")));
        // Only root may enter another's namespace.
        if fs::metadata("/proc/self").is_ok_and(|own| std::os::unix::fs::MetadataExt::uid(&own) == 0) {
            let port = address.rsplit(':').next().unwrap().parse().unwrap();
            TcpStream::connect(("127.0.0.1", port)).unwrap();
            assert!(reaches(Path::new("/proc/self"), port), "the test's own network reaches the server");
            assert!(!reaches(&process, port), "the job's network reaches the server");
        }
    }
    if told.contains("filter") {
        assert_eq!((status(&process, "Seccomp").as_str(), status(&process, "NoNewPrivs").as_str()), ("2", "1"));
    }
    let environment = String::from_utf8(fs::read(process.join("environ")).unwrap()).unwrap();
    let mut names: Vec<&str> = environment.split_terminator('\0').map(|pair| pair.split('=').next().unwrap()).collect();
    names.sort_unstable();
    assert_eq!(names, ["TMPDIR", "VASCULUM_TRACE_ID"]);
    assert!(environment.contains(TRACE), "the request's trace goes on in the job: {environment}");
    for descriptor in fs::read_dir(process.join("fd")).unwrap().flatten() {
        let open = fs::read_link(descriptor.path()).unwrap_or_default();
        assert!(!open.to_string_lossy().starts_with("socket:"), "the job holds a socket of the server's");
    }
    client.delete(format!("{address}{job}")).send().await.unwrap();
    drop(server);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_has_no_network_and_no_secrets() {
    looked_at(|_| {}).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nor_has_it_where_the_service_is_not_root() {
    use std::os::unix::process::CommandExt as _;
    let root = fs::metadata("/proc/self").is_ok_and(|own| std::os::unix::fs::MetadataExt::uid(&own) == 0);
    if !root {
        // The test above was it.
        return;
    }
    looked_at(|serve| {
        serve.uid(65_534).gid(65_534);
    })
    .await;
}
