//! The audit log: every change that a client made and every request that was refused, in the journal and in the log.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{MatchedPath, Request};
use jiff::Timestamp;

use super::client::{Caller, Client};
use crate::claim::escape_undisplayable;
use crate::journal::{AuditAction, AuditEntry, Journal};

/// Repetitions of one thing by one client share a row for this long: an access network posts claims many times a second.
const WINDOW: Duration = Duration::from_secs(60);
/// Things that may repeat at a time; what comes beyond them shares one row.
const MOST_WINDOWS: usize = 512;

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
