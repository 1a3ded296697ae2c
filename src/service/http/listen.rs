//! The listener: every connection is bounded in time and in the size of its headers.
//!
//! axum's own `serve` waits for a request's headers for ever, so a client that sends one byte a minute holds a connection
//! for as long as it likes (slow loris). Here headers must be whole within [`HEADERS`] and fit into [`HEADER_BYTES`]
//! (hyper answers 431), and a body must come at [`SLOWEST`] bytes a second or faster after its first [`PATIENCE`]
//! (`upload.broken`, 400). Answers are not bounded: an event stream may live as long as its job.

use crate::tls::Identity;
use axum::Router;
use axum::body::{Body, BodyDataStream};
use axum::extract::Request;
use axum::http::header;
use axum::middleware::Next;
use axum::response::Response;
use futures::StreamExt as _;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto::Builder;
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use hyper_util::service::TowerToHyperService;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Mutex, OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// A request's headers must be whole within this time.
const HEADERS: Duration = Duration::from_secs(10);
/// Most bytes of a request's headers (and the most that is read ahead).
const HEADER_BYTES: usize = 64 << 10;
/// How long a body may take whatever its size.
const PATIENCE: Duration = Duration::from_secs(30);
/// Beyond [`PATIENCE`], a body's bytes a second; a modem of 1998 is faster.
const SLOWEST: u64 = 1024;
/// Most connections at the same time; one more is closed at once, so that descriptors are left for files.
const CONNECTIONS: usize = 4096;
/// Most bytes of a refused body that are read and dropped, so that its sender hears the answer.
const DRAINED: usize = 16 << 20;
/// Longest time for that, and longest pause in it.
const DRAINING: Duration = Duration::from_secs(5);
const IDLE: Duration = Duration::from_millis(300);
/// After a failed accept (no descriptors left, say).
const PAUSE: Duration = Duration::from_millis(50);

/// Serves until shutdown, then lets open requests end.
pub(crate) async fn listen(
    listener: TcpListener,
    identity: Option<Arc<Identity>>,
    router: Router,
    shutdown: CancellationToken,
) {
    let room = Arc::new(Semaphore::new(CONNECTIONS));
    let graceful = GracefulShutdown::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = shutdown.cancelled() => break,
        };
        match accepted {
            Ok((stream, _)) => match Arc::clone(&room).try_acquire_owned() {
                Ok(permit) => {
                    let identity = identity.clone();
                    tokio::spawn(greeted(stream, identity, router.clone(), graceful.watcher(), permit));
                }
                Err(_) => tracing::warn!(most = CONNECTIONS, "a connection was closed: there are too many"),
            },
            Err(error) => {
                tracing::warn!(%error, "cannot accept a connection");
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
    drop(listener);
    graceful.shutdown().await;
}

/// A connection after its TLS handshake, where there is one: it must be done within [`HEADERS`] too.
async fn greeted(
    stream: TcpStream,
    identity: Option<Arc<Identity>>,
    router: Router,
    watcher: Watcher,
    permit: OwnedSemaphorePermit,
) {
    // Small answers go out at once; a socket that cannot do that still works.
    let _ = stream.set_nodelay(true);
    let Some(identity) = identity else { return connection(stream, router, watcher, permit).await };
    match tokio::time::timeout(HEADERS, TlsAcceptor::from(identity.now()).accept(stream)).await {
        Ok(Ok(stream)) => connection(stream, router, watcher, permit).await,
        Ok(Err(error)) => tracing::debug!(%error, "no TLS came about"),
        Err(_) => tracing::debug!("a TLS handshake took too long"),
    }
}

async fn connection(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    router: Router,
    watcher: Watcher,
    permit: OwnedSemaphorePermit,
) {
    let mut builder = Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(HEADERS).max_buf_size(HEADER_BYTES);
    builder.http2().timer(TokioTimer::new()).max_header_list_size(16 << 10).max_concurrent_streams(100);
    let served = builder.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router)).into_owned();
    if let Err(error) = watcher.watch(served).await {
        tracing::debug!(%error, "a connection ended early");
    }
    drop(permit);
}

/// Breaks off a body that does not come, and reads what a refusal left of one: a client that is still sending would see a
/// broken connection in place of the answer (a database that was away, a revoked key). It reads up to [`DRAINED`] bytes
/// for [`DRAINING`]; a client that asked first (Expect) has not begun to send.
pub(super) async fn paced(request: Request, next: Next) -> Response {
    let asked = request.headers().contains_key(header::EXPECT);
    let (parts, body) = request.into_parts();
    let rest = Arc::new(Mutex::new(body.into_data_stream()));
    let (start, shared) = (Instant::now(), Arc::clone(&rest));
    let paced = futures::stream::unfold((shared, 0_u64), move |(stream, mut seen)| async move {
        let until = start + PATIENCE + Duration::from_secs(seen / SLOWEST);
        let next = async { stream.lock().await.next().await };
        let part = match tokio::time::timeout_at(until, next).await {
            Ok(part) => part?,
            Err(_) => {
                Err(axum::Error::new(std::io::Error::new(std::io::ErrorKind::TimedOut, "the body came too slowly")))
            }
        };
        seen += part.as_ref().map_or(0, |bytes| bytes.len() as u64);
        Some((part, (stream, seen)))
    });
    let response = next.run(Request::from_parts(parts, Body::from_stream(paced))).await;
    if !asked && (response.status().is_client_error() || response.status().is_server_error()) {
        // Whoever is slower than this sees the broken connection.
        let _ = tokio::time::timeout(DRAINING, drained(&rest)).await;
    }
    response
}

async fn drained(rest: &Mutex<BodyDataStream>) {
    let mut rest = rest.lock().await;
    let mut left = DRAINED;
    // Who says a length and sends nothing is not waited for.
    while let Ok(Some(Ok(part))) = tokio::time::timeout(IDLE, rest.next()).await {
        left = left.saturating_sub(part.len());
        if left == 0 {
            return;
        }
    }
}
