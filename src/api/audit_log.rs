//! `/v1/audit`: the audit log, page by page.

use axum::extract::State as Shared;
use axum::http::StatusCode;
use axum::response::Response;
use serde::{Deserialize, Serialize};

use super::extract::{Query, within};
use super::problem::Problem;
use super::state::State;
use super::{alerts, respond};
use crate::journal::AuditRecord;

const DEFAULT_LIMIT: usize = 100;
const MAX_LIMIT: usize = 1000;

#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub struct AuditQuery {
    /// Rows on a page, 100 when left out
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
    /// `next_before` of the page before
    before: Option<u64>,
}

/// A page of the audit log.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct AuditPage {
    /// Newest first.
    records: Vec<AuditRecord>,
    /// What to give as `before` for the next page; null on the last.
    next_before: Option<u64>,
}

/// Who acknowledged alerts, posted claims, changed webhooks, or was refused
///
/// Needs a token with full access where tokens are asked for. Claims and refusals that repeat within a minute share a row.
#[utoipa::path(get, path = "/v1/audit", tag = "monitor", params(AuditQuery),
    responses(
        (status = 200, description = "A page of the audit log", body = AuditPage),
        (status = 400, description = "A parameter cannot be read", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "The token may only look", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The journal cannot be read", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn list(Shared(state): Shared<State>, Query(query): Query<AuditQuery>) -> Result<Response, Problem> {
    let limit = within("limit", query.limit.unwrap_or(DEFAULT_LIMIT), 1, MAX_LIMIT)?;
    if let Some(found) = query.before.filter(|before| i64::try_from(*before).is_err()) {
        let detail = format!("before: expected the id of a row, found {found}");
        return Err(Problem::new(StatusCode::BAD_REQUEST, detail));
    }
    let mut records = alerts::read(&state, move |journal| journal.audit_log(query.before, limit + 1)).await?;
    let has_more = records.len() > limit;
    records.truncate(limit);
    let next_before = records.last().filter(|_| has_more).map(|record| record.id);
    Ok(respond::json(&AuditPage { records, next_before }))
}
