//! `/v1/stream`: the stream as a WebSocket, with pings and timeouts.

use std::pin::pin;
use std::time::Duration;

use axum::Extension;
use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::response::Response;
use serde::Deserialize;
use tokio::sync::watch;
use tokio::time::{Instant, interval, timeout};

use super::extract::Query;
use super::problem::Problem;
use super::state::State;
use super::stream::{self, Reader};
use super::tokens::Session;

/// A ping is sent this often.
const PING_EVERY: Duration = Duration::from_secs(15);
/// A client from which nothing came for this long is disconnected.
const SILENCE: Duration = Duration::from_secs(40);
/// One message must have left within this time.
const SEND_WITHIN: Duration = Duration::from_secs(20);
/// A close frame must have left within this time.
const CLOSE_WITHIN: Duration = Duration::from_millis(300);
/// Clients have nothing to say here but pongs.
const MAX_INCOMING: usize = 4096;
/// A message and the pings behind it; more is never waiting.
const MAX_WRITE_BUFFER: usize = 8 << 20;

/// The subprotocol that a browser names beside `bearer.TOKEN`, since it cannot set a header.
pub const SUBPROTOCOL: &str = "oapwatch.v1";

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct StreamQuery {
    /// The `seq` of the last message seen before a reconnect: every alert event after it comes again
    pub(super) after: Option<u64>,
}

/// Positions as they come and every alert event, over a WebSocket
///
/// A browser that needs a token offers the subprotocols `oapwatch.v1` and `bearer.TOKEN`, the token in
/// unpadded base64url. Alert events are never lost; positions are, for a slow reader, and `missed` counts them.
#[utoipa::path(get, path = "/v1/stream", tag = "stream", params(StreamQuery),
    responses(
        (status = 101, description = "A WebSocket whose text messages are JSON", body = stream::Message),
        (status = 400, description = "No WebSocket handshake, or a parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 426, description = "No WebSocket handshake", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn websocket(
    Shared(state): Shared<State>,
    Query(query): Query<StreamQuery>,
    Extension(session): Extension<Session>,
    upgrade: WebSocketUpgrade,
) -> Response {
    upgrade
        .protocols([SUBPROTOCOL])
        .max_message_size(MAX_INCOMING)
        .max_frame_size(MAX_INCOMING)
        .write_buffer_size(0)
        .max_write_buffer_size(MAX_WRITE_BUFFER)
        .on_upgrade(move |socket| async move {
            let _counted = super::connection::Counted::stream("websocket");
            converse(socket, state, query.after, session).await;
        })
}

/// Completes when the daemon stops.
pub(super) async fn stopped(stopping: &mut watch::Receiver<bool>) {
    let _ = stopping.wait_for(|s| *s).await;
}

async fn converse(mut socket: WebSocket, state: State, after: Option<u64>, session: Session) {
    let mut stopping = state.stopping.subscribe();
    let mut revoked = pin!(session.revoked());
    let mut reader = Reader::join(state, after).await;
    let mut ping = interval(PING_EVERY);
    ping.reset();
    let mut heard = Instant::now();
    loop {
        let outgoing = tokio::select! {
            incoming = socket.recv() => match incoming {
                Some(Ok(Message::Close(_)) | Err(_)) | None => return,
                Some(Ok(_)) => {
                    heard = Instant::now();
                    continue;
                }
            },
            _ = stopped(&mut stopping) => return close(socket, close_code::AWAY, "the daemon is stopping").await,
            () = &mut revoked => return close(socket, close_code::POLICY, "the token was revoked").await,
            _ = ping.tick() => {
                if heard.elapsed() > SILENCE {
                    tracing::debug!("a stream client has not answered pings for {SILENCE:?}");
                    return;
                }
                Message::Ping(Bytes::new())
            },
            message = reader.next() => Message::Text(message.text.into()),
        };
        let sent = tokio::select! {
            sent = timeout(SEND_WITHIN, socket.send(outgoing)) => sent,
            // A client that takes nothing would otherwise keep a revoked stream for the whole time limit.
            () = &mut revoked => return,
        };
        match sent {
            Ok(Ok(())) => {}
            Ok(Err(_)) => return,
            Err(_) => {
                tracing::debug!("a stream client took no message within {SEND_WITHIN:?}");
                return;
            }
        }
    }
}

async fn close(mut socket: WebSocket, code: u16, reason: &'static str) {
    let frame = CloseFrame {
        code,
        reason: reason.into(),
    };
    // A client that does not read it is cut off all the same.
    let _ = timeout(CLOSE_WITHIN, socket.send(Message::Close(Some(frame)))).await;
}
