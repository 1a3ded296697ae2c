//! Bearer tokens of an identity provider: signed here by ring, with keys that a server of the test's own publishes.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use axum::Router;
use axum::http::{StatusCode as Code, header};
use axum::response::IntoResponse as _;
use axum::routing::get;
use reqwest::{Method, Response, StatusCode};
use ring::rand::SystemRandom;
use ring::signature::{self, EcdsaKeyPair, Ed25519KeyPair, KeyPair as _, RsaKeyPair};
use serde_json::{Value, json};
use service::auth::keys::{self, NewKey};
use service::{Auth, Oidc, open_database};
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};
use support::{Service, problem};

const ISSUER: &str = "https://id.ward.example";
const AUDIENCE: &str = "vasculum";

fn url64(bytes: &[u8]) -> String {
    service::media::base64(bytes).replace('+', "-").replace('/', "_").replace('=', "")
}

fn now() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs()
}

/// The keys of a provider, one of each kind.
struct Signer {
    random: SystemRandom,
    rsa: RsaKeyPair,
    ec: EcdsaKeyPair,
    ed: Ed25519KeyPair,
}

impl Signer {
    fn new() -> Self {
        let random = SystemRandom::new();
        let made = Command::new("openssl").args(["genpkey", "-algorithm", "RSA", "-outform", "DER"]).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let kind = &signature::ECDSA_P256_SHA256_FIXED_SIGNING;
        let ec = EcdsaKeyPair::generate_pkcs8(kind, &random).unwrap();
        Self {
            // Versions of openssl differ in the form.
            rsa: RsaKeyPair::from_der(&made.stdout).or_else(|_| RsaKeyPair::from_pkcs8(&made.stdout)).unwrap(),
            ec: EcdsaKeyPair::from_pkcs8(kind, ec.as_ref(), &random).unwrap(),
            ed: Ed25519KeyPair::from_pkcs8(Ed25519KeyPair::generate_pkcs8(&random).unwrap().as_ref()).unwrap(),
            random,
        }
    }

    fn modulus(&self) -> Vec<u8> {
        signature::RsaPublicKeyComponents::<Vec<u8>>::from(self.rsa.public_key()).n
    }

    /// The public keys, named `rsa`, `ec` and `ed`, with one that nobody understands.
    fn set(&self) -> Value {
        let (x, y) = self.ec.public_key().as_ref()[1..].split_at(32);
        json!({"keys": [
            {"kty": "new", "kid": "odd", "z": 1},
            {"kty": "RSA", "kid": "rsa", "alg": "RS256", "use": "sig", "n": url64(&self.modulus()), "e": "AQAB"},
            {"kty": "EC", "kid": "ec", "crv": "P-256", "x": url64(x), "y": url64(y)},
            {"kty": "OKP", "kid": "ed", "crv": "Ed25519", "x": url64(self.ed.public_key().as_ref())},
            {"kty": "RSA", "kid": "enc", "use": "enc", "n": url64(&self.modulus()), "e": "AQAB"},
        ]})
    }

    fn sign(&self, algorithm: &str, text: &[u8]) -> Vec<u8> {
        match algorithm {
            "RS256" => {
                let mut signature = vec![0; self.rsa.public().modulus_len()];
                self.rsa.sign(&signature::RSA_PKCS1_SHA256, &self.random, text, &mut signature).unwrap();
                signature
            }
            "ES256" => self.ec.sign(&self.random, text).unwrap().as_ref().to_vec(),
            "EdDSA" => self.ed.sign(text).as_ref().to_vec(),
            "none" => Vec::new(),
            // The classic: the public key, which everybody has, as the secret of an HMAC.
            "HS256" => {
                let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, &self.modulus());
                ring::hmac::sign(&key, text).as_ref().to_vec()
            }
            other => panic!("{other}"),
        }
    }

    fn token(&self, algorithm: &str, kid: &str, claims: &Value) -> String {
        let header = json!({"typ": "JWT", "alg": algorithm, "kid": kid});
        let text = format!("{}.{}", url64(header.to_string().as_bytes()), url64(claims.to_string().as_bytes()));
        let signature = self.sign(algorithm, text.as_bytes());
        format!("{text}.{}", url64(&signature))
    }
}

fn claims(change: Value) -> Value {
    let mut claims = json!({"iss": ISSUER, "aud": ["other", AUDIENCE], "sub": "dr-7", "exp": now() + 300, "nbf": now() - 5,
        "ward": {"tenant": "north"}, "role": ["offline_access", "upload"]});
    for (name, value) in change.as_object().unwrap() {
        match value {
            Value::Null => claims.as_object_mut().unwrap().remove(name),
            value => claims.as_object_mut().unwrap().insert(name.clone(), value.clone()),
        };
    }
    claims
}

/// What the key server answers.
#[derive(Clone)]
enum Answer {
    Keys(Value),
    Redirect(String),
    Huge,
    Broken,
}

