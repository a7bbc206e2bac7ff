//! `/v1/pose`: where the platform is and how it is turned.

use axum::extract::State as Shared;
use axum::http::HeaderMap;
use axum::response::Response;

use super::pose_status::PoseStatus;
use super::problem::Problem;
use super::state::State;
use super::{conditional, positions, respond};

/// Where the platform is and how it is turned
#[utoipa::path(get, path = "/v1/pose", tag = "positions",
    responses(
        (status = 200, description = "The pose that the latest frame was looked at with", body = PoseStatus),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 404, description = "A hub has no platform", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn pose(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let latest = positions::latest(&state)?;
    let pose = latest.snapshot.pose.as_ref();
    let pose = pose.ok_or_else(|| Problem::not_found("a hub has no platform: ask a station".to_owned()))?;
    Ok(conditional::answer(&headers, latest.seq, || respond::json(pose)))
}
