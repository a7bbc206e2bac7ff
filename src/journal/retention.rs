//! Removal of old cleared alerts, by age and by size.

use jiff::{SignedDuration, Timestamp};
use rusqlite::params;

use super::Config;
use super::store::Store;

/// Alerts removed in one transaction: bounds how long a write may have to wait.
const CHUNK: usize = 500;

/// Rows of the audit log kept on disk. At about 150 bytes each they take some 15 MB; older ones go, so that no flood of requests fills it.
const MOST_AUDIT_ROWS: usize = 100_000;
/// And by a journal in memory.
const MOST_AUDIT_ROWS_IN_MEMORY: usize = 2_000;

/// Alerts are kept in memory up to this size, MB.
const MEMORY_MB: u32 = 16;

/// What is kept. Open alerts and deliveries that wait always are.
#[derive(Clone, Copy, Debug)]
pub(super) struct Retention {
    keep: SignedDuration,
    max_bytes: i64,
}

/// What one round of retention did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Removed {
    pub(super) alerts: usize,
    /// Deliveries given up because their endpoint has been disabled, or out of the config, all that time.
    pub(super) deliveries: usize,
    /// Larger than allowed even so.
    pub(super) oversize: bool,
}

impl Retention {
    pub(super) fn new(config: &Config) -> Self {
        let max_mb = match config.path {
            Some(_) => config.max_mb,
            None => config.max_mb.min(MEMORY_MB),
        };
        Self {
            keep: SignedDuration::from_hours(24 * i64::from(config.keep_days)),
            max_bytes: i64::from(max_mb) * 1_000_000,
        }
    }

    pub(super) fn exceeded_by(&self, bytes: u64) -> bool {
        i64::try_from(bytes).is_ok_and(|bytes| bytes > self.max_bytes)
    }
}

impl Store {
    pub(super) fn maintain(&mut self, retention: Retention, now: Timestamp) -> Result<Removed, rusqlite::Error> {
        let cutoff = now
            .saturating_sub(retention.keep)
            .unwrap_or(Timestamp::MIN)
            .as_microsecond();
        self.trim_audit(cutoff, self.db.path().is_none_or(str::is_empty))?;
        let mut removed = Removed {
            deliveries: self.give_up_unwanted(cutoff, now)?,
            ..Removed::default()
        };
        loop {
            let n = self.remove_cleared(cutoff, CHUNK)?;
            removed.alerts += n;
            if n < CHUNK {
                break;
            }
        }
        // A tenth is freed at once, so that not every later write has to free its own.
        let target = retention.max_bytes - retention.max_bytes / 10;
        if self.used_bytes()? > retention.max_bytes {
            while self.used_bytes()? > target {
                let n = self.remove_cleared(i64::MAX, CHUNK)?;
                removed.alerts += n;
                if n == 0 {
                    break;
                }
            }
        }
        removed.oversize = self.used_bytes()? > retention.max_bytes;
        if removed.alerts > 0 {
            // The pragma gives a row for each page that it frees.
            let mut vacuum = self.db.prepare("PRAGMA incremental_vacuum")?;
            let mut rows = vacuum.query([])?;
            while rows.next()?.is_some() {}
        }
        Ok(removed)
    }

    /// Removes rows from before `cutoff_us` and all but the newest.
    fn trim_audit(&self, cutoff_us: i64, in_memory: bool) -> Result<usize, rusqlite::Error> {
        let most = if in_memory {
            MOST_AUDIT_ROWS_IN_MEMORY
        } else {
            MOST_AUDIT_ROWS
        };
        self.db.execute(
            "DELETE FROM audit WHERE at_us < ?1 OR id <= (SELECT id FROM audit ORDER BY id DESC LIMIT 1 OFFSET ?2)",
            params![cutoff_us, most as i64],
        )
    }

    pub(super) fn newest_recorded(&self) -> Result<Option<Timestamp>, rusqlite::Error> {
        let us: Option<i64> = self
            .db
            .query_row("SELECT max(recorded_us) FROM alert", [], |row| row.get(0))?;
        Ok(us.and_then(|us| Timestamp::from_microsecond(us).ok()))
    }

    /// Removes the oldest cleared alerts that no delivery waits for, with events and deliveries.
    fn remove_cleared(&mut self, before_us: i64, limit: usize) -> Result<usize, rusqlite::Error> {
        self.db.execute(
            "DELETE FROM alert WHERE id IN (
                SELECT id FROM alert a
                WHERE state = 'cleared' AND recorded_us < ?1 AND NOT EXISTS (
                    SELECT 1 FROM event e JOIN delivery d USING (seq) WHERE e.alert = a.id AND d.state = 'waiting')
                ORDER BY recorded_us LIMIT ?2)",
            params![before_us, limit as i64],
        )
    }

    fn give_up_unwanted(&mut self, before_us: i64, now: Timestamp) -> Result<usize, rusqlite::Error> {
        let subscriptions = self.subscriptions.load();
        let wanted: Vec<&str> = subscriptions.iter().map(|s| s.endpoint.as_str()).collect();
        self.db.execute(
            "UPDATE delivery SET state = 'dead', settled_us = ?3, error = 'the endpoint is disabled or no longer in the config'
             WHERE state = 'waiting'
               AND seq IN (SELECT seq FROM event WHERE recorded_us < ?1)
               AND (endpoint NOT IN (SELECT value FROM json_each(?2))
                    OR endpoint IN (SELECT id FROM endpoint WHERE disabled_us IS NOT NULL))",
            params![
                before_us,
                serde_json::to_string(&wanted).expect("strings serialise"),
                now.as_microsecond()
            ],
        )
    }

    /// Bytes in use; pages that are free do not count.
    fn used_bytes(&self) -> Result<i64, rusqlite::Error> {
        self.db.query_row(
            "SELECT (page_count - freelist_count) * page_size FROM pragma_page_count, pragma_freelist_count, pragma_page_size",
            [],
            |row| row.get(0),
        )
    }
}
