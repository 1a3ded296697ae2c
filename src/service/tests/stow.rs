//! STOW-RS: instances that come in any number of requests become one job for each series.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use service::{Instance, Problem};
use std::collections::BTreeSet;
use std::time::Duration;
use support::{Service, problem};

/// An instance of this test: `series/number` and what follows; `bad` in the place of the number is refused.
fn receive(bytes: &[u8]) -> Instance {
    let text = String::from_utf8_lossy(bytes).into_owned();
    let (series, number) = text.split_once('/').unwrap_or(("", ""));
    let number = number.split(':').next().unwrap();
    let refused = Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "dicom.burned_in_annotation", "it names a patient");
    Instance {
        class: "1.2.840.10008.5.1.4.1.1.4".to_owned(),
        instance: format!("1.2.{series}.{number}"),
        study: "1.2".to_owned(),
        series: format!("1.2.{series}"),
        file: if number == "bad" { Err(refused) } else { Ok(text.clone().into_bytes()) },
    }
}

fn body(parts: &[&str]) -> String {
    let each = |part: &&str| format!("--frontier\r\nContent-Type: application/dicom\r\n\r\n{part}\r\n");
    parts.iter().map(each).collect::<String>() + "--frontier--\r\n"
}

fn stow(service: &Service, path: &str, parts: &[&str]) -> RequestBuilder {
    let kind = "multipart/related; type=\"application/dicom\"; boundary=frontier";
    service.request(Method::POST, path).header("content-type", kind).body(body(parts))
}

async fn sent(service: &Service, parts: &[&str]) -> (StatusCode, Vec<String>, Value) {
    let answer = stow(service, "/dicomweb/studies", parts).send().await.unwrap();
    let jobs = answer.headers().get_all("link").iter();
    let jobs = jobs.map(|l| l.to_str().unwrap().split(['<', '>']).nth(1).unwrap().to_owned()).collect();
    assert_eq!(answer.headers()["content-type"], "application/dicom+json");
    (answer.status(), jobs, support::json(answer).await)
}

async fn gathering(quiet: u64) -> Service {
    Service::with(|config| {
        config.receive = receive;
        config.stow_quiet_seconds = quiet;
    })
    .await
}

