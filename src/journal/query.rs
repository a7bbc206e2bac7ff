//! SQL reads of one store: alerts, events, deliveries, endpoints.

use std::collections::BTreeMap;

use jiff::Timestamp;
use rusqlite::types::Value;
use rusqlite::{OptionalExtension, Row, params};

use super::store::Store;
use super::{AuditEntry, AuditRecord, DeadLetter, EndpointRecord, Error, Waiting};
use crate::monitor::{Alert, AlertEvent, AlertKind, AlertState};
use crate::word::word;

/// Which alerts to list; the newest raised come first.
#[derive(Clone, Debug, Default)]
pub struct Filter {
    pub state: Option<AlertState>,
    pub kind: Option<AlertKind>,
    /// Raised at this time or later.
    pub since: Option<Timestamp>,
    /// Where the page before this one ended.
    pub after: Option<Cursor>,
}

/// A place in the list of alerts, opaque to clients.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cursor {
    raised_us: i64,
    first_seq: u64,
}

/// An alert event as it stands in the journal.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct Recorded {
    /// Grows with every event, over restarts too.
    pub seq: u64,
    /// When it happened, on the frames' clock.
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    #[serde(flatten)]
    pub event: AlertEvent,
}

pub(super) struct Listed {
    pub(super) cursor: Cursor,
    pub(super) alert: Alert,
}

impl std::fmt::Display for Cursor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:x}-{:x}", self.raised_us, self.first_seq)
    }
}

impl std::str::FromStr for Cursor {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let unknown = || Error::Cursor(text.chars().take(64).collect());
        let (raised, first) = text.split_once('-').ok_or_else(unknown)?;
        // A time before 1970 prints as its two's complement, so it is read back as one.
        let raised_us = u64::from_str_radix(raised, 16).map_err(|_| unknown())? as i64;
        let first_seq = u64::from_str_radix(first, 16).map_err(|_| unknown())?;
        Ok(Self { raised_us, first_seq })
    }
}

impl Store {
    /// Bodies of what operators have set, by id.
    pub(super) fn kept(&self, kind: &str) -> Result<Vec<String>, rusqlite::Error> {
        let mut statement = self
            .db
            .prepare_cached("SELECT body FROM kept WHERE kind = ?1 ORDER BY id")?;
        statement.query_map([kind], |row| row.get(0))?.collect()
    }

    pub(super) fn origins(&self) -> Result<BTreeMap<String, u64>, rusqlite::Error> {
        let mut rows = self.db.prepare_cached("SELECT source, last_seq FROM origin")?;
        rows.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect()
    }

    pub(super) fn alerts(&self, filter: &Filter, limit: usize) -> Result<Vec<Listed>, rusqlite::Error> {
        let mut sql = "SELECT raised_us, first_seq, body FROM alert WHERE 1".to_owned();
        let mut values: Vec<Value> = Vec::new();
        if let Some(state) = filter.state {
            sql += " AND state = ?";
            values.push(word(state).into());
        }
        if let Some(kind) = filter.kind {
            sql += " AND kind = ?";
            values.push(word(kind).into());
        }
        if let Some(since) = filter.since {
            sql += " AND raised_us >= ?";
            values.push(since.as_microsecond().into());
        }
        if let Some(after) = filter.after {
            sql += " AND (raised_us, first_seq) < (?, ?)";
            values.push(after.raised_us.into());
            values.push((after.first_seq as i64).into());
        }
        sql += " ORDER BY raised_us DESC, first_seq DESC LIMIT ?";
        values.push((limit as i64).into());
        let mut statement = self.db.prepare_cached(&sql)?;
        let rows = statement.query_map(rusqlite::params_from_iter(values), |row| {
            let cursor = Cursor {
                raised_us: row.get(0)?,
                first_seq: row.get(1)?,
            };
            Ok(body(row, 2)?.map(|alert| Listed { cursor, alert }))
        })?;
        rows.filter_map(Result::transpose).collect()
    }

