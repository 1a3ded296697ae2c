//! Keys, roles, tenants and the audit over HTTP.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, StatusCode};
use serde_json::json;
use service::audit::{self, Verdict};
use service::auth::Role;
use service::auth::keys::{self, NewKey};
use service::db::{Db, Scope};
use service::{Auth, open_database};
use support::{Service, problem};

async fn key(db: &Db, tenant: &str, role: Role) -> String {
    keys::create(db, NewKey { tenant: tenant.to_owned(), role, ..NewKey::default() }).await.unwrap()
}

async fn with_keys() -> (Service, Db) {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let db = open_database(&support::config(service.folder.path())).await.unwrap();
    (service, db)
}

#[tokio::test(flavor = "multi_thread")]
async fn roles_do_what_they_may_and_no_more() {
    let (service, db) = with_keys().await;
    for (role, read, change, audited) in [
        (Role::Upload, 200, 202, 403),
        (Role::Read, 200, 403, 403),
        (Role::Admin, 200, 202, 200),
        (Role::Auditor, 403, 403, 200),
    ] {
        let key = key(&db, "default", role).await;
        let status = |method: Method, path: &'static str| {
            let request = service.request(method, path).bearer_auth(&key);
            async move { request.send().await.unwrap().status().as_u16() }
        };
        assert_eq!(status(Method::GET, "/v1/jobs").await, read, "{role:?}");
        assert_eq!(status(Method::GET, "/v1/audit").await, audited, "{role:?}");
        let sent = service.upload(&json!({})).bearer_auth(&key).send().await.unwrap();
        assert_eq!(sent.status().as_u16(), change, "{role:?}");
    }
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_revoked_key_is_refused_at_once_and_a_bounded_one_in_time() {
    let (service, db) = with_keys().await;
    let made = key(&db, "default", Role::Read).await;
    let ask = |key: String| service.request(Method::GET, "/v1/jobs").bearer_auth(key).send();
    assert_eq!(ask(made.clone()).await.unwrap().status(), StatusCode::OK);
    let row = keys::list(&db).await.unwrap().pop().unwrap();
    assert!(keys::revoke(&db, &row.id).await.unwrap());
    assert!(!keys::revoke(&db, &row.id).await.unwrap());
    assert_eq!(problem(ask(made).await.unwrap(), 401).await, "auth.key");
    let bounded = NewKey { requests_per_minute: Some(2), max_bytes: Some(1000), ..NewKey::default() };
    let bounded = keys::create(&db, bounded).await.unwrap();
    for _ in 0..2 {
        assert_eq!(ask(bounded.clone()).await.unwrap().status(), StatusCode::OK);
    }
    let refused = ask(bounded).await.unwrap();
    assert!(refused.headers().contains_key("retry-after"));
    assert_eq!(problem(refused, 429).await, "auth.rate");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_audit_tells_who_did_what_and_shows_tampering() {
    let (service, db) = with_keys().await;
    let admin = key(&db, "default", Role::Admin).await;
    let job = support::json(service.upload(&json!({})).bearer_auth(&admin).send().await.unwrap()).await;
    let path = format!("/v1/jobs/{}", job["id"].as_str().unwrap());
    let call = |method: Method, path: String| service.request(method, &path).bearer_auth(&admin).send();
    call(Method::GET, format!("{path}?wait=15")).await.unwrap();
    call(Method::GET, format!("{path}/artefacts/angles.csv")).await.unwrap();
    assert_eq!(call(Method::DELETE, path.clone()).await.unwrap().status(), StatusCode::NO_CONTENT);
    let page = support::json(call(Method::GET, "/v1/audit".to_owned()).await.unwrap()).await;
    let actions: Vec<_> = page["items"].as_array().unwrap().iter().map(|e| e["subtype"][0]["code"].clone()).collect();
    assert_eq!(actions, ["key.create", "job.create", "artefact.read", "job.erase"].map(serde_json::Value::from));
    assert_eq!(page["items"][1]["resourceType"], "AuditEvent");
    let Verdict::Whole { lines } = audit::verify(&db).await.unwrap() else { panic!("broken") };
    assert_eq!(lines, 4);
    // The table itself refuses a change; whoever goes round it is found out.
    let change = "UPDATE audit SET actor = 'nobody' WHERE seq = 3";
    assert!(db.run(Scope::System, change, Vec::new()).await.is_err());
    db.run(Scope::System, "DROP TRIGGER audit_is_append_only_update", Vec::new()).await.unwrap();
    db.run(Scope::System, change, Vec::new()).await.unwrap();
    assert_eq!(audit::verify(&db).await.unwrap(), Verdict::Broken { line: 3 });
    db.run(Scope::System, "DROP TRIGGER audit_is_append_only_delete", Vec::new()).await.unwrap();
    db.run(Scope::System, "DELETE FROM audit WHERE seq >= 3", Vec::new()).await.unwrap();
    assert_eq!(audit::verify(&db).await.unwrap(), Verdict::Broken { line: 3 });
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn checks_bulk_cancels_and_the_roll() {
    let service = Service::start().await;
    let checked = support::upload_to(&service.client, &format!("{}/v1/jobs?validate=true", service.base), &json!({}));
    let checked = support::json(checked.send().await.unwrap()).await;
    assert_eq!((&checked["valid"], &checked["input"]["files"]), (&json!(true), &json!(2)));
    assert!(service.json("/v1/jobs").await["items"].as_array().unwrap().is_empty());
    let running = service.submit(&json!({"seconds": 60})).await;
    service.until(&running, "running").await;
    for _ in 0..2 {
        service.submit(&json!({"seconds": 60})).await;
    }
    let old = "/v1/jobs/cancel?created_before=2020-01-01T00:00:00Z";
    let none = service.request(Method::POST, old).send().await.unwrap();
    assert_eq!(support::json(none).await["cancelled"], 0);
    let odd = service.request(Method::POST, "/v1/jobs/cancel?created_before=yesterday").send().await.unwrap();
    assert_eq!(problem(odd, 400).await, "bad_request");
    let all = service.request(Method::POST, "/v1/jobs/cancel").send().await.unwrap();
    assert_eq!(support::json(all).await["cancelled"], 3);
    assert_eq!(service.ended(&running).await["state"], "cancelled");
    support::nothing_left(&service.data()).await;
    let workers = service.json("/v1/workers").await;
    assert_eq!((workers["items"].as_array().unwrap().len(), &workers["items"][0]["slots"]), (1, &json!(1)));
    let high = support::upload_to(&service.client, &format!("{}/v1/jobs?priority=101", service.base), &json!({}));
    assert_eq!(problem(high.send().await.unwrap(), 400).await, "bad_request");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_artefact_breaks_off_instead_of_arriving_whole() {
    let service = Service::start().await;
    let id = service.submit(&json!({})).await;
    service.ended(&id).await;
    let path = format!("/v1/jobs/{id}/artefacts/surface.glb");
    assert_eq!(service.get(&path).await.bytes().await.unwrap().len(), 104);
    let file = support::files(&service.data()).into_iter().find(|f| f.ends_with("surface.glb")).unwrap();
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[50] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let whole = match service.request(Method::GET, &path).send().await {
        Ok(response) => response.bytes().await.is_ok(),
        Err(_) => false,
    };
    assert!(!whole, "a damaged file arrived whole");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_allocation_without_end_ends_the_job_and_not_the_worker() {
    let service = Service::with(|config| config.memory_mb = 300).await;
    let id = service.submit(&json!({"do": "allocate"})).await;
    let job = service.ended(&id).await;
    assert_eq!((&job["state"], &job["attempt"]), (&json!("failed"), &json!(3)));
    assert_eq!(job["error"]["code"], "job.memory");
    let next = service.submit(&json!({})).await;
    assert_eq!(service.ended(&next).await["state"], "succeeded");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_webhook_is_told_until_it_has_heard() {
    use axum::http::HeaderMap;
    let (heard, mut messages) = tokio::sync::mpsc::unbounded_channel::<(HeaderMap, String)>();
    let calls = std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(0));
    let receiver = axum::Router::new().route(
        "/hook",
        axum::routing::post(move |headers: HeaderMap, body: String| {
            // The first attempt fails.
            let first = calls.fetch_add(1, std::sync::atomic::Ordering::SeqCst) == 0;
            heard.send((headers, body)).unwrap();
            async move { if first { StatusCode::INTERNAL_SERVER_ERROR } else { StatusCode::NO_CONTENT } }
        }),
    );
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://127.0.0.1:{}/hook", listener.local_addr().unwrap().port());
    tokio::spawn(async move { axum::serve(listener, receiver).await });
    let service = Service::with(|config| config.webhook_hosts = vec!["127.0.0.1".to_owned()]).await;
    let add = |url: &str| service.request(Method::POST, "/v1/webhooks").json(&json!({"url": url})).send();
    assert_eq!(problem(add("https://localhost/").await.unwrap(), 422).await, "webhook.url");
    let made = support::json(add(&url).await.unwrap()).await;
    let secret = made["secret"].as_str().unwrap();
    let listed = service.json("/v1/webhooks").await;
    assert_eq!((&listed["items"][0]["url"], listed["items"][0].get("secret")), (&json!(url), None));
    let id = service.submit(&json!({})).await;
    service.ended(&id).await;
    let mut seen = Vec::new();
    for _ in 0..2 {
        let message = tokio::time::timeout(std::time::Duration::from_secs(12), messages.recv()).await.unwrap();
        seen.push(message.unwrap());
    }
    assert_eq!(seen[0].1, seen[1].1, "the second attempt tells the same");
    let (headers, body) = &seen[1];
    let text = |name: &str| headers[name].to_str().unwrap();
    assert_eq!(text("webhook-id"), seen[0].0["webhook-id"].to_str().unwrap());
    let stamp: u64 = text("webhook-timestamp").parse().unwrap();
    let signed = service::webhooks::signature(secret, text("webhook-id"), stamp, body).unwrap();
    assert_eq!(text("webhook-signature"), signed);
    let body: serde_json::Value = serde_json::from_str(body).unwrap();
    assert_eq!((&body["type"], &body["data"]["id"]), (&json!("job.succeeded"), &json!(id)));
    let path = format!("/v1/webhooks/{}", made["id"].as_str().unwrap());
    assert_eq!(service.request(Method::DELETE, &path).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(problem(service.request(Method::DELETE, &path).send().await.unwrap(), 404).await, "not_found");
    service.stop().await;
}
