//! SQL writes of one store: a batch of changes in one transaction.

use std::path::Path;
use std::sync::Arc;

use jiff::Timestamp;
use rusqlite::{Connection, TransactionBehavior, params};

use super::origin::Origin;
use super::outbox::Subscriptions;
use super::{Attempt, AuditRecord, Error, Outcome, schema};
use crate::monitor::{AlertEvent, AlertEventKind};
use crate::word::word;

/// One change of the journal. Applying it must never fail for what it holds, only for the disk: a write
/// that is refused for its content would hold up all that wait behind it.
#[derive(Clone, Debug)]
pub(super) enum Write {
    Event {
        seq: u64,
        event: Arc<AlertEvent>,
        at: Timestamp,
        now: Timestamp,
        /// Where it came from, when another journal had it first.
        origin: Option<Origin>,
    },
    Attempt(Attempt),
    Disable {
        endpoint: String,
        at: Timestamp,
        reason: String,
    },
    Enable {
        endpoint: String,
    },
    Replay {
        endpoint: String,
        /// All dead letters when `None`.
        seq: Option<u64>,
        at: Timestamp,
    },
    Maintain {
        now: Timestamp,
    },
    Audit(Arc<AuditRecord>),
    /// What an operator has set, to be read again at the next start; forgotten without a body.
    Keep {
        kind: &'static str,
        id: String,
        body: Option<String>,
    },
}

impl Write {
    /// The wall clock when it was made, where it says so.
    pub(super) fn now(&self) -> Option<Timestamp> {
        match self {
            Self::Event { now, .. } | Self::Maintain { now } => Some(*now),
            Self::Attempt(Attempt { at, .. }) | Self::Disable { at, .. } | Self::Replay { at, .. } => Some(*at),
            Self::Audit(record) => Some(record.at),
            Self::Enable { .. } | Self::Keep { .. } => None,
        }
    }
}

/// One SQLite connection with the journal's statements.
pub(super) struct Store {
    pub(super) db: Connection,
    pub(super) subscriptions: Subscriptions,
    /// Whether what another connection writes is seen.
    pub(super) sees_changes: bool,
}

impl Store {
    pub(super) fn open(path: Option<&Path>, subscriptions: Subscriptions) -> Result<Self, Error> {
        let db = schema::open_writable(path)?;
        Ok(Self {
            db,
            subscriptions,
            sees_changes: true,
        })
    }

    pub(super) fn open_readable(path: &Path) -> Result<Self, rusqlite::Error> {
        let (db, sees_changes) = schema::open_readable(path)?;
        Ok(Self {
            db,
            subscriptions: Subscriptions::default(),
            sees_changes,
        })
    }

    /// The journal's own random name and the last sequence number it gave out.
    pub(super) fn identity(&self) -> Result<(String, u64), rusqlite::Error> {
        self.db.query_row("SELECT id, last_seq FROM journal", [], |row| {
            Ok((row.get(0)?, row.get(1)?))
        })
    }

    /// Writes all of it or, on an error, nothing.
    pub(super) fn apply<'a>(&mut self, writes: impl IntoIterator<Item = &'a Write>) -> Result<(), rusqlite::Error> {
        let tx = self.db.transaction_with_behavior(TransactionBehavior::Immediate)?;
        for write in writes {
            match write {
                Write::Event {
                    seq,
                    event,
                    at,
                    now,
                    origin,
                } => {
                    put_event(&tx, *seq, event, *at, *now)?;
                    if let Some(origin) = origin {
                        put_origin(&tx, origin)?;
                    }
                    for subscription in self.subscriptions.load().iter().filter(|s| s.wants(event)) {
                        tx.prepare_cached(
                            "INSERT OR REPLACE INTO delivery VALUES (?1, ?2, 'waiting', 0, 0, ?3, NULL, NULL)",
                        )?
                        .execute(params![
                            *seq,
                            subscription.endpoint,
                            now.as_microsecond()
                        ])?;
                    }
                }
                Write::Attempt(attempt) => put_attempt(&tx, attempt)?,
                Write::Disable { endpoint, at, reason } => {
                    tx.prepare_cached(
                        "INSERT INTO endpoint (id, disabled_us, last_failure_us, last_error) VALUES (?1, ?2, ?2, ?3)
                         ON CONFLICT (id) DO UPDATE SET disabled_us = ?2, last_failure_us = ?2, last_error = ?3",
                    )?
                    .execute(params![endpoint, at.as_microsecond(), reason])?;
                }
                Write::Enable { endpoint } => {
                    tx.execute("UPDATE endpoint SET disabled_us = NULL WHERE id = ?1", [endpoint])?;
                }
                Write::Replay { endpoint, seq, at } => {
                    tx.execute(
                        "UPDATE delivery SET state = 'waiting', step = 0, next_us = ?3
                         WHERE endpoint = ?1 AND state = 'dead' AND (?2 IS NULL OR seq = ?2)",
                        params![endpoint, seq, at.as_microsecond()],
                    )?;
                }
                Write::Audit(record) => put_audit(&tx, record)?,
                Write::Keep { kind, id, body } => put_kept(&tx, kind, id, body.as_deref())?,
                Write::Maintain { .. } => {}
            }
        }
        tx.commit()
    }
}

