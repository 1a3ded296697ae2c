//! Two tenants, every role, every operation of the document: who may do what, and nobody sees another's.
//!
//! The operations come from /openapi.json of the running service, the rule of each from the table below: a new operation
//! without a rule fails, and so does a rule without an operation.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use service::auth::Role;
use service::auth::keys::{self, NewKey};
use service::db::Db;
use service::{Auth, open_database};
use std::collections::BTreeMap;
use support::{Service, problem};

/// Who may call an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rule {
    /// Anybody, without a key: it shows nothing of a tenant.
    Open,
    /// Upload, read and admin.
    Read,
    /// Upload and admin.
    Change,
    /// Auditor and admin.
    Audit,
    /// Admin.
    Administer,
    /// Any key.
    Keyed,
}

const RULES: &[(&str, &str, Rule)] = &[
    ("GET", "/healthz", Rule::Open),
    ("GET", "/readyz", Rule::Open),
    ("GET", "/metrics", Rule::Open),
    ("GET", "/version", Rule::Open),
    ("POST", "/v1/session", Rule::Open),
    ("DELETE", "/v1/session", Rule::Open),
    ("GET", "/v1/session", Rule::Keyed),
    ("GET", "/v1/keys", Rule::Administer),
    ("POST", "/v1/keys", Rule::Administer),
    ("DELETE", "/v1/keys/{id}", Rule::Administer),
    ("GET", "/v1/tenant", Rule::Administer),
    ("PUT", "/v1/tenant", Rule::Administer),
    ("GET", "/v1/jobs/{id}/plan", Rule::Read),
    ("POST", "/v1/jobs/{id}/links", Rule::Change),
    ("POST", "/v1/jobs/{id}/plans", Rule::Change),
    ("POST", "/v1/jobs/{id}/priority", Rule::Change),
    ("GET", "/v1/stats", Rule::Read),
    ("GET", "/v1/cohort", Rule::Read),
    ("GET", "/v1/workers", Rule::Read),
    ("GET", "/v1/audit", Rule::Audit),
    ("GET", "/v1/jobs", Rule::Read),
    ("POST", "/v1/jobs", Rule::Change),
    ("POST", "/v1/jobs/cancel", Rule::Change),
    ("GET", "/v1/jobs/{id}", Rule::Read),
    ("GET", "/v1/jobs/{id}/events", Rule::Read),
    ("GET", "/v1/jobs/{id}/artefacts", Rule::Read),
    ("GET", "/v1/jobs/{id}/artefacts/{name}", Rule::Read),
    ("GET", "/v1/jobs/{id}/result", Rule::Read),
    ("POST", "/v1/jobs/{id}/cancel", Rule::Change),
    ("POST", "/v1/jobs/{id}/retry", Rule::Change),
    ("DELETE", "/v1/jobs/{id}", Rule::Change),
    ("OPTIONS", "/v1/uploads", Rule::Open),
    ("POST", "/v1/uploads", Rule::Change),
    ("HEAD", "/v1/uploads/{id}", Rule::Read),
    ("PATCH", "/v1/uploads/{id}", Rule::Change),
    ("DELETE", "/v1/uploads/{id}", Rule::Change),
    ("POST", "/dicomweb/studies", Rule::Change),
    ("POST", "/dicomweb/studies/{study}", Rule::Change),
    ("GET", "/v1/webhooks", Rule::Read),
    ("POST", "/v1/webhooks", Rule::Change),
    ("DELETE", "/v1/webhooks/{id}", Rule::Change),
];

const ROLES: [Role; 4] = [Role::Upload, Role::Read, Role::Admin, Role::Auditor];

fn may(rule: Rule, role: Role) -> bool {
    match rule {
        Rule::Open => true,
        Rule::Read => role != Role::Auditor,
        Rule::Change => matches!(role, Role::Upload | Role::Admin),
        Rule::Administer => role == Role::Admin,
        Rule::Keyed => true,
        Rule::Audit => matches!(role, Role::Auditor | Role::Admin),
    }
}

/// What one tenant owns, and its keys by role.
struct Ward {
    keys: BTreeMap<&'static str, String>,
    job: String,
    webhook: String,
    upload: String,
    /// Texts that nobody else may read.
    secrets: Vec<String>,
}

impl Ward {
    async fn new(service: &Service, db: &Db, tenant: &str) -> Self {
        let mut keys = BTreeMap::new();
        for role in ROLES {
            let new = NewKey { tenant: tenant.to_owned(), role, ..NewKey::default() };
            keys.insert(role.as_str(), keys::create(db, new).await.unwrap());
        }
        let admin = keys["admin"].clone();
        // A plan of its own gives the tenant's input and job texts of their own.
        let plan = json!({"do": "work", "note": tenant});
        let sent = service.upload(&plan).bearer_auth(&admin).header("idempotency-key", "same").send().await.unwrap();
        assert_eq!(sent.status(), StatusCode::ACCEPTED, "another tenant's idempotency key is another key");
        let job = support::json(sent).await["id"].as_str().unwrap().to_owned();
        let url = format!("https://127.0.0.1:9/{tenant}");
        let made = service.request(Method::POST, "/v1/webhooks").bearer_auth(&admin).json(&json!({"url": url}));
        let made = support::json(made.send().await.unwrap()).await;
        let webhook = made["id"].as_str().unwrap().to_owned();
        let ended = service.request(Method::GET, &format!("/v1/jobs/{job}?wait=15")).bearer_auth(&admin);
        assert_eq!(support::json(ended.send().await.unwrap()).await["state"], "succeeded");
        let begun = service.request(Method::POST, "/v1/uploads").bearer_auth(&admin).header("tus-resumable", "1.0.0");
        let begun = begun.header("upload-length", "5").send().await.unwrap();
        let upload = begun.headers()["location"].to_str().unwrap().rsplit('/').next().unwrap().to_owned();
        let secrets =
            vec![job.clone(), webhook.clone(), upload.clone(), url, made["secret"].as_str().unwrap().to_owned()];
        Self { keys, job, webhook, upload, secrets }
    }

