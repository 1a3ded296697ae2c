//! A job from an earlier one, checks of what was sent, order in the queue; keys and the tenant over HTTP.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use service::auth::Role;
use service::auth::keys::{self, NewKey};
use service::{Auth, Problem, open_database};
use support::{Service, json as body, problem};

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_is_reconstructed_again_with_another_plan_without_being_sent_again() {
    let service = Service::start().await;
    let first = service.submit(&json!({"note": "first"})).await;
    let done = service.ended(&first).await;
    let again = |wanted: Value| service.request(Method::POST, "/v1/jobs").json(&wanted).send();
    let second = body(again(json!({"job": first, "plan": {"note": "second"}})).await.unwrap()).await;
    let third = body(again(json!({"job": first})).await.unwrap()).await;
    for (job, note) in [(&second, "second"), (&third, "first")] {
        let id = job["id"].as_str().unwrap_or_else(|| panic!("{job}"));
        assert_eq!(service.ended(id).await["state"], "succeeded");
        assert_eq!(job["input"]["digest"], done["input"]["digest"]);
        assert_eq!(service.json(&format!("/v1/jobs/{id}/plan")).await["note"], note);
        let seen = |id: &str| format!("/v1/jobs/{id}/result");
        assert_eq!(service.json(&seen(id)).await["seen"], service.json(&seen(&first)).await["seen"]);
    }
    // Each has its scan: erasing the first takes nothing from the others.
    service.request(Method::DELETE, &format!("/v1/jobs/{first}")).send().await.unwrap();
    assert_eq!(problem(again(json!({"job": first})).await.unwrap(), 404).await, "not_found");
    let fourth = body(again(json!({"job": second["id"]})).await.unwrap()).await;
    assert_eq!(service.ended(fourth["id"].as_str().unwrap()).await["state"], "succeeded");
    let odd = again(json!({"job": second["id"], "plam": {}})).await.unwrap();
    assert_eq!(problem(odd, 422).await, "bad_request");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_variant_is_made_from_the_sections_of_a_finished_job() {
    let service = Service::start().await;
    let vary = |job: &str| {
        let wanted = json!({"job": job, "plan": {"variant": {"changes": []}}});
        service.request(Method::POST, "/v1/jobs").json(&wanted).send()
    };
    let without = service.submit(&json!({})).await;
    service.ended(&without).await;
    assert_eq!(problem(vary(&without).await.unwrap(), 409).await, "job.no_result");
    let first = service.submit(&json!({"sections": true})).await;
    assert_eq!(service.ended(&first).await["kind"], "reconstruction");
    let made = body(vary(&first).await.unwrap()).await;
    assert_eq!(made["kind"], "variant");
    let id = made["id"].as_str().unwrap();
    assert_eq!(service.ended(id).await["state"], "succeeded");
    assert_eq!(service.json(&format!("/v1/jobs/{id}/result")).await["files"], json!(["sections.json"]));
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn several_plans_are_taken_together_or_not_at_all() {
    let service = Service::with(|config| {
        config.check_plan = |plan| {
            let refused = Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "plan.invalid", "it is bad")
                .with_errors(vec![json!({"code": "plan.invalid", "message": "bad", "where": {"field": "note"}})]);
            if String::from_utf8_lossy(plan).contains("bad") { Err(refused) } else { Ok(()) }
        };
    })
    .await;
    let parent = service.submit(&json!({"sections": true})).await;
    service.ended(&parent).await;
    let address = format!("/v1/jobs/{parent}/plans");
    let send = |plans: Value, key: &str| {
        service.request(Method::POST, &address).header("idempotency-key", key).json(&json!({"plans": plans})).send()
    };
    let variant = |k: u64| json!({"variant": {"changes": []}, "note": k});
    let faulty =
        body(send(json!([variant(1), {"note": "bad"}, variant(2), {"note": "bad"}]), "a").await.unwrap()).await;
    let fields: Vec<&Value> = faulty["errors"].as_array().unwrap().iter().map(|e| &e["where"]["field"]).collect();
    assert_eq!(
        (&faulty["code"], fields),
        (&json!("plan.invalid"), vec![&json!("plans[1].note"), &json!("plans[3].note")])
    );
    for (plans, status, code) in [
        (json!([]), 422, "plans.number"),
        (json!(vec![variant(0); 101]), 413, "plans.number"),
        (json!({}), 422, "bad_request"),
    ] {
        assert_eq!(problem(send(plans, "a").await.unwrap(), status).await, code);
    }
    assert_eq!(
        service.json("/v1/jobs").await["items"].as_array().unwrap().len(),
        1,
        "nothing of all that was accepted"
    );
    let plans = || json!([variant(1), variant(2), {"note": "the scan again"}]);
    let first = send(plans(), "a").await.unwrap();
    assert_eq!(first.status(), StatusCode::ACCEPTED);
    let first = body(first).await;
    let ids = |told: &Value| -> Vec<String> {
        told["items"].as_array().unwrap().iter().map(|j| j["id"].as_str().unwrap().to_owned()).collect()
    };
    let again = send(plans(), "a").await.unwrap();
    assert_eq!((again.status(), &again.headers()["idempotency-replayed"]), (StatusCode::OK, &"true".parse().unwrap()));
    assert_eq!(ids(&body(again).await), ids(&first));
    assert_eq!(problem(send(json!([variant(1)]), "a").await.unwrap(), 422).await, "idempotency.mismatch");
    let kinds = ["variant", "variant", "reconstruction"];
    for (id, kind) in ids(&first).iter().zip(kinds) {
        let done = service.ended(id).await;
        assert_eq!(
            (&done["state"], &done["kind"], &done["parent"]),
            (&json!("succeeded"), &json!(kind), &json!(parent))
        );
    }
    let mine = service.json(&format!("/v1/jobs?parent={parent}&state=succeeded&limit=2")).await;
    assert_eq!(ids(&mine), [ids(&first)[2].clone(), ids(&first)[1].clone()]);
    assert!(mine["next"].as_str().unwrap().contains(&parent));
    let orphan = service.submit(&json!({})).await;
    service.ended(&orphan).await;
    let without =
        service.request(Method::POST, &format!("/v1/jobs/{orphan}/plans")).json(&json!({"plans": [{}, variant(1)]}));
    assert_eq!(problem(without.send().await.unwrap(), 409).await, "job.no_result");
    assert_eq!(service.json("/v1/jobs").await["items"].as_array().unwrap().len(), 5, "nor its first plan");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn several_plans_may_not_copy_more_than_one_call_may_bring() {
    let service = Service::with(|config| config.max_body = 40).await;
    let first = service.submit(&json!({})).await;
    service.ended(&first).await;
    let send = |count: usize| {
        let plans = json!({"plans": vec![json!({}); count]});
        service.request(Method::POST, &format!("/v1/jobs/{first}/plans")).json(&plans).send()
    };
    assert_eq!(send(3).await.unwrap().status(), StatusCode::ACCEPTED);
    let kept = support::files(&service.data().join("store")).len();
    assert_eq!(problem(send(4).await.unwrap(), 413).await, "plans.too_large");
    assert_eq!(support::files(&service.data().join("store")).len(), kept, "what was put for it is taken away");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_table_of_jobs_names_those_that_are_meant() {
    let service = Service::start().await;
    let first = service.submit(&json!({"sections": true})).await;
    service.ended(&first).await;
    let made =
        service.request(Method::POST, "/v1/jobs").json(&json!({"job": first, "plan": {"variant": {"changes": []}}}));
    let second = body(made.send().await.unwrap()).await["id"].as_str().unwrap().to_owned();
    service.ended(&second).await;
    let failed = service.submit(&json!({"do": "input"})).await;
    service.ended(&failed).await;
    let jobs = async |query: &str| -> Vec<String> {
        let told = service.json(&format!("/v1/cohort{query}")).await;
        told["results"]
            .as_array()
            .unwrap_or_else(|| panic!("{told}"))
            .iter()
            .map(|r| r["job"].as_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(jobs("").await, [second.clone(), first.clone()]);
    assert_eq!(jobs("?job_kind=variant").await, std::slice::from_ref(&second));
    assert_eq!(
        jobs(&format!("?id={first},{second}&quantity=deg,area_mm2&kind=angle&branch=1,2")).await,
        [first.clone(), second.clone()]
    );
    assert!(jobs("?created_after=2999-01-01T00:00:00Z").await.is_empty());
    assert_eq!(jobs("?created_before=2999-01-01T00:00:00Z&without_warnings=true&name=graft").await.len(), 2);
    let csv = service.request(Method::GET, "/v1/cohort").header("accept", "text/csv").send().await.unwrap();
    assert!(csv.headers()["content-type"].to_str().unwrap().starts_with("text/csv"));
    assert_eq!(csv.text().await.unwrap().lines().next(), Some("job"));
    let asked = |query: &str| service.request(Method::GET, &format!("/v1/cohort{query}")).send();
    assert_eq!(problem(asked(&format!("?id={failed}")).await.unwrap(), 404).await, "not_found");
    for odd in ["?quantity=width", "?id=1", "?branch=x", "?kind=", "?created_after=now", "?page=2"] {
        assert_eq!(problem(asked(odd).await.unwrap(), 400).await, "bad_request", "{odd}");
    }
    let picture = service.request(Method::GET, "/v1/cohort").header("accept", "image/png").send().await.unwrap();
    assert_eq!(problem(picture, 406).await, "not_acceptable");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancelled_jobs_scan_is_gone() {
    let service = Service::with(|config| config.workers = 0).await;
    let id = service.submit(&json!({})).await;
    service.request(Method::POST, &format!("/v1/jobs/{id}/cancel")).send().await.unwrap();
    let again = service.request(Method::POST, "/v1/jobs").json(&json!({"job": id})).send().await.unwrap();
    assert_eq!(problem(again, 409).await, "job.no_input");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_check_tells_what_the_reader_understood_or_why_not() {
    let service = Service::with(|config| {
        config.check_scan = |files, plan| {
            if plan.contains("refuse") {
                return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "stack.black", "every pixel is 0"));
            }
            Ok(json!({"files": files.len(), "plan": plan}))
        };
    })
    .await;
    let url = format!("{}/v1/jobs?validate=true", service.base);
    let send = |plan: Value| support::upload_to(&service.client, &url, &plan).send();
    let checked = body(send(json!({"a": 1})).await.unwrap()).await;
    assert_eq!(checked["understood"], json!({"files": 2, "plan": "{\"a\":1}"}));
    assert_eq!(problem(send(json!({"do": "refuse"})).await.unwrap(), 422).await, "stack.black");
    assert_eq!(service.json("/v1/jobs").await["items"], json!([]), "a check makes no job");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_waits_is_moved_before_an_older_one() {
    let service = Service::start().await;
    let running = service.submit(&json!({"seconds": 60})).await;
    service.until(&running, "running").await;
    let (older, newer) = (service.submit(&json!({"seconds": 60})).await, service.submit(&json!({"seconds": 60})).await);
    let moved =
        |id: &str, by: &str| service.request(Method::POST, &format!("/v1/jobs/{id}/priority?priority={by}")).send();
    let told = body(moved(&newer, "10").await.unwrap()).await;
    assert_eq!((&told["priority"], &told["state"]), (&json!(10), &json!("queued")));
    assert_eq!(problem(moved(&newer, "101").await.unwrap(), 400).await, "bad_request");
    assert_eq!(problem(moved(&running, "1").await.unwrap(), 409).await, "job.not_queued");
    service.request(Method::POST, &format!("/v1/jobs/{running}/cancel")).send().await.unwrap();
    service.until(&newer, "running").await;
    assert_eq!(service.json(&format!("/v1/jobs/{older}")).await["state"], "queued");
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_administrator_makes_and_revokes_keys_and_sets_retention() {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let db = open_database(&support::config(service.folder.path())).await.unwrap();
    let new = |tenant: &str| NewKey { tenant: tenant.to_owned(), role: Role::Admin, ..NewKey::default() };
    let (admin, other) =
        (keys::create(&db, new("north")).await.unwrap(), keys::create(&db, new("south")).await.unwrap());
    let call = |method: Method, path: &str, key: &str| service.request(method, path).bearer_auth(key);
    let made = call(Method::POST, "/v1/keys", &admin).json(&json!({"label": "clinic", "role": "read"}));
    let key = body(made.send().await.unwrap()).await["key"].as_str().unwrap().to_owned();
    let who = body(call(Method::GET, "/v1/session", &key).send().await.unwrap()).await;
    assert_eq!(who, json!({"keys": true, "tenant": "north", "role": "read"}));
    let list = body(call(Method::GET, "/v1/keys", &admin).send().await.unwrap()).await;
    let labels: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|k| &k["label"]).collect();
    assert_eq!(labels, [&json!("key"), &json!("clinic")], "its own tenant's only");
    assert!(!list.to_string().contains("vsk_"));
    let id = |i: usize| format!("/v1/keys/{}", list["items"][i]["id"].as_str().unwrap());
    assert_eq!(call(Method::DELETE, &id(1), &other).send().await.unwrap().status(), StatusCode::NOT_FOUND);
    assert_eq!(problem(call(Method::DELETE, &id(0), &admin).send().await.unwrap(), 409).await, "key.in_use");
    assert_eq!(call(Method::DELETE, &id(1), &admin).send().await.unwrap().status(), StatusCode::NO_CONTENT);
    assert_eq!(problem(call(Method::GET, "/v1/jobs", &key).send().await.unwrap(), 401).await, "auth.key");
    for odd in [json!({"label": "", "role": "read"}), json!({"label": "x", "role": "king"})] {
        let refused = call(Method::POST, "/v1/keys", &admin).json(&odd).send().await.unwrap();
        assert_eq!(problem(refused, 422).await, "bad_request");
    }
    let set = call(Method::PUT, "/v1/tenant", &admin).json(&json!({"retention_days": 1.5, "max_running": 2}));
    let wanted = json!({"id": "north", "max_running": 2, "retention_days": 1.5});
    assert_eq!(body(set.send().await.unwrap()).await, wanted);
    assert_eq!(body(call(Method::GET, "/v1/tenant", &admin).send().await.unwrap()).await, wanted);
    let odd = call(Method::PUT, "/v1/tenant", &admin).json(&json!({"retention_days": -1.0}));
    assert_eq!(problem(odd.send().await.unwrap(), 422).await, "bad_request");
    let job = body(service.upload(&json!({})).bearer_auth(&admin).send().await.unwrap()).await;
    assert_eq!(job["sent_by"], "key", "the label of the key that sent it");
    let path = format!("/v1/jobs/{}?wait=15", job["id"].as_str().unwrap());
    call(Method::GET, &path, &admin).send().await.unwrap();
    let kept = "SELECT expires_at - finished_at AS kept FROM job WHERE tenant = 'north'";
    let row = db.row(service::db::Scope::System, kept, Vec::new()).await.unwrap().unwrap();
    assert_eq!(row.get::<i64>("kept").unwrap(), 129_600_000);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_link_shows_one_job_for_its_time_and_no_longer_than_its_key() {
    let service = Service::with(|config| config.auth = Auth::Required).await;
    let db = open_database(&support::config(service.folder.path())).await.unwrap();
    let new = || NewKey { role: Role::Upload, ..NewKey::default() };
    let (key, other) = (keys::create(&db, new()).await.unwrap(), keys::create(&db, new()).await.unwrap());
    let send =
        async || body(service.upload(&json!({})).bearer_auth(&key).send().await.unwrap()).await["id"].to_string();
    let (shown, hidden) = (send().await.replace('"', ""), send().await.replace('"', ""));
    let call = |method: Method, path: &str, token: &str| service.request(method, path).bearer_auth(token).send();
    let made = |seconds: u32, key: String| {
        let path = format!("/v1/jobs/{shown}/links?seconds={seconds}");
        async move { body(call(Method::POST, &path, &key).await.unwrap()).await }
    };
    let link = made(60, key.clone()).await;
    let token = link["token"].as_str().unwrap().to_owned();
    assert_eq!(link["url"], format!("/embed#/jobs/{shown}?link={token}"));
    let path = format!("/v1/jobs/{shown}");
    let seen = call(Method::GET, &format!("{path}?wait=15"), &token).await.unwrap();
    assert_eq!(body(seen).await["state"], "succeeded");
    let file = call(Method::GET, &format!("{path}/artefacts/angles.csv"), &token).await.unwrap();
    assert_eq!(file.status(), StatusCode::OK);
    // Anything else, any change, any other job is refused; so is a token that was touched.
    let (head, mac) = token.rsplit_once('.').unwrap();
    let (id, expires) = head.rsplit_once('.').unwrap();
    let longer = format!("{id}.{}.{mac}", expires.parse::<u64>().unwrap() + 1);
    for (method, path, token) in [
        (Method::GET, format!("/v1/jobs/{hidden}"), token.clone()),
        (Method::GET, "/v1/jobs".to_owned(), token.clone()),
        (Method::GET, "/v1/stats".to_owned(), token.clone()),
        (Method::DELETE, path.clone(), token.clone()),
        (Method::POST, format!("{path}/links"), token.clone()),
        (Method::GET, path.clone(), longer),
        (Method::GET, path.clone(), format!("{head}.AAAA")),
        (Method::GET, path.clone(), "vsl_".to_owned()),
    ] {
        assert_eq!(problem(call(method, &path, &token).await.unwrap(), 401).await, "auth.link", "{path} {token}");
    }
    assert_eq!(
        problem(call(Method::POST, &format!("{path}/links?seconds=0"), &key).await.unwrap(), 400).await,
        "bad_request"
    );
    let brief = made(1, key.clone()).await["token"].as_str().unwrap().to_owned();
    tokio::time::sleep(std::time::Duration::from_millis(2100)).await;
    assert_eq!(problem(call(Method::GET, &path, &brief).await.unwrap(), 401).await, "auth.link");
    let theirs = made(60, other).await["token"].as_str().unwrap().to_owned();
    let maker = theirs.trim_start_matches("vsl_").split('.').next().unwrap();
    assert!(keys::revoke(&db, maker).await.unwrap());
    assert_eq!(problem(call(Method::GET, &path, &theirs).await.unwrap(), 401).await, "auth.link");
    assert_eq!(call(Method::GET, &path, &token).await.unwrap().status(), StatusCode::OK);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn only_named_pages_may_frame_a_result_and_none_the_portal() {
    let service = Service::with(|config| config.frame_ancestors = vec!["https://portal.example.org".to_owned()]).await;
    let policy = |path: &'static str| {
        let sent = service.get(path);
        async move { sent.await.headers()["content-security-policy"].to_str().unwrap().to_owned() }
    };
    assert!(policy("/embed").await.ends_with("frame-ancestors https://portal.example.org"));
    assert!(policy("/").await.ends_with("frame-ancestors 'none'"));
    service.stop().await;
}
