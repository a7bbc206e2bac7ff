//! `/v1/positions`, `/v1/users/{user}/position`, `/v1/status` and `/v1/history`.

use axum::extract::State as Shared;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::extract::{Path, Query, within};
use super::feed::Published;
use super::history::{Moment, PastBeam};
use super::problem::Problem;
use super::snapshot::{StationStatus, Status};
use super::state::State;
use super::table::{self, Columns};
use super::{conditional, respond};
use crate::monitor::{Report, UserPosition};

/// The newest snapshot, or the advice to wait for the first frame.
pub(super) fn latest(state: &State) -> Result<std::sync::Arc<Published>, Problem> {
    let none = || Problem::later(StatusCode::SERVICE_UNAVAILABLE, 1, "no frame has been looked at yet");
    state.feed.latest().ok_or_else(none)
}

/// Every beam of the latest frame, and the users that no beam answers for
#[utoipa::path(get, path = "/v1/positions", tag = "positions",
    responses(
        (status = 200, description = "The latest frame's positions", body = Report),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn positions(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let latest = latest(&state)?;
    Ok(conditional::answer(&headers, latest.seq, || {
        respond::json(&latest.snapshot.report)
    }))
}

/// Where one user is and where they say they are
#[utoipa::path(get, path = "/v1/users/{user}/position", tag = "positions",
    params(("user" = String, Path, description = "The user as the claims name them")),
    responses(
        (status = 200, description = "The user's position (null when unseen) and claim (null when none)", body = UserPosition),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "Nobody claims this user to be in view or near it, and no beam answers for them", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn user_position(
    Shared(state): Shared<State>,
    Path(user): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let latest = latest(&state)?;
    let report = &latest.snapshot.report;
    let position = report.emitters.iter().find(|e| e.user.as_deref() == Some(&user));
    let claim = report.claims.iter().find(|c| c.user == user);
    if position.is_none() && claim.is_none() {
        return Err(Problem::not_found(format!(
            "no user {user:?} is seen, or claimed to be in view or near it"
        )));
    }
    let found = UserPosition {
        time: report.time,
        position: position.cloned(),
        claim: claim.cloned(),
        user,
    };
    Ok(conditional::answer(&headers, latest.seq, || respond::json(&found)))
}

/// The access points of a hub.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Stations<'a> {
    stations: &'a [StationStatus],
}

/// The access points of a hub, with their health; none at an access point itself
#[utoipa::path(get, path = "/v1/stations", tag = "fleet",
    responses(
        (status = 200, description = "Every access point that has said anything since the hub began", body = Stations<'_>),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 503, description = "Nothing has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn stations(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let latest = latest(&state)?;
    Ok(conditional::answer(&headers, latest.seq, || {
        let stations = &latest.snapshot.status.stations;
        respond::json(&Stations { stations })
    }))
}

/// How the monitor itself is doing
#[utoipa::path(get, path = "/v1/status", tag = "monitor",
    responses(
        (status = 200, description = "Source, frames, latency, claims, journal, webhooks", body = Status),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 503, description = "No frame has been looked at yet", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn status(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let latest = latest(&state)?;
    Ok(conditional::answer(&headers, latest.seq, || {
        respond::json(&latest.snapshot.status)
    }))
}

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct HistoryQuery {
    /// Only moments after this time
    #[param(value_type = Option<String>, format = DateTime)]
    since: Option<Timestamp>,
    /// The newest so many moments
    #[param(minimum = 1, maximum = 3600)]
    limit: Option<usize>,
}

/// Positions of the past, oldest first.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Moments {
    moments: Vec<Moment>,
}

/// Where the beams were during the last hour, once a second
#[utoipa::path(get, path = "/v1/history", tag = "positions", params(HistoryQuery),
    responses(
        (status = 200, description = "Moments, oldest first", body = Moments),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn history(Shared(state): Shared<State>, Query(query): Query<HistoryQuery>) -> Result<Response, Problem> {
    let moments = moments(&state, &query)?;
    Ok(respond::json(&Moments { moments }))
}

fn moments(state: &State, query: &HistoryQuery) -> Result<Vec<Moment>, Problem> {
    let limit = within("limit", query.limit.unwrap_or(3600), 1, 3600)?;
    Ok(state.feed.history(|h| h.after(query.since, limit)))
}

const COLUMNS: &Columns = &[
    ("time", "/time"),
    ("frame", "/frame"),
    ("track", "/track"),
    ("user", "/user"),
    ("status", "/status"),
    ("x_m", "/x_m"),
    ("y_m", "/y_m"),
];

/// The same as a table (CSV), a row for each beam
///
/// Text that a spreadsheet would take for a formula begins with an apostrophe.
#[utoipa::path(get, path = "/v1/history.csv", tag = "positions", params(HistoryQuery),
    responses(
        (status = 200, description = "A header and a row for each beam, oldest first", body = String, content_type = "text/csv"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn history_csv(Shared(state): Shared<State>, Query(query): Query<HistoryQuery>) -> Result<Response, Problem> {
    let moments = moments(&state, &query)?;
    let make = move || {
        let row = |moment: &Moment, beam: &PastBeam| {
            let mut row = serde_json::to_value(beam).expect("beams are JSON");
            row["time"] = json!(moment.time);
            row["frame"] = json!(moment.frame);
            // As JSON has them: a centimetre, and not the digits by which a single-precision number misses it.
            for (key, metres) in [("x_m", beam.x_m), ("y_m", beam.y_m)] {
                row[key] = json!((f64::from(metres) * 100.0).round() / 100.0);
            }
            row
        };
        let beams = moments
            .iter()
            .flat_map(|m| m.emitters.iter().map(move |beam| row(m, beam)));
        [table::head(COLUMNS), table::rows(COLUMNS, beams)].concat()
    };
    let table = tokio::task::spawn_blocking(make).await.expect("writing does not panic");
    Ok(table::download("history.csv", table))
}
