//! `/healthz`, `/readyz` and `/metrics`, for supervisors and Prometheus.

use std::sync::atomic::Ordering;

use axum::extract::State as Shared;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::problem::Problem;
use super::state::State;

/// Whether the process answers
#[utoipa::path(get, path = "/healthz", tag = "monitor", security(()),
    responses((status = 200, description = "It does", body = String, content_type = "text/plain")))]
pub async fn healthz() -> &'static str {
    "ok\n"
}

/// Whether good frames flow and the model is loaded
#[utoipa::path(get, path = "/readyz", tag = "monitor", security(()),
    responses(
        (status = 200, description = "They do and it is", body = String, content_type = "text/plain"),
        (status = 503, description = "Not now; `detail` says why", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn readyz(Shared(state): Shared<State>) -> Result<&'static str, Problem> {
    let not_yet = |why: &str| Err(Problem::later(StatusCode::SERVICE_UNAVAILABLE, 1, why));
    if !state.ready.load(Ordering::Acquire) {
        return not_yet("the pipeline is starting");
    }
    match state.feed.latest() {
        None => not_yet("no frame has been looked at yet"),
        Some(latest) if !latest.snapshot.status.source.flows() => not_yet("no good frames arrive"),
        Some(_) => Ok("ready\n"),
    }
}

/// Metrics in Prometheus' text format
#[utoipa::path(get, path = "/metrics", tag = "monitor",
    responses((status = 200, description = "All metrics", body = String, content_type = "text/plain")))]
pub async fn metrics(Shared(state): Shared<State>) -> Response {
    let kind = HeaderValue::from_static("text/plain; version=0.0.4; charset=utf-8");
    ([(header::CONTENT_TYPE, kind)], state.metrics.render()).into_response()
}
