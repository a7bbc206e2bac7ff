//! `POST /v1/claims`: parses a body of claims and hands them to the compute thread.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;

use super::client::Caller;
use super::extract::check_media_type;
use super::intake::Intake;
use super::problem::Problem;
use super::respond;
use super::state::{Command, State, busy};
use crate::claim::Claim;
use crate::{claims, metric};

/// Claims taken from one body.
const MAX_CLAIMS: usize = 20_000;
/// Claims come as JSON or NDJSON, by whatever name.
const MEDIA_TYPES: [&str; 6] = [
    "application/json",
    "application/x-ndjson",
    "application/ndjson",
    "application/jsonl",
    "application/octet-stream",
    "text/plain",
];
/// A request with so many claims takes up as much of the queue to the monitor as one that has few.
const CLAIMS_A_PLACE: usize = 500;

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

/// Takes claims from the access network
///
/// One claim as JSON, or one a line as NDJSON, at most 4 MiB of it; `Content-Encoding: gzip` is taken. Lines that cannot be taken
/// are refused one by one, the others stand.
#[utoipa::path(post, path = "/v1/claims", tag = "claims",
    request_body(description = "A claim, or one a line", content(
        (Claim = "application/json"), (String = "application/x-ndjson"))),
    responses(
        (status = 200, description = "At least one claim was taken", body = Intake),
        (status = 400, description = "The body cannot be read: no gzip, though it says so", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The claims contradict, or are older than, what is known; `reasons` says which", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large, sent or decompressed", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Neither JSON nor NDJSON, or neither plain nor gzip", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "No claim was taken; `reasons` says why", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy, or has no room for another user; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn post(
    Shared(state): Shared<State>,
    caller: Caller,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    check_media_type(&headers, &MEDIA_TYPES)?;
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
        let refused = state.ask(|reply| Command::Claims { claims, reply }).await?;
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
