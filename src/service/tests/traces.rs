//! Traces reach a collector, here a small receiver of the test's own: a request, its job, the job's stages, in one trace.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use axum::Router;
use axum::routing::post;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use support::Service;

const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
const CALLER: &str = "00f067aa0ba902b7";

/// A collector: every span that it was sent.
async fn collector() -> (String, Arc<Mutex<Vec<Value>>>) {
    let spans = Arc::new(Mutex::new(Vec::new()));
    let kept = Arc::clone(&spans);
    let take = move |axum::Json(body): axum::Json<Value>| async move {
        let resource = &body["resourceSpans"][0];
        assert_eq!(resource["resource"]["attributes"][0]["value"]["stringValue"], "vasculum");
        let sent = resource["scopeSpans"][0]["spans"].as_array().unwrap().clone();
        kept.lock().unwrap().extend(sent);
        axum::Json(json!({}))
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(async move { axum::serve(listener, Router::new().route("/v1/traces", post(take))).await.unwrap() });
    (address, spans)
}

fn attribute(span: &Value, key: &str) -> String {
    let found = span["attributes"].as_array().unwrap().iter().find(|a| a["key"] == key);
    let value = &found.unwrap_or_else(|| panic!("{key} of {span}"))["value"];
    value["stringValue"].as_str().or(value["intValue"].as_str()).unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_its_job_and_the_stages_are_one_trace() {
    let (address, spans) = collector().await;
    let service = Service::with(|config| config.otlp_endpoint = Some(address)).await;
    let parent = |sampled: &str| format!("00-{TRACE}-{CALLER}-{sampled}");
    let sent = service.upload(&json!({})).header("traceparent", parent("01")).send().await.unwrap();
    let job = support::json(sent).await["id"].as_str().unwrap().to_owned();
    assert_eq!(service.ended(&job).await["state"], "succeeded");
    // What the caller does not trace is not traced here, and a problem names the trace all the same.
    let quiet = service.request(Method::GET, "/v1/jobs/none").header("traceparent", parent("00"));
    let quiet = quiet.send().await.unwrap();
    assert_eq!(quiet.status(), StatusCode::NOT_FOUND);
    assert_eq!(support::json(quiet).await["trace_id"], TRACE);

    let begun = Instant::now();
    let all = loop {
        let all: Vec<Value> = spans.lock().unwrap().iter().filter(|s| s["traceId"] == TRACE).cloned().collect();
        if all.iter().any(|span| span["name"] == "job") {
            break all;
        }
        assert!(begun.elapsed() < Duration::from_secs(5), "the job's span never comes");
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    let named = |name: &str| all.iter().find(|s| s["name"] == name).unwrap_or_else(|| panic!("{name} in {all:?}"));
    let request = named("POST /v1/jobs");
    assert_eq!((&request["parentSpanId"], &request["kind"]), (&json!(CALLER), &json!(2)));
    assert_eq!(attribute(request, "http.response.status_code"), "202");
    assert!(!all.iter().any(|s| s["name"] == "GET /v1/jobs/{id}"), "the unsampled call was traced");
    let run = named("job");
    assert_eq!((attribute(run, "vasculum.job"), attribute(run, "vasculum.state")), (job, "succeeded".to_owned()));
    let time = |span: &Value, key: &str| span[key].as_str().unwrap().parse::<u128>().unwrap();
    for stage in ["read", "contours", "surface", "done"] {
        let span = named(stage);
        assert_eq!(span["parentSpanId"], run["spanId"], "{stage}");
        assert!(time(span, "startTimeUnixNano") >= time(run, "startTimeUnixNano"), "{stage}");
        assert!(time(span, "endTimeUnixNano") <= time(run, "endTimeUnixNano"), "{stage}");
    }
    let mut ids: Vec<&str> = all.iter().map(|s| s["spanId"].as_str().unwrap()).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), all.len());
    assert!(ids.iter().all(|id| id.len() == 16));
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_collector_that_is_away_costs_nobody_anything() {
    let service = Service::with(|config| config.otlp_endpoint = Some("http://127.0.0.1:9".to_owned())).await;
    let begun = Instant::now();
    for _ in 0..200 {
        assert_eq!(service.get("/version").await.status(), StatusCode::OK);
    }
    let id = service.submit(&json!({})).await;
    assert_eq!(service.ended(&id).await["state"], "succeeded");
    service.stop().await;
    assert!(begun.elapsed() < Duration::from_secs(10));
}
