//! Traces for a collector (OTLP over HTTP in its JSON form), where one is configured.
//!
//! A request is a span; a job is one in the trace of the request that sent it, days later if need be, with a span below it
//! for each stage of its process. Spans carry ids, routes, states and times, nothing of a patient. They wait in a bounded
//! queue and go out together; when the collector is away or slow they are dropped and counted in the log, because a
//! trace is worth less than a request. A caller whose `traceparent` is not sampled is not traced.
//!
//! Rejected: the opentelemetry crates (SDK, OTLP with protobuf, a bridge from `tracing`) for the JSON of one struct; and the
//! bridge would send every field that any crate ever attaches to a span.

use crate::queue::Claim;
use crate::store::hex;
use serde_json::{Value, json};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tokio_util::sync::CancellationToken;

/// Spans that may wait.
const WAITING: usize = 4096;
/// Spans in one call.
const TOGETHER: usize = 512;
/// How long spans gather.
const GATHER: Duration = Duration::from_secs(1);
/// Longest time of a call.
const PATIENCE: Duration = Duration::from_secs(5);
/// Kinds of OTLP.
const SERVER: u8 = 2;
const CONSUMER: u8 = 5;
const INTERNAL: u8 = 1;

/// What happened, from when to when.
#[derive(Clone, Debug)]
pub(crate) struct Span {
    trace: String,
    id: String,
    parent: String,
    name: String,
    kind: u8,
    begun: SystemTime,
    ended: SystemTime,
    failed: bool,
    attributes: Vec<(&'static str, Value)>,
}

/// Where spans go. Cheap to clone; without a collector it does nothing.
#[derive(Clone, Debug, Default)]
pub struct Traces(Option<Sender<Span>>);

/// The trace of a request as its caller gave it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Parent {
    /// 32 hex digits.
    pub(crate) trace: String,
    /// 16 hex digits: the caller's span; empty without one.
    pub(crate) span: String,
    /// Whether the caller traces this.
    pub(crate) sampled: bool,
}

impl Parent {
    /// Reads a W3C `traceparent`; `None` for anything else.
    pub(crate) fn of(header: &str) -> Option<Self> {
        let mut parts = header.split('-');
        let (_, trace, span, flags) = (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
        let id = |text: &str, digits: usize| {
            (text.len() == digits && text.bytes().all(|b| b.is_ascii_hexdigit()) && text.bytes().any(|b| b != b'0'))
                .then(|| text.to_ascii_lowercase())
        };
        let sampled = u8::from_str_radix(flags, 16).ok()? & 1 == 1;
        Some(Self { trace: id(trace, 32)?, span: id(span, 16)?, sampled })
    }
}

/// A random id of `N` bytes; zeros where there are no random bytes, which a collector drops.
pub(crate) fn random<const N: usize>() -> String {
    let mut bytes = [0_u8; N];
    let _ = getrandom::fill(&mut bytes);
    hex(&bytes)
}

impl Traces {
    /// Traces to a collector, and the task that carries them there; nothing without an endpoint.
    ///
    /// # Errors
    /// The endpoint is no address.
    pub(crate) fn new(
        endpoint: Option<&str>,
        shutdown: CancellationToken,
    ) -> anyhow::Result<(Self, Option<impl Future<Output = ()> + use<>>)> {
        let Some(endpoint) = endpoint else { return Ok((Self::default(), None)) };
        let url = reqwest::Url::parse(endpoint).map_err(|e| anyhow::anyhow!("--otlp-endpoint {endpoint}: {e}"))?;
        let path = format!("{}/v1/traces", url.as_str().trim_end_matches('/'));
        let client = reqwest::Client::builder().timeout(PATIENCE).build()?;
        let (sender, receiver) = channel(WAITING);
        Ok((Self(Some(sender)), Some(carry(receiver, client, path, shutdown))))
    }

    fn send(&self, span: Span) {
        if let Some(sender) = &self.0
            && sender.try_send(span).is_err()
        {
            metrics::counter!("vasculum_spans_dropped_total").increment(1);
        }
    }

    /// A request that has been answered.
    pub(crate) fn request(&self, parent: &Parent, begun: SystemTime, method: &str, route: &str, status: u16) {
        if self.0.is_none() || !parent.sampled {
            return;
        }
        self.send(Span {
            trace: parent.trace.clone(),
            id: random::<8>(),
            parent: parent.span.clone(),
            name: format!("{method} {route}"),
            kind: SERVER,
            begun,
            ended: SystemTime::now(),
            failed: status >= 500,
            attributes: vec![
                ("http.request.method", json!(method)),
                ("http.route", json!(route)),
                ("http.response.status_code", json!(status)),
            ],
        });
    }

    /// Begins the span of a job's attempt.
    pub(crate) fn job<'a>(&'a self, claim: &'a Claim) -> Course<'a> {
        Course { traces: self, claim, id: random::<8>(), begun: SystemTime::now(), stage: None }
    }
}

/// A job's attempt on its way through the stages.
#[derive(Debug)]
pub(crate) struct Course<'a> {
    traces: &'a Traces,
    claim: &'a Claim,
    id: String,
    begun: SystemTime,
    stage: Option<(String, SystemTime)>,
}