fn put_event(
    tx: &Connection,
    seq: u64,
    event: &AlertEvent,
    at: Timestamp,
    now: Timestamp,
) -> Result<(), rusqlite::Error> {
    let alert = &event.alert;
    tx.prepare_cached(
        "INSERT INTO alert (id, kind, state, raised_us, first_seq, recorded_us, body) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)
         ON CONFLICT (id) DO UPDATE SET kind = ?2, state = ?3, raised_us = ?4, recorded_us = ?6, body = ?7,
             first_seq = CASE WHEN ?8 THEN ?5 ELSE first_seq END",
    )?
    .execute(params![
        alert.id,
        word(alert.kind),
        word(alert.state),
        alert.raised_at.as_microsecond(),
        seq,
        now.as_microsecond(),
        json(alert),
        event.event == AlertEventKind::Raised,
    ])?;
    tx.prepare_cached("INSERT OR REPLACE INTO event VALUES (?1, ?2, ?3, ?4, ?5)")?
        .execute(params![
            seq,
            alert.id,
            at.as_microsecond(),
            now.as_microsecond(),
            json(event)
        ])?;
    tx.prepare_cached("UPDATE journal SET last_seq = max(last_seq, ?1)")?
        .execute([seq])?;
    Ok(())
}

fn put_origin(tx: &Connection, origin: &Origin) -> Result<(), rusqlite::Error> {
    tx.prepare_cached(
        "INSERT INTO origin VALUES (?1, ?2) ON CONFLICT (source) DO UPDATE SET last_seq = max(last_seq, ?2)",
    )?
    .execute(params![origin.source.as_ref(), origin.seq])?;
    Ok(())
}

fn put_audit(tx: &Connection, record: &AuditRecord) -> Result<(), rusqlite::Error> {
    // A write that is repeated after a failure finds its row in place.
    let entry = &record.entry;
    tx.prepare_cached("INSERT OR IGNORE INTO audit VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")?
        .execute(params![
            record.id,
            record.at.as_microsecond(),
            word(entry.action),
            entry.actor,
            entry.client,
            entry.target,
            entry.detail,
            entry.count,
        ])?;
    Ok(())
}

fn put_kept(tx: &Connection, kind: &str, id: &str, body: Option<&str>) -> Result<(), rusqlite::Error> {
    match body {
        Some(body) => tx
            .prepare_cached("INSERT OR REPLACE INTO kept VALUES (?1, ?2, ?3)")?
            .execute(params![kind, id, body])?,
        None => tx
            .prepare_cached("DELETE FROM kept WHERE kind = ?1 AND id = ?2")?
            .execute(params![kind, id])?,
    };
    Ok(())
}

fn put_attempt(tx: &Connection, attempt: &Attempt) -> Result<(), rusqlite::Error> {
    let at = attempt.at.as_microsecond();
    let (state, step, next, error) = match &attempt.outcome {
        Outcome::Withheld => {
            tx.prepare_cached("DELETE FROM delivery WHERE seq = ?1 AND endpoint = ?2")?
                .execute(params![attempt.seq, attempt.endpoint])?;
            return Ok(());
        }
        Outcome::Sent => ("sent", None, None, None),
        Outcome::Retry { step, next_at, error } => {
            ("waiting", Some(*step), Some(next_at.as_microsecond()), Some(error))
        }
        Outcome::Dead { error } => ("dead", None, None, Some(error)),
    };
    tx.prepare_cached(
        "UPDATE delivery SET state = ?3, attempts = attempts + 1, step = coalesce(?4, step), next_us = coalesce(?5, next_us),
             settled_us = ?6, error = ?7
         WHERE seq = ?1 AND endpoint = ?2",
    )?
    .execute(params![attempt.seq, attempt.endpoint, state, step, next, at, error])?;
    let statement = match attempt.outcome {
        Outcome::Sent => {
            "INSERT INTO endpoint (id, sent, last_success_us) VALUES (?1, 1, ?2)
             ON CONFLICT (id) DO UPDATE SET sent = sent + 1, last_success_us = ?2"
        }
        _ => {
            "INSERT INTO endpoint (id, last_failure_us, last_error) VALUES (?1, ?2, ?3)
             ON CONFLICT (id) DO UPDATE SET last_failure_us = ?2, last_error = ?3"
        }
    };
    let mut statement = tx.prepare_cached(statement)?;
    match error {
        None => statement.execute(params![attempt.endpoint, at])?,
        Some(error) => statement.execute(params![attempt.endpoint, at, error])?,
    };
    Ok(())
}

fn json<T: serde::Serialize>(value: &T) -> String {
    serde_json::to_string(value).expect("alerts hold no maps with keys other than strings")
}