    /// Alerts that are not cleared, oldest first.
    pub(super) fn open_alerts(&self) -> Result<Vec<Alert>, rusqlite::Error> {
        let mut statement = self
            .db
            .prepare_cached("SELECT body FROM alert WHERE state <> 'cleared' ORDER BY raised_us, first_seq")?;
        let rows = statement.query_map([], |row| body(row, 0))?;
        rows.filter_map(Result::transpose).collect()
    }

    pub(super) fn alert(&self, id: &str) -> Result<Option<Alert>, rusqlite::Error> {
        self.db
            .prepare_cached("SELECT body FROM alert WHERE id = ?1")?
            .query_row([id], |row| body(row, 0))
            .optional()
            .map(Option::flatten)
    }

    pub(super) fn alert_ids(&self) -> Result<std::collections::HashSet<String>, rusqlite::Error> {
        let mut statement = self.db.prepare_cached("SELECT id FROM alert")?;
        let rows = statement.query_map([], |row| row.get(0))?;
        rows.collect()
    }

    /// Newest first, older than `before` where it is given.
    pub(super) fn audit(&self, before: Option<u64>, limit: usize) -> Result<Vec<AuditRecord>, rusqlite::Error> {
        let before = before.and_then(|id| i64::try_from(id).ok()).unwrap_or(i64::MAX);
        let mut statement = self.db.prepare_cached(
            "SELECT id, at_us, action, actor, client, target, detail, count FROM audit
             WHERE id < ?1 ORDER BY id DESC LIMIT ?2",
        )?;
        let rows = statement.query_map(params![before, limit as i64], audit_record)?;
        rows.filter_map(Result::transpose).collect()
    }

    pub(super) fn events_of(&self, alert: &str, limit: usize) -> Result<Vec<Recorded>, rusqlite::Error> {
        let mut statement = self
            .db
            .prepare_cached("SELECT seq, at_us, body FROM event WHERE alert = ?1 ORDER BY seq LIMIT ?2")?;
        let rows = statement.query_map(params![alert, limit as i64], recorded)?;
        rows.filter_map(Result::transpose).collect()
    }

    pub(super) fn events_after(&self, seq: u64, limit: usize) -> Result<Vec<Recorded>, rusqlite::Error> {
        let mut statement = self
            .db
            .prepare_cached("SELECT seq, at_us, body FROM event WHERE seq > ?1 ORDER BY seq LIMIT ?2")?;
        let rows = statement.query_map(params![seq, limit as i64], recorded)?;
        rows.filter_map(Result::transpose).collect()
    }

    pub(super) fn waiting(&self, endpoint: &str, after: u64, limit: i64) -> Result<Vec<Waiting>, rusqlite::Error> {
        let mut statement = self.db.prepare_cached(
            "SELECT d.seq, d.endpoint, e.alert, e.recorded_us, d.step, d.attempts, d.next_us
             FROM delivery d JOIN event e USING (seq)
             WHERE d.endpoint = ?1 AND d.state = 'waiting' AND d.seq > ?2 ORDER BY d.seq LIMIT ?3",
        )?;
        let rows = statement.query_map(params![endpoint, after, limit], |row| {
            Ok(Waiting {
                seq: row.get(0)?,
                endpoint: row.get(1)?,
                alert: row.get(2)?,
                recorded_at: time(row.get(3)?),
                step: row.get(4)?,
                attempts: row.get(5)?,
                next_at: time(row.get(6)?),
            })
        })?;
        rows.collect()
    }