impl Course<'_> {
    /// Notes the stage that runs now.
    pub(crate) fn enters(&mut self, stage: &str) {
        if self.traces.0.is_some() && self.stage.as_ref().is_none_or(|(running, _)| running != stage) {
            self.leaves();
            self.stage = Some((stage.to_owned(), SystemTime::now()));
        }
    }

    fn leaves(&mut self) {
        if let Some((stage, begun)) = self.stage.take() {
            let (parent, attributes) = (self.id.clone(), vec![("vasculum.stage", json!(stage))]);
            let span = self.span(random::<8>(), parent, stage, INTERNAL, begun, false, attributes);
            self.traces.send(span);
        }
    }

    /// The attempt has ended in this state.
    pub(crate) fn ends(mut self, state: &str) {
        if self.traces.0.is_none() {
            return;
        }
        self.leaves();
        let attributes = vec![
            ("vasculum.job", json!(self.claim.id)),
            ("vasculum.attempt", json!(self.claim.attempt)),
            ("vasculum.state", json!(state)),
        ];
        let failed = state == "failed";
        let span =
            self.span(self.id.clone(), String::new(), "job".to_owned(), CONSUMER, self.begun, failed, attributes);
        self.traces.send(span);
    }

    #[allow(clippy::too_many_arguments, reason = "the fields of a span")]
    fn span(
        &self,
        id: String,
        parent: String,
        name: String,
        kind: u8,
        begun: SystemTime,
        failed: bool,
        attributes: Vec<(&'static str, Value)>,
    ) -> Span {
        let trace = self.claim.trace_id.clone();
        Span { trace, id, parent, name, kind, begun, ended: SystemTime::now(), failed, attributes }
    }
}

/// Carries spans to the collector until shutdown, and what is left after it.
async fn carry(mut receiver: Receiver<Span>, client: reqwest::Client, url: String, shutdown: CancellationToken) {
    let mut some = Vec::with_capacity(TOGETHER);
    let mut away = false;
    loop {
        let ending = tokio::select! {
            count = receiver.recv_many(&mut some, TOGETHER) => if count == 0 { return } else { false },
            () = shutdown.cancelled() => {
                receiver.close();
                true
            }
        };
        if !ending && some.len() < TOGETHER {
            tokio::select! {
                () = tokio::time::sleep(GATHER) => {}
                () = shutdown.cancelled() => {}
            }
        }
        while some.len() < TOGETHER
            && let Ok(span) = receiver.try_recv()
        {
            some.push(span);
        }
        if some.is_empty() {
            return;
        }
        let body = body(&some);
        let sent = client.post(&url).header("content-type", "application/json").body(body).send().await;
        let fault = match sent.map(|answer| answer.status()) {
            Ok(status) if status.is_success() => None,
            Ok(status) => Some(status.to_string()),
            Err(error) => Some(error.to_string()),
        };
        // Once when it goes and once when it comes: a collector that is away must not fill the log.
        match &fault {
            Some(cause) if !away => {
                tracing::warn!(%cause, spans = some.len(), "the collector takes no traces; they are dropped")
            }
            None if away => tracing::info!("the collector takes traces again"),
            _ => {}
        }
        away = fault.is_some();
        some.clear();
    }
}

/// `ExportTraceServiceRequest` in OTLP's JSON form: ids in hexadecimal, 64-bit numbers as text.
fn body(spans: &[Span]) -> String {
    let nanos = |at: SystemTime| at.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos().to_string();
    let each = |span: &Span| {
        json!({"traceId": span.trace, "spanId": span.id, "parentSpanId": span.parent, "name": span.name, "kind": span.kind,
            "startTimeUnixNano": nanos(span.begun), "endTimeUnixNano": nanos(span.ended),
            "attributes": span.attributes.iter().map(|(key, value)| attribute(key, value)).collect::<Vec<_>>(),
            // 2: error.
            "status": if span.failed { json!({"code": 2}) } else { json!({}) }})
    };
    let resource = [
        attribute("service.name", &json!("vasculum")),
        attribute("service.version", &json!(env!("CARGO_PKG_VERSION"))),
    ];
    json!({"resourceSpans": [{"resource": {"attributes": resource}, "scopeSpans": [{"scope": {"name": "vasculum"},
        "spans": spans.iter().map(each).collect::<Vec<_>>()}]}]})
    .to_string()
}

fn attribute(key: &str, value: &Value) -> Value {
    let told = match value {
        Value::String(text) => json!({"stringValue": text}),
        other => json!({"intValue": other.to_string()}),
    };
    json!({"key": key, "value": told})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_traceparent_is_read_strictly() {
        let (trace, span) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
        let read = Parent::of(&format!("00-{trace}-{span}-01")).unwrap();
        assert_eq!((read.trace.as_str(), read.span.as_str(), read.sampled), (trace, span, true));
        assert!(!Parent::of(&format!("00-{trace}-{span}-00")).unwrap().sampled);
        for bad in
            ["", "00", "00-<script>-x-01", &format!("00-{}-{span}-01", "0".repeat(32)), &format!("00-{trace}-{span}")]
        {
            assert_eq!(Parent::of(bad), None, "{bad}");
        }
    }
}