async fn ended(service: &Service, job: &str) -> Value {
    service.ended(job.rsplit('/').next().unwrap()).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_series_gathers_over_several_requests_and_then_runs_once() {
    let service = gathering(1).await;
    let (status, first, answer) = sent(&service, &["7/1", "7/2", "8/1"]).await;
    assert_eq!((status, first.len()), (StatusCode::OK, 2));
    let items = answer["00081199"]["Value"].as_array().unwrap();
    let item = items.iter().find(|item| item["00081155"]["Value"][0] == "1.2.7.1").unwrap();
    assert!(first.contains(&item["00091001"]["Value"][0].as_str().unwrap().to_owned()), "{answer}");
    let mine = item["00091001"]["Value"][0].as_str().unwrap().to_owned();
    tokio::time::sleep(Duration::from_millis(600)).await;
    // Another part of the series moves its begin on; an instance sent again takes its own place.
    let (_, more, _) = sent(&service, &["7/3", "7/2", "7/1:again"]).await;
    assert_eq!(more, std::slice::from_ref(&mine));
    tokio::time::sleep(Duration::from_millis(600)).await;
    let waiting = service.json(&mine).await;
    assert_eq!((&waiting["state"], &waiting["input"]["files"]), (&json!("queued"), &json!(3)), "{waiting}");
    for job in &first {
        assert_eq!(ended(&service, job).await["state"], "succeeded");
    }
    let result = service.json(&format!("{mine}/result")).await;
    assert_eq!(result["files"].as_array().unwrap().len(), 3, "{result}");
    assert!(result["files"].to_string().contains("image-"), "{result}");
    // What comes after the begin is another job.
    let (_, late, _) = sent(&service, &["7/4"]).await;
    assert_ne!(late, [mine]);
    assert_eq!(ended(&service, &late[0]).await["input"]["files"], 1);
    service.stop().await;
}

/// 24 instances of one series, each in a request of its own, at once.
async fn at_once(service: Service) {
    let requests: Vec<String> = (0..24).map(|n| format!("9/{n}")).collect();
    let one = async |part: &String| sent(&service, &[part.as_str()]).await;
    let all = futures::future::join_all(requests.iter().map(one)).await;
    let jobs: BTreeSet<String> = all.into_iter().flat_map(|(_, jobs, _)| jobs).collect();
    assert_eq!(jobs.len(), 1, "one series, one job: {jobs:?}");
    let job = ended(&service, jobs.first().unwrap()).await;
    assert_eq!((&job["state"], &job["input"]["files"]), (&json!("succeeded"), &json!(24)), "{job}");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_at_the_same_time_lose_nothing() {
    at_once(gathering(2).await).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_at_the_same_time_lose_nothing_on_postgres() {
    let Some(cluster) = tokio::task::spawn_blocking(support::postgres::cluster).await.unwrap() else { return };
    let store = tempfile::TempDir::new().unwrap();
    let service = Service::with(|config| {
        config.receive = receive;
        config.stow_quiet_seconds = 3;
        config.database_url = Some(cluster.database());
        config.store_url = Some(format!("file:{}", store.path().display()));
    });
    at_once(service.await).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_refused_is_named_and_the_rest_is_taken() {
    let service = gathering(0).await;
    let (status, jobs, answer) = sent(&service, &["5/1", "5/bad"]).await;
    assert_eq!((status, jobs.len()), (StatusCode::ACCEPTED, 1));
    let failed = &answer["00081198"]["Value"][0];
    assert_eq!(failed["00081155"]["Value"][0], "1.2.5.bad");
    assert_eq!(failed["00081197"]["Value"][0], 0x0110);
    assert_eq!(failed["00091002"]["Value"][0], "dicom.burned_in_annotation");
    let (status, jobs, answer) = sent(&service, &["5/bad"]).await;
    assert_eq!((status, jobs.len()), (StatusCode::CONFLICT, 0));
    assert!(answer.get("00081199").is_none());
    // Another study than the address says.
    let other = stow(&service, "/dicomweb/studies/1.3", &["5/1"]).send().await.unwrap();
    assert_eq!(other.status(), StatusCode::CONFLICT);
    assert_eq!(support::json(other).await["00081198"]["Value"][0]["00081197"]["Value"][0], 0xa900);
    assert_eq!(stow(&service, "/dicomweb/studies/1.2", &["5/1"]).send().await.unwrap().status(), StatusCode::OK);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_body_of_another_kind_is_refused() {
    let service = gathering(0).await;
    let post = |kind: &'static str, body: String| {
        let request = service.request(Method::POST, "/dicomweb/studies").header("content-type", kind).body(body);
        async move { request.send().await.unwrap() }
    };
    let whole = "multipart/related; type=\"application/dicom\"; boundary=frontier";
    let check = async |answer: Response, status: u16, code: &str| assert_eq!(problem(answer, status).await, code);
    check(post("application/dicom", "x".into()).await, 415, "media_type").await;
    check(post("multipart/form-data; boundary=frontier", body(&["1/1"])).await, 415, "media_type").await;
    check(
        post("multipart/related; type=\"application/dicom+json\"; boundary=frontier", body(&["1/1"])).await,
        415,
        "media_type",
    )
    .await;
    check(post("multipart/related; type=\"application/dicom\"", body(&["1/1"])).await, 400, "bad_request").await;
    check(post(whole, "--frontier--\r\n".into()).await, 400, "bad_request").await;
    check(post(whole, "--frontier\r\n\r\n1/1".into()).await, 400, "upload.broken").await;
    check(
        post(whole, "--frontier\r\nContent-Type: text/plain\r\n\r\n1/1\r\n--frontier--".into()).await,
        415,
        "media_type",
    )
    .await;
    let xml = stow(&service, "/dicomweb/studies", &["1/1"]).header("accept", "application/dicom+xml");
    check(xml.send().await.unwrap(), 406, "not_acceptable").await;
    check(stow(&service, "/dicomweb/studies/x", &["1/1"]).send().await.unwrap(), 400, "bad_request").await;
    assert_eq!(service.json("/v1/jobs").await["items"], json!([]));
    service.stop().await;
}
