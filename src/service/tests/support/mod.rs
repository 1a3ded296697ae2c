//! A service in this process with a small Python script in place of the reconstruction, which follows the protocol.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, dead_code, unreachable_pub, missing_docs)]

pub mod postgres;
#[macro_use]
pub mod queues;

use reqwest::{Client, Method, RequestBuilder, Response, StatusCode, multipart};
use serde_json::Value;
use service::{Auth, Config, Server};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// The plan says what the script does: `{"do": "work"|"sleep"|"crash"|"input"|"silent"}`; `seconds` is how long.
const SCRIPT: &str = r#"
import json, os, sys, threading, time, hashlib
if os.path.basename(sys.argv[1]) != "exec-job": sys.exit(9)
args = dict(zip(sys.argv[2::2], sys.argv[3::2]))
def watch():
    while os.read(0, 4096): pass
    os._exit(130)
threading.Thread(target=watch, daemon=True).start()
plan = json.load(open(args["--plan"]))
def step(stage, progress):
    print(json.dumps({"stage": stage, "progress": progress, "eta_s": 1.5}), flush=True)
print("noise of a library", flush=True)
step("read", 0.1)
do = plan.get("do", "work")
if do == "crash": os.kill(os.getpid(), 9)
if do == "silent": sys.exit(0)
if do == "allocate":
    hoard = []
    while True: hoard.append(bytearray(1 << 24))
if do == "input":
    print(json.dumps({"error": {"status": 422, "code": "stack.black", "detail": "every pixel is 0",
          "errors": [{"code": "stack.black", "message": "every pixel is 0", "where": {"slice": 3}}]}}), flush=True)
    sys.exit(2)
step("contours", 0.3)
time.sleep(plan.get("seconds", 0.0))
step("surface", 0.7)
tmp = args["--out"] + ".part"
os.mkdir(tmp)
names = sorted(os.listdir(args["--input"]))
seen = hashlib.sha256()
for n in names: seen.update(n.encode() + open(os.path.join(args["--input"], n), "rb").read())
def write(name, text): open(os.path.join(tmp, name), "w").write(text)
write("result.json", json.dumps({"schema": "vasculum/result/1", "files": names, "seen": seen.hexdigest()}))
write("surface.glb", "glTF" + "0123456789" * 10)
write("surface.vtp", "<VTKFile/>")
if plan.get("sections"): write("sections.json", "{}")
write("angles.csv", "name,value\n")
write("report.html", "<style>p{color:red}</style><p>report</p>")
os.rename(tmp, args["--out"])
step("done", 1.0)
"#;

pub fn script(folder: &Path) -> PathBuf {
    let path = folder.join("exec_job.py");
    std::fs::write(&path, SCRIPT).unwrap();
    path
}

pub struct Service {
    pub server: Option<Server>,
    pub base: String,
    pub client: Client,
    pub folder: TempDir,
}

/// The interpreter itself: a job's process has no PATH, by which a wrapper would find it.
fn python() -> PathBuf {
    static PYTHON: OnceLock<PathBuf> = OnceLock::new();
    let ask = || {
        let said = Command::new("python3").args(["-c", "import sys; print(sys.executable)"]).output().unwrap();
        PathBuf::from(String::from_utf8(said.stdout).unwrap().trim())
    };
    PYTHON.get_or_init(ask).clone()
}

pub fn config(folder: &Path) -> Config {
    Config {
        data_dir: folder.join("data"),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        auth: Auth::None,
        executable: python(),
        executable_args: vec![script(folder).to_string_lossy().into_owned()],
        ..Config::default()
    }
}

impl Service {
    pub async fn start() -> Self {
        Self::with(|_| {}).await
    }

    pub async fn with(change: impl FnOnce(&mut Config)) -> Self {
        let folder = TempDir::new().unwrap();
        let mut config = config(folder.path());
        change(&mut config);
        let server = Server::start(config).await.unwrap();
        Self { base: format!("http://{}", server.address()), server: Some(server), client: client(), folder }
    }

    pub fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{path}", self.base))
    }

    pub async fn get(&self, path: &str) -> Response {
        self.request(Method::GET, path).send().await.unwrap()
    }

    pub async fn json(&self, path: &str) -> Value {
        json(self.get(path).await).await
    }

    pub fn upload(&self, plan: &Value) -> RequestBuilder {
        upload(&self.client, &self.base, plan)
    }

    /// Sends a scan and returns the job's id.
    pub async fn submit(&self, plan: &Value) -> String {
        let response = self.upload(plan).send().await.unwrap();
        assert_eq!(response.status(), StatusCode::ACCEPTED);
        json(response).await["id"].as_str().unwrap().to_owned()
    }

    pub async fn ended(&self, id: &str) -> Value {
        ended(&self.client, &self.base, id).await
    }

    pub async fn until(&self, id: &str, state: &str) {
        let begun = Instant::now();
        while self.json(&format!("/v1/jobs/{id}")).await["state"] != state {
            assert!(begun.elapsed() < Duration::from_secs(10), "the job is never {state}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub async fn stop(mut self) -> TempDir {
        self.server.take().unwrap().stop().await;
        self.folder
    }
}

/// A client; its TLS provider must be there first.
pub fn client() -> Client {
    service::tls::provide();
    Client::new()
}

pub fn upload(client: &Client, base: &str, plan: &Value) -> RequestBuilder {
    upload_to(client, &format!("{base}/v1/jobs"), plan)
}

/// The same to an address with a query.
pub fn upload_to(client: &Client, url: &str, plan: &Value) -> RequestBuilder {
    let form = multipart::Form::new()
        .text("plan", plan.to_string())
        .part("input", multipart::Part::bytes(b"second".to_vec()).file_name("scan/b.png"))
        .part("input", multipart::Part::bytes(b"first".to_vec()).file_name("scan/a.png"));
    client.post(url).multipart(form)
}

pub async fn ended(client: &Client, base: &str, id: &str) -> Value {
    let job = json(client.get(format!("{base}/v1/jobs/{id}?wait=15")).send().await.unwrap()).await;
    assert!(["succeeded", "failed", "cancelled"].contains(&job["state"].as_str().unwrap()), "{job}");
    job
}

pub async fn json(response: Response) -> Value {
    serde_json::from_slice(&response.bytes().await.unwrap()).unwrap()
}

/// A whole problem of RFC 9457 with our members; returns its code.
pub async fn problem(response: Response, status: u16) -> String {
    assert_eq!(response.status().as_u16(), status, "{:?}", response.text().await);
    assert_eq!(response.headers()["content-type"], "application/problem+json");
    let path = response.url().path().to_owned();
    let trace = response.headers()["x-trace-id"].to_str().unwrap().to_owned();
    let body = json(response).await;
    assert_eq!(body["status"], status);
    assert_eq!(body["instance"], path);
    assert_eq!(body["trace_id"], trace);
    for member in ["type", "title", "detail", "code"] {
        assert!(!body[member].as_str().unwrap().is_empty(), "{member} of {body}");
    }
    assert!(body["errors"].is_array());
    body["code"].as_str().unwrap().to_owned()
}

/// Every file below a folder.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut found = Vec::new();
    for entry in entries {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.push(path);
        }
    }
    found
}

/// Waits until neither a working folder nor an object is left.
pub async fn nothing_left(data: &Path) {
    let begun = Instant::now();
    loop {
        let left: Vec<_> = [files(&data.join("store")), files(&data.join("work"))].concat();
        if left.is_empty() {
            return;
        }
        assert!(begun.elapsed() < Duration::from_secs(3), "left behind: {left:?}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
