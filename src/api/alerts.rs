//! `/v1/alerts`: the list of alerts and one alert.

use axum::body::{Body, Bytes};
use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::Response;
use futures_util::{StreamExt, stream};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::extract::{Path, Query, within};
use super::problem::Problem;
use super::state::State;
use super::table::{self, Columns};
use super::{conditional, respond};
use crate::journal::{self, Cursor, Filter, Journal};
use crate::monitor::{Alert, AlertKind, AlertState};

const DEFAULT_LIMIT: usize = 100;
const MAX_LIMIT: usize = 1000;

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct ListQuery {
    state: Option<AlertState>,
    kind: Option<AlertKind>,
    /// Raised at this time or later
    #[param(value_type = Option<String>, format = DateTime)]
    since: Option<Timestamp>,
    /// Alerts on a page, 100 when left out
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
    /// `next_cursor` of the page before
    #[param(pattern = r"^[0-9a-f]{1,15}-[0-9a-f]{1,15}$")]
    cursor: Option<String>,
}

/// A page of alerts.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct Page {
    /// Newest first.
    pub(super) alerts: Vec<Alert>,
    /// What to give as `cursor` for the next page; null on the last.
    pub(super) next_cursor: Option<String>,
}

fn cursor(text: &str) -> Result<Cursor, Problem> {
    text.parse()
        .map_err(|e: journal::Error| Problem::new(StatusCode::BAD_REQUEST, format!("cursor: {e}")))
}

/// Runs a read of the journal where blocking is allowed.
pub(super) async fn read<T: Send + 'static>(
    state: &State,
    read: impl FnOnce(&Journal) -> Result<T, journal::Error> + Send + 'static,
) -> Result<T, Problem> {
    let journal = state.journal.clone();
    let outcome = tokio::task::spawn_blocking(move || read(&journal)).await;
    outcome.expect("a read does not panic").map_err(|e| {
        tracing::error!("the journal cannot be read: {e}");
        Problem::later(
            StatusCode::SERVICE_UNAVAILABLE,
            5,
            "the journal cannot be read at the moment",
        )
    })
}

