//! `/v1/maintenance`: windows in which alerts are recorded and not sent.

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::client::Caller;
use super::extract::Path;
use super::known_lights::{body_of, written};
use super::problem::Problem;
use super::respond;
use super::state::{Command, State};
use crate::journal::AuditAction;
use crate::monitor::{MaintenanceError, Window};

const LARGEST_BODY: usize = 16 << 10;

/// Maintenance windows in force and to come.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Windows {
    maintenance: Vec<Window>,
}

/// A maintenance window.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewWindow {
    /// Now when left out, on the frames' clock.
    #[serde(default)]
    #[schema(value_type = Option<String>, format = DateTime)]
    from: Option<Timestamp>,
    /// At most a week after `from`.
    #[schema(value_type = String, format = DateTime)]
    until: Timestamp,
    /// Who answers for it; the name of the token where it has one.
    #[serde(default)]
    #[schema(max_length = 64)]
    by: Option<String>,
    #[serde(default)]
    #[schema(max_length = 1000)]
    note: Option<String>,
}

impl From<MaintenanceError> for Problem {
    fn from(error: MaintenanceError) -> Self {
        let status = match error {
            MaintenanceError::Length { .. } | MaintenanceError::Text { .. } => StatusCode::UNPROCESSABLE_ENTITY,
            MaintenanceError::TooMany | MaintenanceError::Fixed(_) | MaintenanceError::AtHub => StatusCode::CONFLICT,
            MaintenanceError::Unknown(_) => StatusCode::NOT_FOUND,
        };
        Self::new(status, error.to_string())
    }
}

/// Maintenance windows
#[utoipa::path(get, path = "/v1/maintenance", tag = "places",
    responses(
        (status = 200, description = "Windows in force and to come", body = Windows),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn list(Shared(state): Shared<State>) -> Result<Response, Problem> {
    let maintenance = state.ask(|reply| Command::Maintenance { reply }).await?;
    Ok(respond::json(&Windows { maintenance }))
}

/// Begins a maintenance window: alerts raised in it are recorded, and not sent
///
/// What is still open when it ends is sent then.
#[utoipa::path(post, path = "/v1/maintenance", tag = "places", request_body = NewWindow,
    responses(
        (status = 201, description = "The window", body = Window),
        (status = 409, description = "There are too many", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The body is not as described", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn begin(
    Shared(state): Shared<State>,
    caller: Caller,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let new: NewWindow = body_of(&headers, body, LARGEST_BODY, &["application/json"])?;
    // Whoever has a name cannot answer by another.
    let by = caller.name().or(new.by).unwrap_or_default();
    let begun = state.ask(|reply| Command::BeginMaintenance {
        from: new.from,
        until: new.until,
        by,
        note: new.note,
        reply,
    });
    let window = begun.await??;
    written(&state).await;
    let detail = format!(
        "{} to {}, {}: {}",
        window.from,
        window.until,
        window.by,
        window.note.as_deref().unwrap_or("no note")
    );
    state
        .audit
        .change(AuditAction::BeginMaintenance, &caller, &window.id, Some(detail));
    Ok((StatusCode::CREATED, respond::json(&window)).into_response())
}

/// Ends a maintenance window before its time
#[utoipa::path(delete, path = "/v1/maintenance/{id}", tag = "places",
    params(("id" = String, Path, description = "The window's id")),
    responses(
        (status = 200, description = "The window, which has ended", body = Window),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such window", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It is set in the config", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn end(Shared(state): Shared<State>, caller: Caller, Path(id): Path<String>) -> Result<Response, Problem> {
    let window = state.ask(|reply| Command::EndMaintenance { id, reply }).await??;
    written(&state).await;
    state
        .audit
        .change(AuditAction::EndMaintenance, &caller, &window.id, None);
    Ok(respond::json(&window))
}
