//! `/v1/webhooks`: delivery status, dead letters, replay and re-enabling.

use axum::extract::State as Shared;
use axum::http::StatusCode;
use axum::response::Response;
use serde::{Deserialize, Serialize};

use super::client::Caller;
use super::extract::{Path, Query};
use super::problem::Problem;
use super::respond;
use super::state::State;
use crate::journal::{AuditAction, DeadLetter};
use crate::notify::{AskError, EndpointStatus, Notifier, TestOutcome};

/// Dead letters listed at most.
const MAX_LETTERS: usize = 1000;

/// How each webhook and export fares.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Endpoints {
    webhooks: Vec<EndpointStatus>,
}

/// Deliveries given up on, oldest first.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Letters {
    dead_letters: Vec<DeadLetter>,
}

/// What a replay put back into the queue.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Replayed {
    queued: u64,
}

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct ReplayQuery {
    /// One dead letter; all of them when left out
    seq: Option<u64>,
}

fn notifier(state: &State, name: &str) -> Result<Notifier, Problem> {
    let none = || Problem::not_found(format!("there is no webhook {name:?}"));
    state.notifier.clone().ok_or_else(none)
}

impl From<AskError> for Problem {
    fn from(error: AskError) -> Self {
        match error {
            AskError::Unknown(_) => Self::not_found(error.to_string()),
            AskError::TooSoon(seconds) => Self::later(StatusCode::TOO_MANY_REQUESTS, seconds, error.to_string()),
            AskError::ReadOnly | AskError::Stopping | AskError::Journal(_) => {
                Self::later(StatusCode::SERVICE_UNAVAILABLE, 5, error.to_string())
            }
        }
    }
}

/// How each webhook and export fares, without its secret and without the query of its URL
#[utoipa::path(get, path = "/v1/webhooks", tag = "webhooks",
    responses((status = 200, description = "In the order of the config", body = Endpoints)))]
pub async fn list(Shared(state): Shared<State>) -> Response {
    let webhooks = state.notifier.as_ref().map(Notifier::status).unwrap_or_default();
    respond::json(&Endpoints { webhooks })
}

/// Deliveries that the retry schedule gave up on
#[utoipa::path(get, path = "/v1/webhooks/{name}/dead-letters", tag = "webhooks",
    params(("name" = String, Path, description = "The webhook's name")),
    responses(
        (status = 200, description = "Oldest first, a thousand at most", body = Letters),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such webhook", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn dead_letters(Shared(state): Shared<State>, Path(name): Path<String>) -> Result<Response, Problem> {
    let notifier = notifier(&state, &name)?;
    let read = tokio::task::spawn_blocking(move || notifier.dead_letters(&name, MAX_LETTERS)).await;
    let dead_letters = read.expect("a read does not panic")?;
    Ok(respond::json(&Letters { dead_letters }))
}

/// Sends dead letters again
#[utoipa::path(post, path = "/v1/webhooks/{name}/replay", tag = "webhooks",
    params(("name" = String, Path, description = "The webhook's name"), ReplayQuery),
    responses(
        (status = 200, description = "How many were put back into the queue", body = Replayed),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such webhook", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be written now", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn replay(
    Shared(state): Shared<State>,
    caller: Caller,
    Path(name): Path<String>,
    Query(query): Query<ReplayQuery>,
) -> Result<Response, Problem> {
    if let Some(seq) = query.seq.filter(|seq| i64::try_from(*seq).is_err()) {
        return Err(Problem::new(
            StatusCode::BAD_REQUEST,
            format!("seq: expected the number of a dead letter, found {seq}"),
        ));
    }
    let queued = notifier(&state, &name)?.replay(&name, query.seq).await?;
    let detail = Some(format!("{queued} queued"));
    state.audit.change(AuditAction::ReplayWebhook, &caller, &name, detail);
    Ok(respond::json(&Replayed { queued }))
}

/// Sends again to a receiver that had answered 410 Gone
#[utoipa::path(post, path = "/v1/webhooks/{name}/enable", tag = "webhooks",
    params(("name" = String, Path, description = "The webhook's name")),
    responses(
        (status = 204, description = "It is sent to again"),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such webhook", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The daemon is stopping", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn enable(
    Shared(state): Shared<State>,
    caller: Caller,
    Path(name): Path<String>,
) -> Result<StatusCode, Problem> {
    notifier(&state, &name)?.enable(&name).await?;
    state.audit.change(AuditAction::EnableWebhook, &caller, &name, None);
    Ok(StatusCode::NO_CONTENT)
}

/// Sends a signed event that is marked as a test, once
///
/// Its `type` is `webhook.test`, and its alert is made up. It is sent whatever the webhook's kinds and state are, counts for no
/// retry, and the answer is waited for as long as for any other, 10 s at most.
#[utoipa::path(post, path = "/v1/webhooks/{name}/test", tag = "webhooks",
    params(("name" = String, Path, description = "The webhook's name")),
    responses(
        (status = 200, description = "What came back from the receiver", body = TestOutcome),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such webhook", body = Problem, content_type = "application/problem+json"),
        (status = 429, description = "Another test event was sent a moment ago", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The daemon is stopping", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn test(Shared(state): Shared<State>, caller: Caller, Path(name): Path<String>) -> Result<Response, Problem> {
    let outcome = notifier(&state, &name)?.test(&name).await?;
    let detail = outcome.error.clone().unwrap_or_else(|| "delivered".to_owned());
    state
        .audit
        .change(AuditAction::TestWebhook, &caller, &name, Some(detail));
    Ok(respond::json(&outcome))
}
