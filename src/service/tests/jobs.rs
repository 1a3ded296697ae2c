//! Jobs from upload to artefacts, against a stand-in for the reconstruction.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, StatusCode, multipart};
use serde_json::json;
use std::time::{Duration, Instant};
use support::{Service, files, json as body, nothing_left, problem};

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_becomes_artefacts() {
    let service = Service::start().await;
    let response = service.upload(&json!({})).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    assert!(response.headers().contains_key("retry-after"));
    let location = response.headers()["location"].to_str().unwrap().to_owned();
    let job = body(response).await;
    assert_eq!(location, format!("/v1/jobs/{}", job["id"].as_str().unwrap()));
    assert_eq!((&job["state"], &job["kind"], &job["attempt"]), (&json!("queued"), &json!("reconstruction"), &json!(0)));
    let job = service.ended(job["id"].as_str().unwrap()).await;
    assert_eq!((&job["state"], &job["progress"], &job["error"]), (&json!("succeeded"), &json!(1.0), &json!(null)));

    let list = service.json(&format!("{location}/artefacts")).await;
    let names: Vec<_> = list["items"].as_array().unwrap().iter().map(|a| a["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["angles.csv", "report.html", "result.json", "surface.glb", "surface.vtp"]);
    // The common folder is dropped and the names are in order.
    assert_eq!(service.json(&format!("{location}/result")).await["files"], json!(["a.png", "b.png"]));
    assert!(files(&service.data().join("work")).is_empty());

    let erased = service.request(Method::DELETE, &location).send().await.unwrap();
    assert_eq!(erased.status(), StatusCode::NO_CONTENT);
    assert_eq!(problem(service.get(&location).await, 404).await, "not_found");
    nothing_left(&service.data()).await;
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_caller_may_wait_for_the_end_in_the_first_call() {
    let service = Service::start().await;
    let response = service.upload(&json!({})).header("prefer", "respond-async, wait=10").send().await.unwrap();
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(response.headers()["preference-applied"], "wait=10");
    assert_eq!(body(response).await["state"], "succeeded");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_running_job_is_cancelled_within_two_seconds_and_leaves_nothing() {
    let service = Service::start().await;
    let id = service.submit(&json!({"seconds": 60})).await;
    service.until(&id, "running").await;
    // Whatever the child has started by now, it must go.
    tokio::time::sleep(Duration::from_millis(300)).await;
    let begun = Instant::now();
    let response = service.request(Method::POST, &format!("/v1/jobs/{id}/cancel")).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    assert_eq!(service.ended(&id).await["state"], "cancelled");
    assert!(begun.elapsed() < Duration::from_secs(2), "{:?}", begun.elapsed());
    nothing_left(&service.data()).await;
    let again = service.request(Method::POST, &format!("/v1/jobs/{id}/cancel")).send().await.unwrap();
    assert_eq!(again.status(), StatusCode::OK);
    let retry = service.request(Method::POST, &format!("/v1/jobs/{id}/retry")).send().await.unwrap();
    assert_eq!(problem(retry, 409).await, "job.not_failed");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_queued_job_is_cancelled_at_once_and_a_running_one_erased() {
    let service = Service::start().await;
    let first = service.submit(&json!({"seconds": 60})).await;
    service.until(&first, "running").await;
    let second = service.submit(&json!({})).await;
    let response = service.request(Method::POST, &format!("/v1/jobs/{second}/cancel")).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(body(response).await["state"], "cancelled");
    let erased = service.request(Method::DELETE, &format!("/v1/jobs/{first}")).send().await.unwrap();
    assert_eq!(erased.status(), StatusCode::NO_CONTENT);
    nothing_left(&service.data()).await;
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_jobs_own_fault_is_told_and_never_tried_again() {
    let service = Service::start().await;
    let id = service.submit(&json!({"do": "input"})).await;
    let job = service.ended(&id).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(1)));
    assert_eq!(job["error"]["code"], "stack.black");
    assert_eq!(job["error"]["type"], "urn:vasculum:problem:stack.black");
    assert_eq!(job["error"]["errors"][0]["where"]["slice"], 3);
    assert_eq!(problem(service.get(&format!("/v1/jobs/{id}/result")).await, 409).await, "job.no_result_yet");
    let retry = service.request(Method::POST, &format!("/v1/jobs/{id}/retry")).send().await.unwrap();
    assert_eq!(retry.status(), StatusCode::ACCEPTED);
    assert_eq!(service.ended(&id).await["attempt"], 1);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_poison_job_is_started_three_times() {
    let service = Service::start().await;
    let id = service.submit(&json!({"do": "crash"})).await;
    let job = service.ended(&id).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(3)));
    assert_eq!(job["error"]["code"], "job.crashed");
    let list = service.request(Method::GET, &format!("/v1/jobs/{id}/events")).header("accept", "application/json");
    let events = body(list.send().await.unwrap()).await;
    let starts = events["items"].as_array().unwrap().iter().filter(|e| e["event"] == "state");
    assert_eq!(starts.filter(|e| e["data"]["state"] == "running").count(), 3);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_child_that_leaves_no_result_is_a_failure() {
    let service = Service::start().await;
    let id = service.submit(&json!({"do": "silent"})).await;
    assert_eq!(service.ended(&id).await["state"], "failed");
    assert!(files(&service.data().join("work")).is_empty());
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_key_gives_the_same_job() {
    let service = Service::start().await;
    let send = |plan| service.upload(&plan).header("idempotency-key", "k1").send();
    let first = body(send(json!({})).await.unwrap()).await;
    let second = send(json!({})).await.unwrap();
    assert_eq!(second.headers()["idempotency-replayed"], "true");
    assert_eq!(body(second).await["id"], first["id"]);
    let other = send(json!({"seconds": 0.1})).await.unwrap();
    assert_eq!(problem(other, 422).await, "idempotency.mismatch");
    assert_eq!(service.json("/v1/jobs").await["items"].as_array().unwrap().len(), 1);
    service.ended(first["id"].as_str().unwrap()).await;
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_hold_every_job_once() {
    let service = Service::with(|config| config.workers = 0).await;
    let mut sent = Vec::new();
    for _ in 0..7 {
        sent.push(service.submit(&json!({})).await);
    }
    let mut seen = Vec::new();
    let mut next = Some("/v1/jobs?limit=3&state=queued".to_owned());
    while let Some(page) = next {
        let response = service.get(&page).await;
        let link = response.headers().get("link").map(|v| v.to_str().unwrap().to_owned());
        let list = body(response).await;
        seen.extend(list["items"].as_array().unwrap().iter().map(|j| j["id"].as_str().unwrap().to_owned()));
        next = list["next"].as_str().map(str::to_owned);
        assert_eq!(link, next.as_ref().map(|n| format!("<{n}>; rel=\"next\"")));
    }
    sent.reverse();
    assert_eq!(seen, sent);
    assert!(service.json("/v1/jobs?state=failed").await["items"].as_array().unwrap().is_empty());
    assert_eq!(service.json("/v1/stats").await["jobs"]["queued"], 7);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn files_have_ranges_tags_and_forms() {
    let service = Service::start().await;
    let id = service.submit(&json!({})).await;
    service.ended(&id).await;
    let path = format!("/v1/jobs/{id}/artefacts/surface.glb");
    let whole = service.get(&path).await;
    let tag = whole.headers()["etag"].to_str().unwrap().to_owned();
    assert_eq!(whole.headers()["content-type"], "model/gltf-binary");
    let list = service.json(&format!("/v1/jobs/{id}/artefacts")).await;
    assert!(list["items"].as_array().unwrap().iter().any(|a| format!("\"{}\"", a["digest"].as_str().unwrap()) == tag));
    let bytes = whole.bytes().await.unwrap();
    assert_eq!(format!("\"{}\"", service::store::digest(&bytes)), tag);

    let part = service.request(Method::GET, &path).header("range", "bytes=4-7").send().await.unwrap();
    assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
    assert_eq!(part.headers()["content-range"], format!("bytes 4-7/{}", bytes.len()));
    assert_eq!(part.bytes().await.unwrap(), bytes.slice(4..8));
    let stale = service.request(Method::GET, &path).header("range", "bytes=4-7").header("if-range", "\"x\"");
    assert_eq!(stale.send().await.unwrap().status(), StatusCode::OK);
    let beyond = service.request(Method::GET, &path).header("range", "bytes=9999-").send().await.unwrap();
    assert_eq!(beyond.headers()["content-range"], format!("bytes */{}", bytes.len()));
    assert_eq!(problem(beyond, 416).await, "range");
    let seen = service.request(Method::GET, &path).header("if-none-match", &tag).send().await.unwrap();
    assert_eq!(seen.status(), StatusCode::NOT_MODIFIED);
    let head = service.request(Method::HEAD, &path).send().await.unwrap();
    assert_eq!(head.headers()["content-length"], bytes.len().to_string().as_str());

    for (accept, media_type) in [
        ("application/json", "application/json"),
        ("model/gltf-binary", "model/gltf-binary"),
        ("application/xml+vtk", "application/x-vtk+xml"),
    ] {
        let result = service.request(Method::GET, &format!("/v1/jobs/{id}/result")).header("accept", accept);
        assert_eq!(result.send().await.unwrap().headers()["content-type"], media_type);
    }
    let csv = service.get(&format!("/v1/jobs/{id}/result?format=csv")).await;
    assert_eq!(csv.headers()["content-type"], "text/csv; charset=utf-8");
    let none = service.request(Method::GET, &format!("/v1/jobs/{id}/result")).header("accept", "image/png");
    let none = none.send().await.unwrap();
    assert_eq!(none.status(), 406);
    assert!(body(none).await["errors"].as_array().unwrap().len() >= 3);
    let report = service.get(&format!("/v1/jobs/{id}/result?format=html")).await;
    assert!(report.headers()["content-security-policy"].to_str().unwrap().contains("'sha256-"));
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_has_a_tag_that_changes() {
    let service = Service::with(|config| config.workers = 0).await;
    let id = service.submit(&json!({})).await;
    let path = format!("/v1/jobs/{id}");
    let tag = service.get(&path).await.headers()["etag"].to_str().unwrap().to_owned();
    let same = service.request(Method::GET, &path).header("if-none-match", &tag).send().await.unwrap();
    assert_eq!(same.status(), StatusCode::NOT_MODIFIED);
    service.request(Method::POST, &format!("{path}/cancel")).send().await.unwrap();
    let changed = service.request(Method::GET, &path).header("if-none-match", &tag).send().await.unwrap();
    assert_eq!(changed.status(), StatusCode::OK);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn events_can_be_resumed() {
    let service = Service::start().await;
    let id = service.submit(&json!({"seconds": 0.5})).await;
    let path = format!("/v1/jobs/{id}/events");
    // The stream ends with the job, so its whole text can be read.
    let text = service.get(&path).await.text().await.unwrap();
    let ids: Vec<i64> = text.lines().filter_map(|l| l.strip_prefix("id: ")?.parse().ok()).collect();
    assert!(ids.is_sorted() && ids.len() >= 4, "{text}");
    for wanted in ["event: stage", "\"stage\":\"contours\"", "\"state\":\"succeeded\"", "\"eta_s\":1.5"] {
        assert!(text.contains(wanted), "{wanted} in {text}");
    }
    let resumed = service.request(Method::GET, &path).header("last-event-id", ids[1].to_string());
    let resumed = resumed.send().await.unwrap().text().await.unwrap();
    let rest: Vec<i64> = resumed.lines().filter_map(|l| l.strip_prefix("id: ")?.parse().ok()).collect();
    assert_eq!(rest, ids[2..]);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stopped_server_hands_its_job_back_uncounted() {
    let service = Service::start().await;
    let id = service.submit(&json!({"seconds": 2})).await;
    service.until(&id, "running").await;
    let folder = service.stop().await;
    let server = service::Server::start(support::config(folder.path())).await.unwrap();
    let base = format!("http://{}", server.address());
    let job = support::ended(&support::client(), &base, &id).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("succeeded"), &json!(1)));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_of_nothing_is_refused_and_stores_nothing() {
    let service = Service::start().await;
    let send = |form| service.request(Method::POST, "/v1/jobs").multipart(form).send();
    let bytes = || multipart::Part::bytes(b"x".to_vec()).file_name("a.png");
    let none = send(multipart::Form::new().text("plan", "{}")).await.unwrap();
    assert_eq!(problem(none, 422).await, "upload.empty");
    let odd = send(multipart::Form::new().part("other", bytes())).await.unwrap();
    assert_eq!(problem(odd, 400).await, "upload.part");
    let plan = send(multipart::Form::new().text("plan", "[").part("input", bytes())).await.unwrap();
    assert_eq!(problem(plan, 422).await, "plan.json");
    let json = service.request(Method::POST, "/v1/jobs").json(&json!({"upload": "x"})).send().await.unwrap();
    assert_eq!(problem(json, 404).await, "not_found");
    let text =
        service.request(Method::POST, "/v1/jobs").header("content-type", "text/plain").body("x").send().await.unwrap();
    assert_eq!(problem(text, 415).await, "media_type");
    let cut = service.request(Method::POST, "/v1/jobs").header("content-type", "multipart/form-data; boundary=b");
    assert_eq!(problem(cut.body("--b\r\nContent-Disp").send().await.unwrap(), 400).await, "upload.broken");
    assert!(files(&service.data().join("store")).is_empty());
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_body_beyond_the_limit_is_refused() {
    let service = Service::with(|config| config.max_body = 1000).await;
    let form = |n| multipart::Form::new().part("input", multipart::Part::bytes(vec![0; n]).file_name("a.png"));
    let large = service.request(Method::POST, "/v1/jobs").multipart(form(5000)).send().await.unwrap();
    assert_eq!(problem(large, 413).await, "upload.too_large");
    let small = service.request(Method::POST, "/v1/jobs").multipart(form(500)).send().await.unwrap();
    assert_eq!(small.status(), StatusCode::ACCEPTED);
    service.stop().await;
}
