//! One TLS provider for everything that speaks TLS here: rustls with ring. And the certificate of our own listener.
//!
//! The certificate is read again when its files change or on SIGHUP, so that a renewal needs no restart; open connections
//! keep the one they began with. Files that do not make a whole pair are refused with a word in the log, and the old pair
//! stays.

use anyhow::{Context as _, ensure};
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use std::path::PathBuf;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Between looks at the files.
const LOOK: Duration = Duration::from_secs(10);

/// Makes ring the process's TLS provider. To be called before the first HTTP client is built; later calls do nothing.
pub fn provide() {
    // An error means that a provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}

/// Files of a certificate, PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tls {
    /// The certificate, followed by those that lead to its authority.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// When a file was changed last; `None` while it cannot be seen.
type Changed = [Option<SystemTime>; 2];

/// The certificate in use. New connections take the newest.
#[derive(Debug)]
pub(crate) struct Identity {
    files: Tls,
    now: RwLock<Arc<ServerConfig>>,
}

impl Identity {
    /// Reads the files.
    ///
    /// # Errors
    /// A file cannot be read, holds nothing of its kind, or the key does not belong to the certificate.
    pub(crate) fn read(files: &Tls) -> anyhow::Result<Self> {
        let now = RwLock::new(Arc::new(loaded(files)?));
        Ok(Self { files: files.clone(), now })
    }

    /// What a new connection is to use.
    pub(crate) fn now(&self) -> Arc<ServerConfig> {
        Arc::clone(&self.now.read().unwrap_or_else(PoisonError::into_inner))
    }

    fn renew(&self) {
        match loaded(&self.files) {
            Ok(config) => {
                *self.now.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
                tracing::info!(file = %self.files.cert.display(), "the certificate is read again");
            }
            Err(error) => tracing::error!(cause = %format!("{error:#}"), "the certificate stays the old one"),
        }
    }

    fn changed(&self) -> Changed {
        [&self.files.cert, &self.files.key].map(|file| std::fs::metadata(file).and_then(|m| m.modified()).ok())
    }

    /// Reads the files again when they change or on SIGHUP, until shutdown.
    pub(crate) async fn follow(self: Arc<Self>, shutdown: CancellationToken) {
        let mut hangup = match signal(SignalKind::hangup()) {
            Ok(hangup) => hangup,
            Err(error) => return tracing::warn!(%error, "no signal renews the certificate: restart after a renewal"),
        };
        let mut seen = self.changed();
        loop {
            tokio::select! {
                _ = hangup.recv() => {}
                () = tokio::time::sleep(LOOK) => if self.changed() == seen { continue },
                () = shutdown.cancelled() => return,
            }
            seen = self.changed();
            self.renew();
        }
    }
}

fn loaded(files: &Tls) -> anyhow::Result<ServerConfig> {
    let cannot = |file: &PathBuf| format!("cannot read {}", file.display());
    let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_file_iter(&files.cert)
        .with_context(|| cannot(&files.cert))?
        .collect::<Result<_, _>>()
        .with_context(|| cannot(&files.cert))?;
    ensure!(!chain.is_empty(), "{} holds no certificate", files.cert.display());
    let key = PrivateKeyDer::from_pem_file(&files.key).with_context(|| cannot(&files.key))?;
    let mut config = ServerConfig::builder()
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .with_context(|| format!("{} is not the key of {}", files.key.display(), files.cert.display()))?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(config)
}
