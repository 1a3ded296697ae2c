//! Artefacts in S3, against s3s-fs, which checks signatures and checksums (moto takes a wrong secret, so it proves nothing).

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::json;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use support::Service;

struct S3 {
    process: Child,
    folder: tempfile::TempDir,
    port: u16,
}

impl Drop for S3 {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A server of its own, or `None` where the program is not there (VASCULUM_S3S names it; `cargo xtask test` does).
fn s3() -> Option<S3> {
    let Some(program) = std::env::var_os("VASCULUM_S3S").map(PathBuf::from).filter(|p| p.exists()) else {
        eprintln!("skipped: VASCULUM_S3S does not name the program s3s-fs");
        return None;
    };
    let folder = tempfile::TempDir::new().unwrap();
    std::fs::create_dir(folder.path().join("scans")).unwrap();
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let process = Command::new(program)
        .args(["--host", "127.0.0.1", "--port", &port.to_string(), "--access-key", "key", "--secret-key", "secret"])
        .arg(folder.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
        std::thread::sleep(Duration::from_millis(20));
    }
    Some(S3 { process, folder, port })
}

fn settings(port: u16, secret: &str) -> Vec<(String, String)> {
    [
        ("ENDPOINT", format!("http://127.0.0.1:{port}")),
        ("REGION", "us-east-1".to_owned()),
        ("ACCESS_KEY_ID", "key".to_owned()),
        ("SECRET_ACCESS_KEY", secret.to_owned()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_lives_in_a_bucket_and_leaves_nothing_behind() {
    let Some(s3) = s3() else { return };
    let service = Service::with(|config| {
        config.store_url = Some("s3://scans/ward".to_owned());
        config.s3 = settings(s3.port, "secret");
    })
    .await;
    let id = service.submit(&json!({})).await;
    let job = service.ended(&id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let path = format!("/v1/jobs/{id}");
    assert_eq!(service.json(&format!("{path}/result")).await["files"], json!(["a.png", "b.png"]));
    let part =
        service.request(reqwest::Method::GET, &format!("{path}/artefacts/surface.glb")).header("range", "bytes=4-6");
    assert_eq!(part.send().await.unwrap().text().await.unwrap(), "012");
    let stored = || support::files(&s3.folder.path().join("scans")).len();
    // Two scan files, their manifest, five artefacts.
    assert_eq!(stored(), 8);
    assert_eq!(service.json("/readyz").await["store"], "ok");
    assert!(support::files(&service.data().join("store")).is_empty());
    let erased = service.request(reqwest::Method::DELETE, &path).send().await.unwrap();
    assert_eq!(erased.status(), reqwest::StatusCode::NO_CONTENT);
    assert_eq!(stored(), 0);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_large_file_goes_in_parts_and_arrives_whole() {
    let Some(s3) = s3() else { return };
    let service = Service::with(|config| {
        config.store_url = Some("s3://scans".to_owned());
        config.s3 = settings(s3.port, "secret");
    })
    .await;
    // Two whole parts and a bit, no two of them alike.
    let large: Vec<u8> = (0..17_u32 << 20).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let form = reqwest::multipart::Form::new()
        .text("plan", json!({}).to_string())
        .part("input", reqwest::multipart::Part::bytes(large.clone()).file_name("scan/a.png"));
    let sent = service.request(reqwest::Method::POST, "/v1/jobs").multipart(form).send().await.unwrap();
    assert_eq!(sent.status(), reqwest::StatusCode::ACCEPTED);
    let id = support::json(sent).await["id"].as_str().unwrap().to_owned();
    let job = service.ended(&id).await;
    assert_eq!(job["state"], "succeeded", "{job}");
    let stored = support::files(&s3.folder.path().join("scans"));
    let whole = stored.iter().filter(|file| std::fs::metadata(file).unwrap().len() == large.len() as u64);
    assert_eq!(whole.map(|file| std::fs::read(file).unwrap() == large).collect::<Vec<_>>(), [true]);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_secret_accepts_nothing() {
    let Some(s3) = s3() else { return };
    let service = Service::with(|config| {
        config.store_url = Some("s3://scans".to_owned());
        config.s3 = settings(s3.port, "wrong");
    })
    .await;
    let refused = service.upload(&json!({})).send().await.unwrap();
    assert!(refused.headers().contains_key("retry-after"));
    assert_eq!(support::problem(refused, 503).await, "store.away");
    assert!(service.json("/v1/jobs").await["items"].as_array().unwrap().is_empty());
    assert_eq!(support::problem(service.get("/readyz").await, 503).await, "not_ready");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_setting_that_is_none_is_named() {
    let folder = tempfile::TempDir::new().unwrap();
    let mut config = support::config(folder.path());
    config.store_url = Some("s3://scans".to_owned());
    config.s3 = vec![("SECRET".to_owned(), "x".to_owned())];
    let refused = service::Server::start(config).await.unwrap_err();
    assert!(refused.to_string().contains("aws_secret"), "{refused}");
}