    /// The path with this tenant's things in it.
    fn path(&self, template: &str) -> String {
        let id = match template {
            _ if template.starts_with("/v1/webhooks/") => &self.webhook,
            _ if template.starts_with("/v1/uploads/") => &self.upload,
            _ => &self.job,
        };
        template.replace("{id}", id).replace("{name}", "result.json").replace("{study}", "1.2.3")
    }
}

/// A call with the headers without which an upload is not looked at.
fn call(service: &Service, method: &Method, path: &str) -> RequestBuilder {
    let request = service.request(method.clone(), path);
    if !path.starts_with("/v1/uploads") {
        return request;
    }
    let request = request.header("tus-resumable", "1.0.0").header("upload-offset", "0");
    request.header("content-type", "application/offset+octet-stream")
}

async fn operations(service: &Service) -> Vec<(Method, String, Rule)> {
    let document = service.json("/openapi.json").await;
    let mut found = Vec::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for method in item.as_object().unwrap().keys().filter(|key| *key != "parameters") {
            let method: Method = method.to_uppercase().parse().unwrap();
            let rule = RULES.iter().find(|(verb, place, _)| *verb == method.as_str() && place == path);
            let rule = rule.unwrap_or_else(|| panic!("{method} {path} has no rule in this test: who may call it?"));
            let keyed = item[method.as_str().to_lowercase()].get("security").is_some();
            assert_eq!(
                keyed,
                rule.2 != Rule::Open,
                "{method} {path}: the document and the rule disagree about the key"
            );
            found.push((method, path.clone(), rule.2));
        }
    }
    assert_eq!(found.len(), RULES.len(), "a rule names an operation that there is not");
    found
}

fn assert_silent(text: &str, asked: &str, ward: &Ward, what: &str) {
    // What echoes the address that was asked for is no leak.
    let told = text.replace(&format!("\"instance\":\"{asked}\""), "");
    for secret in &ward.secrets {
        assert!(!told.contains(secret), "{what} tells another tenant's {secret}: {text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_operation_knows_its_roles_and_its_tenant() {
    let service = Service::with(|config| {
        config.auth = Auth::Required;
        config.webhook_hosts = vec!["127.0.0.1".to_owned()];
    })
    .await;
    let db = open_database(&support::config(service.folder.path())).await.unwrap();
    let (mine, theirs) = (Ward::new(&service, &db, "north").await, Ward::new(&service, &db, "south").await);
    let operations = operations(&service).await;
    for (method, template, rule) in &operations {
        let path = mine.path(template);
        let nobody = call(&service, method, &path).send().await.unwrap();
        if *method == Method::HEAD {
            assert_eq!(nobody.status(), StatusCode::UNAUTHORIZED, "{method} {template}");
        } else if *rule != Rule::Open {
            assert_eq!(problem(nobody, 401).await, "auth.missing", "{method} {template}");
        }
        for role in ROLES {
            let what = format!("{method} {template} as {}", role.as_str());
            let key = &theirs.keys[role.as_str()];
            let response = call(&service, method, &path).bearer_auth(key).send().await.unwrap();
            let status = response.status();
            let text = response.text().await.unwrap();
            assert_silent(&text, &path, &mine, &what);
            assert_eq!(status == StatusCode::FORBIDDEN, !may(*rule, role), "{what}: {status} {text}");
            if may(*rule, role) && template.contains("{id}") {
                assert_eq!(status, StatusCode::NOT_FOUND, "{what}: {text}");
            }
        }
    }
    // Another tenant's upload makes no job either.
    let stolen = service.request(Method::POST, "/v1/jobs").bearer_auth(&theirs.keys["admin"]);
    let stolen = stolen.json(&json!({"upload": mine.upload})).send().await.unwrap();
    assert_eq!(problem(stolen, 404).await, "not_found");
    its_own_is_there(&service, &mine, &operations).await;
    service.stop().await;
}

/// The owner still finds everything, may do what the role says, and only that.
async fn its_own_is_there(service: &Service, mine: &Ward, operations: &[(Method, String, Rule)]) {
    // Reading first: erasing comes last.
    let mut ordered: Vec<_> = operations.iter().collect();
    ordered.sort_by_key(|(method, _, _)| *method != Method::GET);
    ordered.sort_by_key(|(method, _, _)| *method == Method::DELETE);
    for (method, template, rule) in ordered {
        for role in [Role::Auditor, Role::Read, Role::Upload, Role::Admin] {
            let request = call(service, method, &mine.path(template)).bearer_auth(&mine.keys[role.as_str()]);
            let status = request.send().await.unwrap().status();
            let what = format!("{method} {template} as {}: {status}", role.as_str());
            assert_eq!(status == StatusCode::FORBIDDEN, !may(*rule, role), "{what}");
            if *method == Method::GET && may(*rule, role) {
                assert_eq!(status, StatusCode::OK, "{what}");
            }
        }
    }
    let gone: Value =
        support::json(service.request(Method::GET, "/v1/jobs").bearer_auth(&mine.keys["read"]).send().await.unwrap())
            .await;
    assert_eq!(gone["items"], json!([]), "DELETE erased the job");
}
