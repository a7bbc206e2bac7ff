//! `POST /v1/claims`: parses a body of claims and hands them to the compute thread.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::Response;
use tokio::sync::{mpsc, oneshot};

use super::client::Caller;
use super::intake::Intake;
use super::problem::Problem;
use super::respond;
use super::state::{Command, State};
use crate::claim::Claim;
use crate::{claims, metric};

/// Claims taken from one body.
const MAX_CLAIMS: usize = 20_000;
/// A request with so many claims takes up as much of the queue to the monitor as one that has few.
const CLAIMS_A_PLACE: usize = 500;

pub(super) fn busy() -> Problem {
    Problem::later(
        StatusCode::SERVICE_UNAVAILABLE,
        1,
        "the monitor is too busy to take this now",
    )
}

/// Hands a command to the compute thread; a full queue is overload.
pub(super) fn send(state: &State, command: Command) -> Result<(), Problem> {
    state.commands.try_send(command).map_err(|e| match e {
        mpsc::error::TrySendError::Full(_) => busy(),
        mpsc::error::TrySendError::Closed(_) => {
            Problem::later(StatusCode::SERVICE_UNAVAILABLE, 5, "the monitor is stopping")
        }
    })
}

/// Claims of a body with the line each stands on: one JSON object over any number of lines, or one a line. The fields
/// are always the documented ones, whatever names the log has for them.
fn parse(body: &[u8], intake: &mut Intake) -> Vec<(usize, Claim)> {
    let names = claims::Config::default();
    if let Ok(claim) = claims::parse_line(body, &names) {
        return vec![(1, claim)];
    }
    let mut found = Vec::new();
    for (k, line) in body.split(|b| *b == b'\n').enumerate() {
        if line.trim_ascii().is_empty() {
            continue;
        }
        if found.len() == MAX_CLAIMS {
            intake.refuse(k + 1, format!("more than {MAX_CLAIMS} claims in one body"));
            continue;
        }
        match claims::parse_line(line, &names) {
            Ok(claim) => found.push((k + 1, claim)),
            Err(e) => intake.refuse(k + 1, e.to_string()),
        }
    }
    found
}

/// Claims come as JSON or NDJSON. Clients that say nothing, or name no more than curl does by itself, are believed.
fn check_media_type(headers: &HeaderMap) -> Result<(), Problem> {
    let Some(value) = headers.get(header::CONTENT_TYPE) else {
        return Ok(());
    };
    let named = value.to_str().unwrap_or_default();
    let essence = named.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    let taken = [
        "application/json",
        "application/x-ndjson",
        "application/ndjson",
        "application/jsonl",
        "application/octet-stream",
        "application/x-www-form-urlencoded",
        "text/plain",
    ];
    if taken.contains(&essence.as_str()) {
        return Ok(());
    }
    Err(Problem::new(
        StatusCode::UNSUPPORTED_MEDIA_TYPE,
        format!("Content-Type: expected application/json or application/x-ndjson, found {named:?}"),
    ))
}

/// Takes claims from the access network
///
/// One claim as JSON, or one a line as NDJSON. Lines that cannot be taken are refused one by one, the others stand.
#[utoipa::path(post, path = "/v1/claims", tag = "claims",
    request_body(description = "A claim, or one a line", content(
        (Claim = "application/json"), (String = "application/x-ndjson"))),
    responses(
        (status = 200, description = "At least one claim was taken", body = Intake),
        (status = 409, description = "The claims contradict, or are older than, what is known; `reasons` says which", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Neither JSON nor NDJSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "No claim was taken; `reasons` says why", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy, or has no room for another user; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn post(
    Shared(state): Shared<State>,
    caller: Caller,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    check_media_type(&headers)?;
    let body = body?;
    let mut intake = Intake::default();
    let (lines, claims): (Vec<_>, Vec<_>) = parse(&body, &mut intake).into_iter().unzip();
    let sent = claims.len();
    metrics::counter!(metric::CLAIMS, "outcome" => "malformed").increment(intake.refused as u64);
    if sent > 0 {
        // What waits is bounded in claims too: large requests are told to come back while others wait.
        if state.commands.capacity() <= sent / CLAIMS_A_PLACE {
            return Err(busy());
        }
        let (reply, answer) = oneshot::channel();
        send(&state, Command::Claims { claims, reply })?;
        let refused = answer.await.map_err(|_| busy())?;
        intake.accepted = sent - refused.len();
        for (index, reason) in refused {
            intake.refuse(lines.get(index).copied().unwrap_or_default(), reason);
        }
        intake.reasons.sort_by_key(|r| r.line);
    }
    state.audit.claims(&caller, intake.accepted, intake.refused);
    if intake.accepted > 0 {
        return Ok(respond::json(&intake));
    }
    let detail = match intake.reasons.first() {
        Some(first) => format!("no claim was taken; line {}: {}", first.line, first.reason),
        None => "the body holds no claim".to_owned(),
    };
    // Claims that could be read are refused for what is known already: another request may well be taken.
    let is_full = sent > 0 && intake.reasons.iter().any(|r| r.reason == claims::NO_ROOM);
    let status = match sent {
        0 => StatusCode::UNPROCESSABLE_ENTITY,
        _ if is_full => StatusCode::SERVICE_UNAVAILABLE,
        _ => StatusCode::CONFLICT,
    };
    Err(Problem::refused(status, intake, detail))
}
