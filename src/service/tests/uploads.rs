//! Resumable uploads: broken off anywhere they arrive whole, their checksums are kept, they end when they should.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, RequestBuilder, Response};
use serde_json::json;
use service::db::Scope;
use service::media::base64;
use service::open_database;
use sha2::{Digest as _, Sha256};
use std::io::Write as _;
use std::net::TcpStream;
use std::time::Duration;
use support::{Service, problem};

/// Numbers that look random and are the same at every run.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 % n as u64).unwrap()
    }
}

fn data(bytes: usize) -> Vec<u8> {
    let mut dice = Dice(0x5eed);
    (0..bytes).map(|_| u8::try_from(dice.below(256)).unwrap()).collect()
}

fn call(service: &Service, method: Method, path: &str) -> RequestBuilder {
    service.request(method, path).header("tus-resumable", "1.0.0")
}

async fn create(service: &Service, bytes: usize) -> String {
    let name = base64("scan.bin".as_bytes());
    let request = call(service, Method::POST, "/v1/uploads").header("upload-length", bytes.to_string());
    let made = request.header("upload-metadata", format!("filename {name},kind eA==")).send().await.unwrap();
    assert_eq!(made.status(), 201);
    assert!(made.headers()["upload-expires"].to_str().unwrap().ends_with(" GMT"));
    made.headers()["location"].to_str().unwrap().to_owned()
}

fn patch(service: &Service, path: &str, offset: usize, bytes: &[u8]) -> RequestBuilder {
    let request = call(service, Method::PATCH, path).header("content-type", "application/offset+octet-stream");
    request.header("upload-offset", offset.to_string()).body(bytes.to_vec())
}

async fn offset(service: &Service, path: &str) -> usize {
    let told = call(service, Method::HEAD, path).send().await.unwrap();
    assert_eq!(told.status(), 200);
    told.headers()["upload-offset"].to_str().unwrap().parse().unwrap()
}

/// A PATCH whose connection is lost after `sent` bytes of the body.
fn broken_off(service: &Service, path: &str, offset: usize, bytes: &[u8], sent: usize) {
    let host = service.base.strip_prefix("http://").unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    write!(
        stream,
        "PATCH {path} HTTP/1.1\r\nhost: {host}\r\ntus-resumable: 1.0.0\r\ncontent-type: application/offset+octet-stream\r\n\
         upload-offset: {offset}\r\ncontent-length: {}\r\n\r\n",
        bytes.len()
    )
    .unwrap();
    stream.write_all(&bytes[..sent]).unwrap();
}

/// The offset once no call writes any more.
async fn settled(service: &Service, path: &str) -> usize {
    let mut last = offset(service, path).await;
    loop {
        tokio::time::sleep(Duration::from_millis(30)).await;
        let now = offset(service, path).await;
        if now == last {
            return now;
        }
        last = now;
    }
}

