//! The audit log: every change that a client made and every request that was refused, in the journal and in the log.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{MatchedPath, Request, State as Shared};
use axum::http::StatusCode;
use axum::response::Response;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::auth::Actor;
use super::client::Client;
use super::extract::{Query, within};
use super::problem::Problem;
use super::state::State;
use super::{alerts, respond};
use crate::claim::escape_undisplayable;
use crate::journal::{AuditAction, AuditEntry, AuditRecord, Journal};

/// Repetitions of one thing by one client share a row for this long: an access network posts claims many times a second.
const WINDOW: Duration = Duration::from_secs(60);
/// Things that may repeat at a time; what comes beyond them shares one row.
const MOST_WINDOWS: usize = 512;

const DEFAULT_LIMIT: usize = 100;
const MAX_LIMIT: usize = 1000;

/// Writes the audit log. Clones share it.
#[derive(Clone)]
pub struct Audit(Arc<Inner>);

struct Inner {
    journal: Journal,
    windows: Mutex<HashMap<Key, Window>>,
}

/// What repetitions have in common.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Key {
    action: AuditAction,
    actor: Option<String>,
    client: String,
    target: Option<String>,
}

/// What has been repeated since the row that began the window.
struct Window {
    began: Instant,
    tally: Tally,
}

#[derive(Clone, Debug, Default)]
struct Tally {
    requests: u64,
    accepted: u64,
    refused: u64,
    detail: Option<String>,
}

/// Who sends a request, for the handlers that change something.
#[derive(Clone, Debug)]
pub struct Caller {
    pub actor: Actor,
    pub client: Client,
}

impl Caller {
    pub fn name(&self) -> Option<String> {
        self.actor.0.as_deref().map(str::to_owned)
    }
}

impl<S: Send + Sync> axum::extract::FromRequestParts<S> for Caller {
    type Rejection = std::convert::Infallible;

    async fn from_request_parts(parts: &mut axum::http::request::Parts, _: &S) -> Result<Self, Self::Rejection> {
        Ok(Self {
            actor: parts.extensions.get::<Actor>().cloned().unwrap_or_default(),
            client: parts.extensions.get::<Client>().copied().unwrap_or(Client::Unix),
        })
    }
}

impl Audit {
    pub fn new(journal: Journal) -> Self {
        let windows = Mutex::default();
        Self(Arc::new(Inner { journal, windows }))
    }

    /// One change, in a row of its own.
    pub fn change(&self, action: AuditAction, caller: &Caller, target: &str, detail: Option<String>) {
        let key = Key {
            action,
            actor: caller.name(),
            client: caller.client.to_string(),
            target: Some(target.to_owned()),
        };
        let tally = Tally {
            requests: 1,
            detail,
            ..Tally::default()
        };
        self.write(key, tally);
    }

    /// Claims that were posted; repetitions within a minute share a row.
    pub fn claims(&self, caller: &Caller, accepted: usize, refused: usize) {
        let key = Key {
            action: AuditAction::PostClaims,
            actor: caller.name(),
            client: caller.client.to_string(),
            target: None,
        };
        let tally = Tally {
            requests: 1,
            accepted: accepted as u64,
            refused: refused as u64,
            detail: None,
        };
        self.repeatable(key, tally);
    }

    /// A request that was refused; repetitions within a minute share a row. The route's pattern stands for the path, so that
    /// paths made up by clients make no rows of their own.
    pub fn refused(&self, request: &Request, client: Option<Client>, actor: Option<&str>, reason: &str) {
        let route = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
        let method = match request.method().as_str() {
            known @ ("GET" | "HEAD" | "POST" | "PUT" | "DELETE" | "OPTIONS") => known,
            _ => "other",
        };
        let key = Key {
            action: AuditAction::Refused,
            actor: actor.map(str::to_owned),
            client: client.map_or_else(|| "unknown".to_owned(), |c| c.to_string()),
            target: Some(format!("{method} {}", route.unwrap_or("elsewhere"))),
        };
        let tally = Tally {
            requests: 1,
            detail: Some(reason.to_owned()),
            ..Tally::default()
        };
        self.repeatable(key, tally);
    }

    fn repeatable(&self, mut key: Key, tally: Tally) {
        let mut windows = self.0.windows.lock().unwrap_or_else(PoisonError::into_inner);
        if windows.len() >= MOST_WINDOWS && !windows.contains_key(&key) {
            key.client = "others".to_owned();
            key.actor = None;
            key.target = None;
        }
        if let Some(window) = windows.get_mut(&key) {
            window.tally.requests += 1;
            window.tally.accepted += tally.accepted;
            window.tally.refused += tally.refused;
            window.tally.detail = tally.detail;
            return;
        }
        let window = Window {
            began: Instant::now(),
            tally: Tally::default(),
        };
        windows.insert(key.clone(), window);
        drop(windows);
        self.write(key, tally);
    }

    /// Writes the rows of windows that are over; all of them when `at_end`. To be called every second or so.
    pub fn flush(&self, at_end: bool) {
        let mut over = Vec::new();
        let mut windows = self.0.windows.lock().unwrap_or_else(PoisonError::into_inner);
        windows.retain(|key, window| {
            let stays = !at_end && window.began.elapsed() < WINDOW;
            if !stays && window.tally.requests > 0 {
                over.push((key.clone(), window.tally.clone()));
            }
            stays
        });
        drop(windows);
        for (key, tally) in over {
            self.write(key, tally);
        }
    }

    fn write(&self, key: Key, tally: Tally) {
        let detail = match key.action {
            AuditAction::PostClaims => Some(format!("{} accepted, {} refused", tally.accepted, tally.refused)),
            _ => tally.detail,
        };
        let entry = AuditEntry {
            action: key.action,
            actor: key.actor,
            client: key.client,
            target: key.target,
            detail,
            count: tally.requests,
        };
        let shown = |text: &Option<String>| text.as_deref().map(|t| escape_undisplayable(t).into_owned());
        tracing::info!(
            target: "oapwatch::audit",
            action = serde_json::to_value(entry.action).ok().as_ref().and_then(|a| a.as_str()),
            actor = entry.actor,
            client = entry.client,
            object = shown(&entry.target),
            detail = shown(&entry.detail),
            count = entry.count,
            "audit"
        );
        if !self.0.journal.audit(entry, Timestamp::now()) {
            tracing::warn!("a row of the audit log is lost to the journal: too many wait for its disk");
        }
    }
}

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
