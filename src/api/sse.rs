//! `/v1/events`: the stream as server-sent events.

use std::convert::Infallible;
use std::time::Duration;

use axum::Extension;
use axum::extract::State as Shared;
use axum::http::HeaderMap;
use axum::response::IntoResponse;
use axum::response::Response;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::stream;

use super::extract::Query;
use super::problem::Problem;
use super::state::State;
use super::stream::{self as feed, Reader};
use super::tokens::Session;
use super::websocket::{StreamQuery, stopped};

/// The same messages as server-sent events
///
/// `event` is the message's type and `id` its seq; a client that reconnects with Last-Event-ID, as browsers do, goes
/// on from there.
#[utoipa::path(get, path = "/v1/events", tag = "stream", params(StreamQuery),
    responses(
        (status = 200, description = "An endless stream", body = feed::Message, content_type = "text/event-stream"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn events(
    Shared(state): Shared<State>,
    Query(query): Query<StreamQuery>,
    Extension(session): Extension<Session>,
    headers: HeaderMap,
) -> Response {
    let last_seen = headers
        .get("last-event-id")
        .and_then(|v| v.to_str().ok())
        .and_then(|v| v.parse().ok());
    let mut stopping = state.stopping.subscribe();
    let reader = Reader::join(state, last_seen.or(query.after)).await;
    let counted = super::connection::Counted::stream("sse");
    let messages = stream::unfold((reader, counted), |(mut reader, counted)| async move {
        let message = reader.next().await;
        let event = Event::default()
            .event(message.kind)
            .id(message.seq.to_string())
            .data(message.text);
        Some((Ok::<_, Infallible>(event), (reader, counted)))
    });
    let until_end = async move {
        tokio::select! {
            () = stopped(&mut stopping) => {}
            () = session.revoked() => {}
        }
    };
    let messages = futures_util::StreamExt::take_until(messages, Box::pin(until_end));
    let keep_alive = KeepAlive::new().interval(Duration::from_secs(15));
    Sse::new(Box::pin(messages)).keep_alive(keep_alive).into_response()
}