/// Alerts, newest first
#[utoipa::path(get, path = "/v1/alerts", tag = "alerts", params(ListQuery),
    responses(
        (status = 200, description = "A page of alerts; a Link header leads to the next", body = Page),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn list(
    Shared(state): Shared<State>,
    Query(query): Query<ListQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    page(&state, &query, "/v1/alerts", &headers, |page| respond::json(&page)).await
}

/// The page that `query` asks for at `path`, written by `answer`, with a link to the next.
pub(super) async fn page(
    state: &State,
    query: &ListQuery,
    path: &str,
    headers: &HeaderMap,
    answer: impl FnOnce(Page) -> Response,
) -> Result<Response, Problem> {
    let version = state.feed.last_event();
    let limit = within("limit", query.limit.unwrap_or(DEFAULT_LIMIT), 1, MAX_LIMIT)?;
    let filter = Filter {
        state: query.state,
        kind: query.kind,
        since: query.since,
        after: query.cursor.as_deref().map(cursor).transpose()?,
    };
    let found = read(state, move |journal| journal.alerts(&filter, limit)).await?;
    let page = Page {
        next_cursor: found.next.map(|c| c.to_string()),
        alerts: found.alerts,
    };
    let next = page.next_cursor.as_deref();
    let link = next.and_then(|cursor| next_link(path, query, limit, cursor));
    let mut response = conditional::answer(headers, version, || answer(page));
    if let Some(link) = link {
        response.headers_mut().insert(header::LINK, link);
    }
    Ok(response)
}

fn next_link(path: &str, query: &ListQuery, limit: usize, cursor: &str) -> Option<HeaderValue> {
    let mut pairs = url::form_urlencoded::Serializer::new(String::new());
    let name = |value: serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    if let Some(state) = query.state {
        pairs.append_pair("state", &name(serde_json::json!(state)));
    }
    if let Some(kind) = query.kind {
        pairs.append_pair("kind", &name(serde_json::json!(kind)));
    }
    if let Some(since) = query.since {
        pairs.append_pair("since", &since.to_string());
    }
    pairs
        .append_pair("limit", &limit.to_string())
        .append_pair("cursor", cursor);
    HeaderValue::from_str(&format!("<{path}?{}>; rel=\"next\"", pairs.finish())).ok()
}

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct TableQuery {
    state: Option<AlertState>,
    kind: Option<AlertKind>,
    /// Raised at this time or later
    #[param(value_type = Option<String>, format = DateTime)]
    since: Option<Timestamp>,
}

const COLUMNS: &Columns = &[
    ("id", "/id"),
    ("kind", "/kind"),
    ("severity", "/severity"),
    ("state", "/state"),
    ("raised_at", "/raised_at"),
    ("cleared_at", "/cleared_at"),
    ("user", "/user"),
    ("x_m", "/x_m"),
    ("y_m", "/y_m"),
    ("cov_xx_m2", "/cov_m2/0/0"),
    ("cov_xy_m2", "/cov_m2/0/1"),
    ("cov_yy_m2", "/cov_m2/1/1"),
    ("claimed_x_m", "/claimed/x_m"),
    ("claimed_y_m", "/claimed/y_m"),
    ("source", "/source/kind"),
    ("frame", "/source/frame"),
    ("file", "/source/file"),
    ("acknowledged_at", "/acknowledgement/at"),
    ("acknowledged_by", "/acknowledgement/by"),
    ("note", "/acknowledgement/note"),
    ("evidence", "/evidence"),
    ("z_m", "/z_m"),
    ("latitude_deg", "/latitude_deg"),
    ("longitude_deg", "/longitude_deg"),
    ("height_m", "/height_m"),
];

/// Alerts as a table (CSV), newest first
///
/// All that match, without pages; `evidence` is JSON. Text that a spreadsheet would take for a formula begins with an apostrophe.
#[utoipa::path(get, path = "/v1/alerts.csv", tag = "alerts", params(TableQuery),
    responses(
        (status = 200, description = "A header and a row for each alert", body = String, content_type = "text/csv"),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn csv(Shared(state): Shared<State>, Query(query): Query<TableQuery>) -> Result<Response, Problem> {
    let page = move |after| {
        let filter = Filter {
            state: query.state,
            kind: query.kind,
            since: query.since,
            after,
        };
        let state = state.clone();
        async move { read(&state, move |journal| journal.alerts(&filter, MAX_LIMIT)).await }
    };
    let rows = |alerts: &[Alert]| {
        let object = |alert| serde_json::to_value(alert).expect("alerts are JSON");
        Bytes::from(table::rows(COLUMNS, alerts.iter().map(object)))
    };
    // A journal that cannot be read is said so while there is still a status to say it with.
    let first = page(None).await?;
    let begin = [Bytes::from(table::head(COLUMNS)), rows(&first.alerts)].map(Ok::<_, std::io::Error>);
    let rest = stream::try_unfold((page, first.next), move |(page, next)| async move {
        let Some(next) = next else { return Ok(None) };
        let found = page(Some(next))
            .await
            .map_err(|problem| std::io::Error::other(problem.detail))?;
        Ok(Some((rows(&found.alerts), (page, found.next))))
    });
    let body = Body::from_stream(stream::iter(begin).chain(rest));
    Ok(table::download("alerts.csv", body))
}

/// One alert
#[utoipa::path(get, path = "/v1/alerts/{id}", tag = "alerts",
    params(("id" = String, Path, description = "The alert's id")),
    responses(
        (status = 200, description = "The alert as it stands", body = Alert),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 400, description = "The path cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such alert", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn get(
    Shared(state): Shared<State>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let version = state.feed.last_event();
    let wanted = id.clone();
    let alert = read(&state, move |journal| journal.alert(&wanted)).await?;
    let alert = alert.ok_or_else(|| unknown(&id))?;
    Ok(conditional::answer(&headers, version, || respond::json(&alert)))
}

pub(super) fn unknown(id: &str) -> Problem {
    Problem::not_found(format!("there is no alert {id:?}"))
}