    pub(super) fn dead_letters(&self, endpoint: &str, limit: usize) -> Result<Vec<DeadLetter>, rusqlite::Error> {
        let mut statement = self.db.prepare_cached(
            "SELECT d.seq, e.alert, d.attempts, d.settled_us, d.error
             FROM delivery d JOIN event e USING (seq)
             WHERE d.endpoint = ?1 AND d.state = 'dead' ORDER BY d.seq LIMIT ?2",
        )?;
        let rows = statement.query_map(params![endpoint, limit as i64], |row| {
            Ok(DeadLetter {
                seq: row.get(0)?,
                alert: row.get(1)?,
                attempts: row.get(2)?,
                given_up_at: time(row.get::<_, Option<i64>>(3)?.unwrap_or_default()),
                error: row.get::<_, Option<String>>(4)?.unwrap_or_default(),
            })
        })?;
        rows.collect()
    }

    /// Deliveries of events after `until` are not counted among those sent or given up.
    pub(super) fn endpoint(&self, id: &str, until: i64) -> Result<EndpointRecord, rusqlite::Error> {
        let mut record = self
            .db
            .prepare_cached(
                "SELECT sent - (SELECT count(*) FROM delivery WHERE seq > ?2 AND endpoint = ?1 AND state = 'sent'),
                        last_success_us, last_failure_us, last_error, disabled_us FROM endpoint WHERE id = ?1",
            )?
            .query_row(params![id, until], |row| {
                Ok(EndpointRecord {
                    sent: row.get(0)?,
                    last_success: row.get::<_, Option<i64>>(1)?.map(time),
                    last_failure: row.get::<_, Option<i64>>(2)?.map(time),
                    last_error: row.get(3)?,
                    disabled_at: row.get::<_, Option<i64>>(4)?.map(time),
                    ..EndpointRecord::default()
                })
            })
            .optional()?
            .unwrap_or_default();
        let count = |state: &str, until: i64| -> Result<(u64, Option<i64>), rusqlite::Error> {
            self.db
                .prepare_cached(
                    "SELECT n, (SELECT recorded_us FROM event WHERE seq = oldest)
                     FROM (SELECT count(*) AS n, min(seq) AS oldest FROM delivery
                           WHERE endpoint = ?1 AND state = ?2 AND state <> 'sent' AND seq <= ?3)",
                )?
                .query_row(params![id, state, until], |row| Ok((row.get(0)?, row.get(1)?)))
        };
        let (waiting, oldest) = count("waiting", i64::MAX)?;
        record.waiting = waiting;
        record.oldest_waiting = oldest.map(time);
        record.dead = count("dead", until)?.0;
        Ok(record)
    }
}

/// Reads a JSON column. One that this version cannot read is logged and left out: it must not hide the others.
fn body<T: serde::de::DeserializeOwned>(row: &Row, column: usize) -> Result<Option<T>, rusqlite::Error> {
    let text: String = row.get(column)?;
    Ok(serde_json::from_str(&text)
        .inspect_err(|e| tracing::error!(error = %e, "the journal holds a record that cannot be read"))
        .ok())
}

fn recorded(row: &Row) -> Result<Option<Recorded>, rusqlite::Error> {
    let seq = row.get(0)?;
    let at = time(row.get(1)?);
    Ok(body(row, 2)?.map(|event| Recorded { seq, at, event }))
}

fn audit_record(row: &Row) -> Result<Option<AuditRecord>, rusqlite::Error> {
    let action: String = row.get(2)?;
    // A row that another version wrote must not hide the others.
    let Ok(action) = serde_json::from_value(action.into()) else {
        return Ok(None);
    };
    Ok(Some(AuditRecord {
        id: row.get(0)?,
        at: time(row.get(1)?),
        entry: AuditEntry {
            action,
            actor: row.get(3)?,
            client: row.get(4)?,
            target: row.get(5)?,
            detail: row.get(6)?,
            count: row.get(7)?,
        },
    }))
}

/// Microseconds since 1970, held to what a calendar can show: a damaged file must not be a panic.
fn time(us: i64) -> Timestamp {
    Timestamp::from_microsecond(us).unwrap_or(if us < 0 { Timestamp::MIN } else { Timestamp::MAX })
}