/// A key server of the test's own.
struct KeyServer {
    url: String,
    answer: Arc<Mutex<Answer>>,
    asked: Arc<AtomicUsize>,
}

impl KeyServer {
    async fn new(answer: Answer) -> Self {
        let (answer, asked) = (Arc::new(Mutex::new(answer)), Arc::new(AtomicUsize::new(0)));
        let (said, counted) = (Arc::clone(&answer), Arc::clone(&asked));
        let keys = move || async move {
            counted.fetch_add(1, Ordering::SeqCst);
            match said.lock().unwrap().clone() {
                Answer::Keys(set) => axum::Json(set).into_response(),
                Answer::Redirect(to) => (Code::FOUND, [(header::LOCATION, to)]).into_response(),
                Answer::Huge => vec![b' '; 1 << 20].into_response(),
                Answer::Broken => Code::INTERNAL_SERVER_ERROR.into_response(),
            }
        };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/keys", listener.local_addr().unwrap());
        tokio::spawn(async move { axum::serve(listener, Router::new().route("/keys", get(keys))).await.unwrap() });
        Self { url, answer, asked }
    }

    fn asked(&self) -> usize {
        self.asked.load(Ordering::SeqCst)
    }

    async fn service(&self, refresh_seconds: u64) -> Service {
        let jwks_url = self.url.clone();
        let service = Service::with(|config| {
            config.auth = Auth::Required;
            config.oidc = Some(Oidc {
                issuer: ISSUER.to_owned(),
                audience: AUDIENCE.to_owned(),
                tenant_claim: "ward.tenant".to_owned(),
                jwks_url,
                refresh_seconds,
                ..Oidc::default()
            });
        })
        .await;
        let db = open_database(&support::config(service.folder.path())).await.unwrap();
        keys::create(&db, NewKey { tenant: "north".to_owned(), ..NewKey::default() }).await.unwrap();
        db.close().await;
        service
    }
}

