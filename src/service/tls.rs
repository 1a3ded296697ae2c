//! One TLS provider for everything that speaks TLS here: rustls with ring.

/// Makes ring the process's TLS provider. To be called before the first HTTP client is built; later calls do nothing.
pub fn provide() {
    // An error means that a provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}
