//! Who may call, what every answer carries, and what a monitor sees.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, StatusCode};
use serde_json::json;
use service::auth::keys;
use service::{Auth, Server};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use support::{Service, problem};

#[tokio::test(flavor = "multi_thread")]
async fn without_keys_only_a_loopback_name_is_served() {
    let service = Service::start().await;
    for host in ["evil.example", "evil.example:80", "127.0.0.1:1"] {
        let response = service.request(Method::GET, "/v1/jobs").header("host", host).send().await.unwrap();
        assert_eq!(problem(response, 421).await, "host.refused");
    }
    let port = service.base.rsplit(':').next().unwrap();
    let named = service.request(Method::GET, "/v1/jobs").header("host", format!("localhost:{port}"));
    assert_eq!(named.send().await.unwrap().status(), StatusCode::OK);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_open_address_without_keys_is_refused_at_start() {
    let folder = tempfile::TempDir::new().unwrap();
    let mut config = support::config(folder.path());
    config.listen = "0.0.0.0:0".parse().unwrap();
    let refused = Server::start(config).await.unwrap_err();
    assert!(refused.to_string().contains("without keys"), "{refused}");
}

/// As `vasculum key revoke` beside the server does it: from another connection, by commits that the server does not see made.
#[tokio::test(flavor = "multi_thread")]
async fn a_key_revoked_by_another_process_stops_at_once() {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let first = service.server.as_ref().unwrap().first_key().unwrap().to_owned();
    let mut config = support::config(service.folder.path());
    config.auth = Auth::Required;
    let beside = service::db::Db::open(&config).await.unwrap();
    let status =
        async |key: &str| service.request(Method::GET, "/v1/jobs").bearer_auth(key).send().await.unwrap().status();
    for round in 0..5 {
        let key = keys::create(&beside, keys::NewKey::default()).await.unwrap();
        for _ in 0..3 {
            assert_eq!(status(&key).await, StatusCode::OK, "round {round}");
        }
        let made = keys::list(&beside).await.unwrap().pop().unwrap();
        assert!(keys::revoke(&beside, &made.id).await.unwrap());
        assert_eq!(status(&key).await, StatusCode::UNAUTHORIZED, "round {round}");
        assert_eq!(status(&first).await, StatusCode::OK, "another key stays");
    }
    beside.close().await;
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn two_servers_cannot_share_a_folder() {
    let service = Service::start().await;
    let refused = Server::start(support::config(service.folder.path())).await.unwrap_err();
    assert!(refused.to_string().contains("another server"), "{refused}");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_opens_everything_and_its_lack_nothing() {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let key = service.server.as_ref().unwrap().first_key().unwrap().to_owned();
    assert!(key.starts_with("vsk_"));
    assert_eq!(problem(service.get("/v1/jobs").await, 401).await, "auth.missing");
    let wrong = service.request(Method::GET, "/v1/jobs").bearer_auth("vsk_0").send().await.unwrap();
    assert!(wrong.headers().contains_key("www-authenticate"));
    assert_eq!(problem(wrong, 401).await, "auth.key");
    assert_eq!(problem(service.upload(&json!({})).send().await.unwrap(), 401).await, "auth.missing");
    let right = service.request(Method::GET, "/v1/jobs").bearer_auth(&key).send().await.unwrap();
    assert_eq!(right.status(), StatusCode::OK);

    let session = service.request(Method::POST, "/v1/session").json(&json!({"key": key})).send().await.unwrap();
    assert_eq!(session.status(), StatusCode::NO_CONTENT);
    let cookie = session.headers()["set-cookie"].to_str().unwrap().to_owned();
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"));
    let cookie = cookie.split(';').next().unwrap().to_owned();
    let by_cookie = service.request(Method::GET, "/v1/jobs").header("cookie", &cookie).send().await.unwrap();
    assert_eq!(by_cookie.status(), StatusCode::OK);
    let foreign = service.upload(&json!({})).header("cookie", &cookie).header("origin", "http://evil.example");
    assert_eq!(problem(foreign.send().await.unwrap(), 403).await, "auth.origin");

    // Monitors need no key; the key itself is stored nowhere; the second start makes none.
    assert_eq!(service.get("/healthz").await.status(), StatusCode::OK);
    let folder = service.stop().await;
    for file in support::files(&folder.path().join("data")) {
        let bytes = std::fs::read(&file).unwrap();
        assert!(!bytes.windows(key.len()).any(|w| w == key.as_bytes()), "{}", file.display());
    }
    let mut config = support::config(folder.path());
    config.auth = Auth::Required;
    let again = Server::start(config).await.unwrap();
    assert_eq!(again.first_key(), None);
    again.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_error_is_a_problem() {
    let service = Service::start().await;
    assert_eq!(problem(service.get("/nowhere").await, 404).await, "not_found");
    assert_eq!(problem(service.get("/v1/jobs/not-an-id").await, 404).await, "not_found");
    let nobody = "/v1/jobs/01890000-0000-7000-8000-000000000000";
    assert_eq!(problem(service.get(nobody).await, 404).await, "not_found");
    for path in ["/events", "/artefacts", "/artefacts/result.json", "/result"] {
        assert_eq!(problem(service.get(&format!("{nobody}{path}")).await, 404).await, "not_found");
    }
    let put = service.request(Method::PUT, "/v1/jobs").send().await.unwrap();
    assert!(put.headers()["allow"].to_str().unwrap().contains("POST"));
    assert_eq!(problem(put, 405).await, "method");
    assert_eq!(problem(service.get("/v1/jobs?limit=x").await, 400).await, "bad_request");
    assert_eq!(problem(service.get("/v1/jobs?state=odd").await, 400).await, "bad_request");
    assert_eq!(problem(service.get("/v1/jobs?colour=red").await, 400).await, "bad_request");
    let body = service.request(Method::POST, "/v1/session").json(&json!({"key": "k".repeat(100_000)}));
    assert_eq!(problem(body.send().await.unwrap(), 413).await, "too_large");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_trace_goes_through() {
    let service = Service::start().await;
    let trace = "4bf92f3577b34da6a3ce929d0e0e4736";
    let request =
        service.request(Method::GET, "/nowhere").header("traceparent", format!("00-{trace}-00f067aa0ba902b7-01"));
    assert_eq!(request.send().await.unwrap().headers()["x-trace-id"], trace);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn monitors_see_the_truth() {
    let service = Service::start().await;
    assert_eq!(service.json("/readyz").await, json!({"database": "ok", "store": "ok", "disk": "ok"}));
    let id = service.submit(&json!({})).await;
    service.ended(&id).await;
    let metrics = service.get("/metrics").await.text().await.unwrap();
    for wanted in ["vasculum_jobs{state=\"succeeded\"}", "vasculum_http_requests_total{", "duration_seconds_bucket{"] {
        assert!(metrics.contains(wanted), "{wanted} in {metrics}");
    }
    assert_eq!(service.json("/version").await["name"], "vasculum");
    assert_eq!(service.json("/openapi.json").await["openapi"], "3.1.0");
    service.stop().await;
    let full = Service::with(|config| config.min_free_disk = u64::MAX).await;
    assert_eq!(problem(full.get("/readyz").await, 503).await, "not_ready");
    full.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_is_strict() {
    let service = Service::start().await;
    for path in ["/", "/portal/main.js", "/portal/style.css", "/portal/view3d.js"] {
        let response = service.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        let policy = response.headers()["content-security-policy"].to_str().unwrap().to_owned();
        assert!(policy.contains("frame-ancestors 'none'") && !policy.contains("unsafe"), "{policy}");
        assert_eq!(response.headers()["x-content-type-options"], "nosniff");
        let text = response.text().await.unwrap();
        if path == "/" {
            assert!(text.contains("/portal/main.js") && !text.contains(" style=") && !text.contains(" onclick="));
        }
    }
    service.stop().await;
}

#[test]
fn the_committed_document_is_the_generated_one() {
    let committed = include_str!("../../../openapi.yaml");
    assert!(service::openapi() == committed, "openapi.yaml is old: write the output of `vasculum openapi` to it");
    let ids: Vec<_> = committed.lines().filter_map(|line| line.trim().strip_prefix("operationId: ")).collect();
    let once: std::collections::BTreeSet<_> = ids.iter().collect();
    assert_eq!(once.len(), ids.len(), "an operationId is used twice: {ids:?}");
}

/// 8 MiB are more than the sockets hold: a client that sends all before it listens hears why it is refused, however early
/// that was (with PostgreSQL stopped, Python's `requests` saw a broken connection in place of the 503).
#[tokio::test(flavor = "multi_thread")]
async fn a_refusal_is_heard_by_who_is_still_sending() {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let address = service.server.as_ref().unwrap().address();
    let heard = tokio::task::spawn_blocking(move || {
        let mut line = TcpStream::connect(address).unwrap();
        let body = vec![b'x'; 8 << 20];
        let head = format!("POST /v1/jobs HTTP/1.1\r\nhost: x\r\ncontent-length: {}\r\n\r\n", body.len());
        line.write_all(head.as_bytes()).unwrap();
        line.write_all(&body).expect("the connection breaks while the body is sent");
        let mut answer = [0; 12];
        line.read_exact(&mut answer).expect("the answer is lost");
        answer
    });
    assert_eq!(&heard.await.unwrap(), b"HTTP/1.1 401");
    service.stop().await;
}
