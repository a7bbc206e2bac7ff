//! `/v1/known-lights`: emitters that nobody claims and that an operator has approved.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::client::Caller;
use super::extract::{Path, check_media_type};
use super::problem::Problem;
use super::respond;
use super::state::{Command, State};
use crate::journal::AuditAction;
use crate::monitor::{KnownLight, KnownLightStatus, LightError, LightRequest};

const LARGEST_BODY: usize = 16 << 10;
/// Longest wait for the journal's disk before a change is confirmed.
const DISK_TIMEOUT: Duration = Duration::from_secs(2);

/// The known lights in force.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct KnownLights {
    known_lights: Vec<KnownLightStatus>,
}

/// What is approved: a place with a radius, or the emitter of an open alert.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Approval {
    /// An open alert about an emitter that nobody claims, or about a known light that changed: that is learned anew.
    #[serde(default)]
    alert: Option<String>,
    /// Without an alert.
    #[serde(default)]
    #[schema(minimum = -100000, maximum = 100000)]
    x_m: Option<f64>,
    #[serde(default)]
    #[schema(minimum = -100000, maximum = 100000)]
    y_m: Option<f64>,
    /// How far the light may be from there; learned where it is left out.
    #[serde(default)]
    #[schema(minimum = 0.1, maximum = 50)]
    radius_m: Option<f64>,
    /// Why.
    #[serde(default)]
    #[schema(max_length = 1000, pattern = r"^[^\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]*$")]
    note: Option<String>,
    /// When the approval ends, on the frames' clock; never when left out.
    #[serde(default)]
    #[schema(value_type = Option<String>, format = DateTime)]
    until: Option<Timestamp>,
}

/// A JSON body that is not too large.
pub(super) fn body_of<T: for<'a> Deserialize<'a>>(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
    largest: usize,
    media_types: &[&str],
) -> Result<T, Problem> {
    check_media_type(headers, media_types)?;
    let body = body?;
    if body.len() > largest {
        let detail = format!("expected a body of at most {largest} bytes, found {}", body.len());
        return Err(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, detail));
    }
    serde_json::from_slice(&body).map_err(|e| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, format!("the body: {e}")))
}

/// Waits until what was changed is on disk; a disk that hangs is waited for no longer than two seconds.
pub(super) async fn written(state: &State) {
    if tokio::time::timeout(DISK_TIMEOUT, state.journal.settled())
        .await
        .is_err()
    {
        tracing::error!("the journal's disk hangs; a change is confirmed before it is on it");
    }
}

impl Approval {
    fn request(self, by: Option<String>) -> Result<LightRequest, Problem> {
        let unprocessable = |detail: &str| Problem::new(StatusCode::UNPROCESSABLE_ENTITY, detail);
        let place = match (self.alert, self.x_m.zip(self.y_m)) {
            (None, Some((x, y))) => Ok(([x, y], self.radius_m)),
            (Some(alert), None) if self.x_m.is_none() && self.y_m.is_none() && self.radius_m.is_none() => Err(alert),
            (Some(_), _) => return Err(unprocessable("expected an alert or a place, found both")),
            (None, None) => return Err(unprocessable("expected x_m and y_m, or alert, found neither")),
        };
        let note = self
            .note
            .map(|note| note.trim().to_owned())
            .filter(|note| !note.is_empty());
        Ok(LightRequest {
            place,
            note,
            until: self.until,
            by,
            at: Timestamp::UNIX_EPOCH,
        })
    }
}

impl From<LightError> for Problem {
    fn from(error: LightError) -> Self {
        let status = match error {
            LightError::Value { .. } | LightError::Past { .. } => StatusCode::UNPROCESSABLE_ENTITY,
            LightError::NoAlert(_) | LightError::Unknown(_) => StatusCode::NOT_FOUND,
            LightError::TooMany { .. }
            | LightError::AtHub
            | LightError::NoEmitter { .. }
            | LightError::Taken(_)
            | LightError::Fixed(_)
            | LightError::Cleared(_) => StatusCode::CONFLICT,
        };
        Self::new(status, error.to_string())
    }
}

/// The known lights: approved emitters, with what was learned of them
#[utoipa::path(get, path = "/v1/known-lights", tag = "places",
    responses(
        (status = 200, description = "All that are in force, those of the config first", body = KnownLights),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn list(Shared(state): Shared<State>) -> Result<Response, Problem> {
    let known_lights = state.ask(|reply| Command::KnownLights { reply }).await?;
    Ok(respond::json(&KnownLights { known_lights }))
}

/// Approves an emitter that nobody claims
///
/// From then on it raises nothing while it stays what it is; it is tracked and shown all the same. What it is like is learned from
/// its track.
#[utoipa::path(post, path = "/v1/known-lights", tag = "places", request_body = Approval,
    responses(
        (status = 201, description = "It is a known light now", body = KnownLight),
        (status = 404, description = "There is no such alert", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "There is a known light already, or the alert is about something else or has cleared", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The body is not as described", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn approve(
    Shared(state): Shared<State>,
    caller: Caller,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let approval: Approval = body_of(&headers, body, LARGEST_BODY, &["application/json"])?;
    let request = approval.request(caller.name())?;
    let light = state.ask(|reply| Command::Approve { request, reply }).await??;
    written(&state).await;
    let until = light.until.map_or("without end".to_owned(), |t| format!("until {t}"));
    let detail = format!(
        "({:.2}, {:.2}) m, radius {:.2} m, {until}: {}",
        light.x_m,
        light.y_m,
        light.radius_m,
        light.note.as_deref().unwrap_or("no note")
    );
    state
        .audit
        .change(AuditAction::ApproveLight, &caller, &light.id, Some(detail));
    Ok((StatusCode::CREATED, respond::json(&light)).into_response())
}

/// Ends the approval of a known light
#[utoipa::path(delete, path = "/v1/known-lights/{id}", tag = "places",
    params(("id" = String, Path, description = "The known light's id")),
    responses(
        (status = 200, description = "The light, which is known no more", body = KnownLight),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such known light", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It is set in the config", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The monitor is too busy; come back", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn revoke(Shared(state): Shared<State>, caller: Caller, Path(id): Path<String>) -> Result<Response, Problem> {
    let light = state.ask(|reply| Command::Revoke { id, reply }).await??;
    written(&state).await;
    state
        .audit
        .change(AuditAction::RevokeLight, &caller, &light.id, light.note.clone());
    Ok(respond::json(&light))
}
