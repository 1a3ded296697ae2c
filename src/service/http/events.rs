//! Events of a job: a stream (SSE) that can be resumed, or a list.

use super::jobs::{changed, job_of};
use super::shapes::{EventList, EventShape};
use crate::auth::Principal;
use crate::error::Problem;
use crate::queue::EventRow;
use crate::state::State;
use axum::Json;
use axum::extract::{Path, Query, State as Shared};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse as _, Response};
use futures::Stream;
use serde::Deserialize;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;
use tokio::sync::broadcast;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use uuid::Uuid;

/// Comment lines that keep proxies from closing the stream.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Between looks at the table, for changes of other processes.
const POLL: Duration = Duration::from_secs(1);
/// Events read at once.
const BATCH: i64 = 500;

/// Routes of this resource.
pub(super) fn router() -> OpenApiRouter<State> {
    OpenApiRouter::new().routes(routes!(events))
}

/// Where to begin.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
struct After {
    /// Only events after this id (as Last-Event-ID).
    after: Option<i64>,
}

/// One event of the stream, as the fields of its block.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the stream in the OpenAPI document")]
struct StreamedEvent {
    /// Number of the event; send it as Last-Event-ID to resume after it.
    id: String,
    /// `progress`, `stage` or `state`.
    event: String,
    /// EventData as JSON text.
    data: String,
}

/// Follows a job: `event: progress|stage|state`. The stream ends with the job; `Accept: application/json` gives a list.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", operation_id = "follow_job", tag = "jobs", security(("key" = [])),
    params(("id" = Uuid, Path, description = "Job"), After,
        ("Last-Event-ID" = Option<i64>, Header, description = "Resume after this event")),
    responses(
        (status = 200, description = "Events", content(
            (StreamedEvent = "text/event-stream"),
            (EventList = "application/json")
        )),
        (status = 400, description = "An id of an event that cannot be one", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")
    ))]
async fn events(
    Shared(state): Shared<State>,
    who: Principal,
    Path(id): Path<String>,
    Query(after): Query<After>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (id, _) = job_of(&state, &who, &id).await?;
    let text = |name: &str| headers.get(name).and_then(|v| v.to_str().ok());
    let resumed = match headers.get("last-event-id") {
        None => None,
        Some(value) => Some(value.to_str().ok().and_then(|v| v.trim().parse().ok()).ok_or_else(|| {
            Problem::new(
                StatusCode::BAD_REQUEST,
                "bad_request",
                "Last-Event-ID must be the id of an event of this job.",
            )
        })?),
    };
    let after = resumed.or(after.after).unwrap_or(0);
    let accept = text(header::ACCEPT.as_str()).unwrap_or("");
    if accept.contains("application/json") && !accept.contains("text/event-stream") {
        return Ok(Json(listed(&state, id, after).await?).into_response());
    }
    let keep_alive = KeepAlive::new().interval(KEEP_ALIVE);
    let stream = Follower { changes: state.queue.changes(), state, id, after, ready: VecDeque::new(), ended: false };
    // Buffering proxies would hold the stream back.
    Ok(([("x-accel-buffering", "no")], Sse::new(stream.stream()).keep_alive(keep_alive)).into_response())
}

async fn listed(state: &State, id: Uuid, after: i64) -> Result<EventList, Problem> {
    let rows = state.queue.events(id, after, BATCH).await?;
    let full = i64::try_from(rows.len()).unwrap_or(i64::MAX) == BATCH;
    let next = rows.last().filter(|_| full).map(|last| format!("/v1/jobs/{id}/events?after={}", last.id));
    Ok(EventList { items: rows.into_iter().map(EventShape::from).collect(), next })
}

/// Follows the event table. The hint only saves waiting: what is sent is what the table holds, in its order.
struct Follower {
    state: State,
    id: Uuid,
    after: i64,
    changes: broadcast::Receiver<Uuid>,
    ready: VecDeque<EventRow>,
    ended: bool,
}

impl Follower {
    fn stream(self) -> impl Stream<Item = Result<Event, Infallible>> {
        futures::stream::unfold(self, |mut follower| async move {
            let row = follower.next().await?;
            Some((Ok(sse(row)), follower))
        })
    }

    async fn next(&mut self) -> Option<EventRow> {
        loop {
            if let Some(row) = self.ready.pop_front() {
                self.after = row.id;
                return Some(row);
            }
            if self.ended || self.state.shutdown.is_cancelled() {
                return None;
            }
            match self.state.queue.events(self.id, self.after, BATCH).await {
                Ok(rows) if !rows.is_empty() => self.ready.extend(rows),
                Ok(_) => self.settle().await,
                Err(error) => {
                    tracing::warn!(%error, "events cannot be read");
                    self.ended = true;
                }
            }
        }
    }

    /// Nothing new: ends when the job has ended or is gone, else waits for a change.
    async fn settle(&mut self) {
        match self.state.queue.is_known(self.id).await {
            // An event that came between the two reads is sent before the end.
            Ok(Some(state)) if state.is_final() => {
                let last = self.state.queue.events(self.id, self.after, BATCH).await.unwrap_or_default();
                self.ended = last.is_empty();
                self.ready.extend(last);
            }
            Ok(None) | Err(_) => self.ended = true,
            Ok(Some(_)) => {
                tokio::select! {
                    () = changed(&mut self.changes, self.id) => {}
                    () = tokio::time::sleep(POLL) => {}
                    () = self.state.shutdown.cancelled() => {}
                }
            }
        }
    }
}

fn sse(row: EventRow) -> Event {
    let shape = EventShape::from(row);
    let event = Event::default().id(shape.id.to_string()).event(&shape.event);
    // Strings and finite numbers always serialise.
    event.json_data(&shape.data).unwrap_or_default()
}
