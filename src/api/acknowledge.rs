//! `/v1/alerts/{id}/acknowledge`: acknowledging an alert, and withdrawing that.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use serde::Deserialize;

use super::client::Caller;
use super::extract::{Path, check_media_type};
use super::problem::Problem;
use super::state::{Acknowledged, Command, State};
use super::{alerts, respond};
use crate::journal::AuditAction;
use crate::monitor::Alert;

/// Characters of a note: a few sentences, which every reader of the alert gets with it.
const LONGEST_NOTE: usize = 1000;
const LARGEST_BODY: usize = 16 << 10;

/// What may come with an acknowledgement.
#[derive(Clone, Debug, Default, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Acknowledge {
    /// What was found or is being done, for others who read the alert; no control characters but line breaks and tabs.
    #[serde(default)]
    #[schema(max_length = 1000, pattern = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*$")]
    note: Option<String>,
}

/// The note of a body; none where there is no body.
fn note(headers: &HeaderMap, body: &[u8]) -> Result<Option<String>, Problem> {
    let unprocessable = |detail: String| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, detail);
    if body.trim_ascii().is_empty() {
        return Ok(None);
    }
    if body.len() > LARGEST_BODY {
        let detail = format!("expected a body of at most {LARGEST_BODY} bytes, found {}", body.len());
        return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, detail));
    }
    check_media_type(headers, &["application/json"])?;
    let parsed: Option<Acknowledge> =
        serde_json::from_slice(body).map_err(|e| unprocessable(format!("the body: {e}")))?;
    let Some(note) = parsed
        .and_then(|body| body.note)
        .map(|note| note.trim().to_owned())
        .filter(|note| !note.is_empty())
    else {
        return Ok(None);
    };
    let length = note.chars().count();
    if length > LONGEST_NOTE {
        return Err(unprocessable(format!(
            "note: expected at most {LONGEST_NOTE} characters, found {length}"
        )));
    }
    if let Some(found) = note.chars().find(|c| c.is_control() && !['\n', '\r', '\t'].contains(c)) {
        return Err(unprocessable(format!(
            "note: expected no control characters but line breaks and tabs, found {found:?}"
        )));
    }
    Ok(Some(note))
}

/// Acknowledges an alert
///
/// The name of the caller's token and a note, if one is given, are kept in the alert. An alert that is acknowledged already
/// stays as it is, unless there is a note: that takes the place of the one before, which the audit log keeps.
#[utoipa::path(post, path = "/v1/alerts/{id}/acknowledge", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id")),
    request_body(description = "A note; may be left out", content = Option<Acknowledge>),
    responses(
        (status = 200, description = "The alert, acknowledged now or before", body = Alert),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The alert has cleared", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The body is not as described", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn acknowledge(
    Shared(state): Shared<State>,
    caller: Caller,
    Path(id): Path<String>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let note = note(&headers, &body?)?;
    let outcome = state.ask(|reply| Command::Acknowledge {
        id: id.clone(),
        by: caller.name(),
        note: note.clone(),
        reply,
    });
    let response = answer(&id, outcome.await?)?;
    state.audit.change(AuditAction::Acknowledge, &caller, &id, note);
    Ok(response)
}

/// Withdraws an acknowledgement: the alert is open again
///
/// The alert keeps the acknowledgement, with who withdrew it and when.
#[utoipa::path(delete, path = "/v1/alerts/{id}/acknowledge", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id")),
    responses(
        (status = 200, description = "The alert, open now or before", body = Alert),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The alert has cleared", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn unacknowledge(
    Shared(state): Shared<State>,
    caller: Caller,
    Path(id): Path<String>,
) -> Result<Response, Problem> {
    let outcome = state.ask(|reply| Command::Unacknowledge {
        id: id.clone(),
        by: caller.name(),
        reply,
    });
    let response = answer(&id, outcome.await?)?;
    state.audit.change(AuditAction::Unacknowledge, &caller, &id, None);
    Ok(response)
}

fn answer(id: &str, outcome: Acknowledged) -> Result<Response, Problem> {
    match outcome {
        Acknowledged::Done(alert) => Ok(respond::json(&*alert)),
        Acknowledged::Unknown => Err(alerts::unknown(id)),
        Acknowledged::AlreadyCleared => Err(Problem::new(
            StatusCode::CONFLICT,
            format!("alert {id:?} has cleared; only an alert that stands can be acknowledged"),
        )),
    }
}