/// Sends until it is accepted: a call that was broken off may still hold the upload for a moment.
async fn sent(request: impl Fn() -> RequestBuilder) -> Response {
    loop {
        let response = request().send().await.unwrap();
        if response.status() != 423 {
            return response;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_broken_off_twenty_times_arrives_whole_also_over_a_restart() {
    let mut service = Service::start().await;
    let data = data(6 << 20);
    let path = create(&service, data.len()).await;
    let mut dice = Dice(7);
    for round in 0..20 {
        let at = settled(&service, &path).await;
        let sent = dice.below((data.len() - at).min(500_000)) + 1;
        broken_off(&service, &path, at, &data[at..], sent);
        let now = settled(&service, &path).await;
        assert!((at..=at + sent).contains(&now), "{at} + {sent} gave {now}");
        if round == 10 {
            let folder = service.stop().await;
            // The half of an upload shows nothing of its bytes.
            for file in support::files(&folder.path().join("data")) {
                let bytes = std::fs::read(&file).unwrap();
                assert!(!bytes.windows(64).any(|w| w == &data[..64]), "{}", file.display());
            }
            let server = service::Server::start(support::config(folder.path())).await.unwrap();
            let base = format!("http://{}", server.address());
            service = Service { base, server: Some(server), client: support::client(), folder };
        }
    }
    let at = settled(&service, &path).await;
    assert!(at > 0 && at < data.len());
    // Not whole yet: no job.
    let id = path.rsplit('/').next().unwrap().to_owned();
    let named = json!({"upload": id, "plan": {"do": "work"}});
    let early = sent(|| service.request(Method::POST, "/v1/jobs").json(&named)).await;
    assert_eq!(problem(early, 409).await, "upload.unfinished");
    let wrong = sent(|| patch(&service, &path, at + 1, &data[at + 1..])).await;
    assert_eq!(problem(wrong, 409).await, "upload.offset");
    let last = sent(|| patch(&service, &path, at, &data[at..])).await;
    assert_eq!(last.status(), 204);
    assert_eq!(last.headers()["upload-offset"], data.len().to_string());
    // The same job for the same key, also when it is asked for twice.
    let mut ids = Vec::new();
    for status in [202, 200] {
        let request = service.request(Method::POST, "/v1/jobs").header("idempotency-key", "once").json(&named);
        let job = request.send().await.unwrap();
        assert_eq!(job.status(), status);
        ids.push(support::json(job).await["id"].as_str().unwrap().to_owned());
        service.ended(&ids[0]).await;
    }
    assert_eq!(ids[0], ids[1]);
    let result = service.json(&format!("/v1/jobs/{}/result", ids[0])).await;
    let digest = Sha256::new().chain_update("scan.bin").chain_update(&data).finalize();
    assert_eq!(result["seen"], service::store::hex(&digest));
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_checksum_is_kept_and_a_wrong_one_keeps_nothing() {
    let service = Service::start().await;
    let data = data(700_000);
    let path = create(&service, data.len()).await;
    let half = data.len() / 2;
    let sum = |bytes: &[u8]| format!("sha256 {}", base64(&Sha256::digest(bytes)));
    let right = patch(&service, &path, 0, &data[..half]).header("upload-checksum", sum(&data[..half]));
    assert_eq!(right.send().await.unwrap().status(), 204);
    let wrong = patch(&service, &path, half, &data[half..]).header("upload-checksum", sum(&data[..half]));
    assert_eq!(problem(wrong.send().await.unwrap(), 460).await, "upload.checksum");
    assert_eq!(settled(&service, &path).await, half);
    for (value, code) in [("md5 AAAA", "upload.checksum"), ("sha256 ***", "upload.checksum")] {
        let odd = patch(&service, &path, half, &data[half..]).header("upload-checksum", value);
        assert_eq!(problem(odd.send().await.unwrap(), 400).await, code);
    }
    let sha1 = "sha1 gDvSL8vyn1G2SJPjlCZiOGOX6ks=";
    let wrong = patch(&service, &path, half, b"hello").header("upload-checksum", sha1);
    assert_eq!(problem(wrong.send().await.unwrap(), 460).await, "upload.checksum");
    let sha1 = "sha1 qvTGHdzF6KLavt4PO0gs2a6pQ00=";
    let right = patch(&service, &path, half, b"hello").header("upload-checksum", sha1);
    assert_eq!(right.send().await.unwrap().status(), 204);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_are_bounded_and_end() {
    let service = Service::with(|config| config.max_body = 1 << 20).await;
    let able = service.request(Method::OPTIONS, "/v1/uploads").send().await.unwrap();
    assert_eq!(able.headers()["tus-extension"], "creation,checksum,expiration,termination");
    assert_eq!(able.headers()["tus-max-size"], (1 << 20).to_string());
    let large = call(&service, Method::POST, "/v1/uploads").header("upload-length", "1048577").send().await.unwrap();
    assert_eq!(problem(large, 413).await, "upload.too_large");
    let odd = service.request(Method::POST, "/v1/uploads").header("tus-resumable", "0.2.2").send().await.unwrap();
    assert_eq!(odd.headers()["tus-version"], "1.0.0");
    assert_eq!(problem(odd, 412).await, "upload.version");
    let path = create(&service, 10).await;
    let more = patch(&service, &path, 0, &[0; 11]).send().await.unwrap();
    assert_eq!(problem(more, 413).await, "upload.too_large");
    // Another key in the address finds nothing; the end leaves nothing.
    let other = format!("{}{}", &path[..path.len() - 1], if path.ends_with('0') { '1' } else { '0' });
    assert_eq!(call(&service, Method::HEAD, &other).send().await.unwrap().status(), 404);
    let uploads = service.data().join("uploads");
    assert_eq!(support::files(&uploads).len(), 1);
    assert_eq!(call(&service, Method::DELETE, &path).send().await.unwrap().status(), 204);
    assert_eq!(call(&service, Method::HEAD, &path).send().await.unwrap().status(), 404);
    assert_eq!(support::files(&uploads), Vec::<std::path::PathBuf>::new());
    // Past its time an upload is not found, and the next start erases it.
    let path = create(&service, 10).await;
    let db = open_database(&support::config(service.folder.path())).await.unwrap();
    db.run(Scope::System, "UPDATE upload SET expires_at = 1", Vec::new()).await.unwrap();
    assert_eq!(call(&service, Method::HEAD, &path).send().await.unwrap().status(), 404);
    db.close().await;
    for _ in 0..64 {
        create(&service, 1).await;
    }
    let many = call(&service, Method::POST, "/v1/uploads").header("upload-length", "1").send().await.unwrap();
    assert_eq!(problem(many, 409).await, "upload.many");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_stand_on_postgresql_too() {
    let cluster = tokio::task::spawn_blocking(support::postgres::cluster).await.unwrap();
    let Some(cluster) = cluster else { return };
    let url = cluster.database();
    let service = Service::with(|config| {
        config.database_url = Some(url);
        config.workers = 0;
    })
    .await;
    let path = create(&service, 5).await;
    assert_eq!(patch(&service, &path, 0, b"abcde").send().await.unwrap().status(), 204);
    assert_eq!(offset(&service, &path).await, 5);
    let named = json!({"upload": path.rsplit('/').next().unwrap()});
    assert_eq!(service.request(Method::POST, "/v1/jobs").json(&named).send().await.unwrap().status(), 202);
    assert_eq!(call(&service, Method::DELETE, &path).send().await.unwrap().status(), 204);
    assert_eq!(call(&service, Method::HEAD, &path).send().await.unwrap().status(), 404);
    service.stop().await;
}
