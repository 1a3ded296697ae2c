//! TLS in our own listener, with an authority that lives for this test: openssl makes it, curl and reqwest trust it alone.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::{Signal, getpid, kill_process};
use serde_json::json;
use service::{Auth, Server, Tls};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// An authority in a folder.
struct Authority(tempfile::TempDir);

fn openssl(folder: &Path, arguments: &str) {
    let run = Command::new("openssl").args(arguments.split(' ')).current_dir(folder).output().unwrap();
    assert!(run.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&run.stderr));
}

impl Authority {
    fn new() -> Self {
        let folder = tempfile::TempDir::new().unwrap();
        let of = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2";
        openssl(folder.path(), &format!("{of} -subj /CN=throw-away -keyout ca.key -out ca.pem"));
        std::fs::write(folder.path().join("ext"), "subjectAltName=IP:127.0.0.1,DNS:localhost\n").unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// A certificate of this serial number in server.pem and server.key.
    fn issue(&self, serial: u32) {
        let of = "req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=localhost";
        openssl(self.0.path(), &format!("{of} -keyout new.key -out new.csr"));
        let sign = format!("x509 -req -in new.csr -CA ca.pem -CAkey ca.key -set_serial {serial} -days 1 -extfile ext");
        openssl(self.0.path(), &format!("{sign} -out new.pem"));
        std::fs::rename(self.path("new.key"), self.path("server.key")).unwrap();
        std::fs::rename(self.path("new.pem"), self.path("server.pem")).unwrap();
    }

    fn files(&self) -> Tls {
        Tls { cert: self.path("server.pem"), key: self.path("server.key") }
    }

    fn curl(&self, arguments: &[&str]) -> (i32, String) {
        let run = Command::new("curl").args(["-sS", "--max-time", "10"]).args(arguments).output().unwrap();
        (run.status.code().unwrap(), String::from_utf8_lossy(&[run.stdout, run.stderr].concat()).into_owned())
    }

    /// Serial number of the certificate that the server shows.
    fn shown(&self, address: &str) -> String {
        let script = "openssl s_client -connect \"$1\" </dev/null 2>/dev/null | openssl x509 -noout -serial";
        let run = Command::new("sh").args(["-c", script, "sh", address]).output().unwrap();
        String::from_utf8(run.stdout).unwrap().trim().to_owned()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_listener_speaks_tls_and_follows_a_renewal() {
    let authority = Authority::new();
    authority.issue(1);
    let folder = tempfile::TempDir::new().unwrap();
    let mut config = support::config(folder.path());
    (config.auth, config.tls) = (Auth::Required, Some(authority.files()));
    let server = Server::start(config).await.unwrap();
    let (address, base) = (server.address().to_string(), format!("{}://{}", server.scheme(), server.address()));
    assert!(base.starts_with("https://"));
    let root = reqwest::Certificate::from_pem(&std::fs::read(authority.path("ca.pem")).unwrap()).unwrap();
    support::client();
    let client = reqwest::Client::builder().tls_certs_only([root]).build().unwrap();

    // A job over TLS, by reqwest.
    let key = server.first_key().unwrap().to_owned();
    let sent = support::upload(&client, &base, &json!({})).bearer_auth(&key).send().await.unwrap();
    assert_eq!(sent.status(), 202);
    let session = client.post(format!("{base}/v1/session")).json(&json!({"key": key})).send().await.unwrap();
    assert!(session.headers()["set-cookie"].to_str().unwrap().contains("; Secure"));
    assert!(session.headers().contains_key("strict-transport-security"));

    // By curl: with the authority over HTTP/2 and HTTP/1.1, without it not at all, plain not at all, TLS 1.1 not at all.
    let (ca, ready) = (authority.path("ca.pem").display().to_string(), format!("{base}/healthz"));
    for version in ["--http2", "--http1.1"] {
        let (code, said) = authority.curl(&["--cacert", &ca, version, "-w", " %{http_version}", &ready]);
        let wanted = if version == "--http2" { "ok\n 2" } else { "ok\n 1.1" };
        assert_eq!((code, said.as_str()), (0, wanted));
    }
    // 60: no authority that curl knows; 35: no version in common; 52 or 56: closed without an answer.
    assert_eq!(authority.curl(&[&ready]).0, 60);
    assert_eq!(authority.curl(&["--cacert", &ca, "--tlsv1.0", "--tls-max", "1.1", &ready]).0, 35);
    let (plain, said) = authority.curl(&[&ready.replace("https", "http")]);
    assert!(matches!(plain, 1 | 52 | 56), "{plain} {said}");

    // A renewal counts for new connections; files that do not belong together leave the old pair.
    assert_eq!(authority.shown(&address), "serial=01");
    authority.issue(2);
    kill_process(getpid(), Signal::HUP).unwrap();
    let begun = Instant::now();
    while authority.shown(&address) != "serial=02" {
        assert!(begun.elapsed() < Duration::from_secs(5), "the new certificate is never shown");
    }
    std::fs::copy(authority.path("ca.key"), authority.path("server.key")).unwrap();
    kill_process(getpid(), Signal::HUP).unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(authority.shown(&address), "serial=02");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pair_that_is_none_is_refused_at_start() {
    let authority = Authority::new();
    authority.issue(1);
    let start = async |tls: Tls| {
        let folder = tempfile::TempDir::new().unwrap();
        let mut config = support::config(folder.path());
        config.tls = Some(tls);
        format!("{:#}", Server::start(config).await.unwrap_err())
    };
    let Tls { cert, key } = authority.files();
    let foreign = start(Tls { cert: cert.clone(), key: authority.path("ca.key") }).await;
    assert!(foreign.contains("is not the key of"), "{foreign}");
    let missing = start(Tls { cert: authority.path("none"), key: key.clone() }).await;
    assert!(missing.contains("none"), "{missing}");
    let empty = start(Tls { cert: key.clone(), key }).await;
    assert!(empty.contains("holds no certificate"), "{empty}");
}
