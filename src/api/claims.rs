//! `POST /v1/claims`: parses a body of claims in any of the formats and hands them to the compute thread.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Deserialize;

use super::client::Caller;
use super::extract::{Query, check_media_type};
use super::intake::Intake;
use super::problem::Problem;
use super::respond;
use super::state::{Command, State, busy};
use crate::claims::{self, Claim, Format};
use crate::metric;

/// Claims come as JSON or NDJSON, by whatever name, or in a format with a name of its own.
const MEDIA_TYPES: [&str; 10] = [
    "application/json",
    "application/x-ndjson",
    "application/ndjson",
    "application/jsonl",
    "application/octet-stream",
    "text/plain",
    "text/csv",
    "application/xml",
    "text/xml",
    "application/cot+xml",
];
/// A request with so many claims takes up as much of the queue to the monitor as one that has few.
const CLAIMS_A_PLACE: usize = 500;

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct ClaimsQuery {
    /// How the claims are written. Left out, the media type says: `text/csv` is "csv", XML is "cot", anything else "oapwatch"
    #[param(inline)]
    format: Option<Format>,
}

/// The format that a media type stands for.
fn format_of(headers: &HeaderMap) -> Format {
    let named = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let essence = named.and_then(|text| text.split(';').next()).unwrap_or_default();
    match essence.trim().to_ascii_lowercase().as_str() {
        "text/csv" => Format::Csv,
        "application/xml" | "text/xml" | "application/cot+xml" => Format::Cot,
        _ => Format::Oapwatch,
    }
}

/// Takes claims from the access network
///
/// One claim as JSON, or one a line as NDJSON, at most 4 MiB of it; `Content-Encoding: gzip` is taken. Lines that cannot be taken
/// are refused one by one, the others stand. 3GPP shapes, Cisco Spaces events, Cursor on Target and CSV are taken too, see `format`.
#[utoipa::path(post, path = "/v1/claims", tag = "claims", params(ClaimsQuery),
    request_body(description = "A claim, or one a line", content(
        (Claim = "application/json"), (String = "application/x-ndjson"), (String = "text/csv"))),
    responses(
        (status = 200, description = "At least one claim was taken", body = Intake),
        (status = 400, description = "The query or the body cannot be read: no gzip, though it says so", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The claims contradict, or are older than, what is known; `reasons` says which", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large, sent or decompressed", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Neither JSON nor NDJSON nor another format that is taken, or neither plain nor gzip", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "No claim was taken; `reasons` says why", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy, or has no room for another user; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn post(
    Shared(state): Shared<State>,
    caller: Caller,
    Query(query): Query<ClaimsQuery>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    check_media_type(&headers, &MEDIA_TYPES)?;
    let body = body?;
    let mut intake = Intake::default();
    let format = query.format.unwrap_or_else(|| format_of(&headers));
    let reading = claims::Config {
        format,
        axes: state.axes,
        ..claims::Config::default()
    };
    // The fields are always the documented ones, whatever names the log has for them.
    let parsed = claims::parse_body(&body, &reading, |line, why| intake.refuse(line, why));
    let (lines, claims): (Vec<_>, Vec<_>) = parsed.into_iter().unzip();
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