async fn jobs(service: &Service, token: &str) -> Response {
    service.request(Method::GET, "/v1/jobs").bearer_auth(token).send().await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_opens_what_its_claims_say() {
    let signer = Signer::new();
    let server = KeyServer::new(Answer::Keys(signer.set())).await;
    let service = server.service(60).await;
    for (algorithm, kid) in [("RS256", "rsa"), ("ES256", "ec"), ("EdDSA", "ed")] {
        let token = signer.token(algorithm, kid, &claims(json!({})));
        assert_eq!(jobs(&service, &token).await.status(), StatusCode::OK, "{algorithm}");
    }
    let upload = signer.token("ES256", "ec", &claims(json!({})));
    let sent = service.upload(&json!({})).bearer_auth(&upload).send().await.unwrap();
    assert_eq!(sent.status(), StatusCode::ACCEPTED);
    let id = support::json(sent).await["id"].as_str().unwrap().to_owned();
    // Another tenant's key does not see the job; a reader of the same tenant does, and may not end it.
    let admin = service.server.as_ref().unwrap().first_key().unwrap().to_owned();
    let path = format!("/v1/jobs/{id}");
    let other = service.request(Method::GET, &path).bearer_auth(&admin).send().await.unwrap();
    assert_eq!(problem(other, 404).await, "not_found");
    let read = signer.token("RS256", "rsa", &claims(json!({"role": "read", "aud": AUDIENCE})));
    assert_eq!(service.request(Method::GET, &path).bearer_auth(&read).send().await.unwrap().status(), StatusCode::OK);
    let end = service.request(Method::DELETE, &path).bearer_auth(&read).send().await.unwrap();
    assert_eq!(problem(end, 403).await, "auth.role");
    // The portal's cookie takes a token as it takes a key; the audit names the subject.
    let session = service.request(Method::POST, "/v1/session").json(&json!({"key": upload})).send().await.unwrap();
    assert_eq!(session.status(), StatusCode::NO_CONTENT);
    let auditor = signer.token("EdDSA", "ed", &claims(json!({"role": "auditor"})));
    let audit = service.request(Method::GET, "/v1/audit").bearer_auth(&auditor).send().await.unwrap();
    assert!(audit.text().await.unwrap().contains("\"oidc:dr-7\""));
    // Keys go on counting beside tokens, and one fetch was enough for all of this.
    assert_eq!(jobs(&service, &admin).await.status(), StatusCode::OK);
    assert_eq!(server.asked(), 1);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_token_that_does_not_count_opens_nothing() {
    let signer = Signer::new();
    let stranger = Signer::new();
    let server = KeyServer::new(Answer::Keys(signer.set())).await;
    let service = server.service(60).await;
    let good = claims(json!({}));
    let refused: &[(&str, String)] = &[
        ("alg none", signer.token("none", "rsa", &good)),
        ("HS256 with the public key", signer.token("HS256", "rsa", &good)),
        ("wrong aud", signer.token("RS256", "rsa", &claims(json!({"aud": "other"})))),
        ("no aud", signer.token("RS256", "rsa", &claims(json!({"aud": null})))),
        ("wrong iss", signer.token("RS256", "rsa", &claims(json!({"iss": "https://id.ward.example.evil"})))),
        ("no iss", signer.token("RS256", "rsa", &claims(json!({"iss": null})))),
        ("expired", signer.token("ES256", "ec", &claims(json!({"exp": now() - 60})))),
        ("no exp", signer.token("ES256", "ec", &claims(json!({"exp": null})))),
        ("not yet", signer.token("ES256", "ec", &claims(json!({"nbf": now() + 120})))),
        ("no sub", signer.token("ES256", "ec", &claims(json!({"sub": null})))),
        ("wrong kid", signer.token("RS256", "gone", &good)),
        ("a key of another kind", signer.token("RS256", "ec", &good)),
        ("a key for another use", signer.token("RS256", "enc", &good)),
        ("a stranger's signature", stranger.token("RS256", "rsa", &good)),
        ("no signature", signer.token("EdDSA", "ed", &good).rsplit_once('.').unwrap().0.to_owned() + "."),
        ("nonsense", "x.y.z".to_owned()),
        ("empty", "a".repeat(20_000)),
    ];
    for (what, token) in refused {
        let answer = jobs(&service, token).await;
        assert!(answer.headers()["www-authenticate"].to_str().unwrap().contains("invalid_token"), "{what}");
        assert_eq!(problem(answer, 401).await, "auth.token", "{what}");
    }
    let mut parts: Vec<String> = signer.token("RS256", "rsa", &good).split('.').map(str::to_owned).collect();
    parts[1] = url64(claims(json!({"role": "admin"})).to_string().as_bytes());
    assert_eq!(problem(jobs(&service, &parts.join(".")).await, 401).await, "auth.token");
    for (change, code) in [
        (json!({"ward": {"tenant": "south"}}), "auth.tenant"),
        (json!({"ward": null}), "auth.tenant"),
        (json!({"ward": {"tenant": ["north"]}}), "auth.tenant"),
        (json!({"role": "root"}), "auth.role"),
        (json!({"role": null}), "auth.role"),
    ] {
        let answer = jobs(&service, &signer.token("RS256", "rsa", &claims(change.clone()))).await;
        assert_eq!(problem(answer, 403).await, code, "{change}");
    }
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_are_fetched_seldom_and_follow_a_rotation() {
    let (old, new) = (Signer::new(), Signer::new());
    let server = KeyServer::new(Answer::Keys(old.set())).await;
    let service = server.service(1).await;
    let good = claims(json!({}));
    assert_eq!(jobs(&service, &old.token("ES256", "ec", &good)).await.status(), StatusCode::OK);
    // A storm of invented names asks the provider nothing while the set is young, and once when it may.
    let storm = |round: u32| {
        let (service, old, good) = (&service, &old, &good);
        async move {
            let names: Vec<String> = (0..20).map(|n| old.token("ES256", &format!("x{round}-{n}"), good)).collect();
            let answers = futures::future::join_all(names.iter().map(|token| jobs(service, token))).await;
            for answer in answers {
                assert_eq!(answer.status(), StatusCode::UNAUTHORIZED);
            }
        }
    };
    storm(0).await;
    assert_eq!(server.asked(), 1);
    tokio::time::sleep(Duration::from_millis(1100)).await;
    storm(1).await;
    assert_eq!(server.asked(), 2);
    // The provider's new key counts after the pause.
    let mut set = old.set();
    let mut fresh = new.set()["keys"][2].clone();
    fresh["kid"] = json!("ec-2");
    set["keys"].as_array_mut().unwrap().push(fresh);
    *server.answer.lock().unwrap() = Answer::Keys(set);
    let token = new.token("ES256", "ec-2", &good);
    assert_eq!(jobs(&service, &token).await.status(), StatusCode::UNAUTHORIZED);
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert_eq!(jobs(&service, &token).await.status(), StatusCode::OK);
    // A provider in trouble costs nobody with a known key anything.
    *server.answer.lock().unwrap() = Answer::Broken;
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert_eq!(jobs(&service, &old.token("ES256", "unknown", &good)).await.status(), StatusCode::UNAUTHORIZED);
    assert_eq!(jobs(&service, &token).await.status(), StatusCode::OK);
    service.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_come_from_the_configured_place_alone_and_in_a_bounded_size() {
    let signer = Signer::new();
    let token = signer.token("ES256", "ec", &claims(json!({})));
    let elsewhere = KeyServer::new(Answer::Keys(signer.set())).await;
    for answer in
        [Answer::Redirect(elsewhere.url.clone()), Answer::Huge, Answer::Broken, Answer::Keys(json!({"keys": []}))]
    {
        let server = KeyServer::new(answer).await;
        let service = server.service(60).await;
        let away = jobs(&service, &token).await;
        assert!(away.headers().contains_key("retry-after"));
        assert_eq!(problem(away, 503).await, "auth.provider");
        service.stop().await;
    }
    assert_eq!(elsewhere.asked(), 0, "a redirect was followed");
}
