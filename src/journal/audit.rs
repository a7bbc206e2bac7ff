//! The audit log: who acknowledged alerts, posted claims, changed webhooks, or was refused.

use jiff::Timestamp;
use rusqlite::{Connection, Row, params};

use super::query::time;
use super::store::{Store, word};

/// Rows kept on disk. At about 150 bytes each they take some 15 MB; older ones go, so that no flood of requests fills it.
const MOST_ROWS: usize = 100_000;
/// Rows kept by a journal in memory.
const MOST_ROWS_IN_MEMORY: usize = 2_000;

/// What somebody did, or tried to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub enum AuditAction {
    #[serde(rename = "alert.acknowledge")]
    Acknowledge,
    #[serde(rename = "alert.unacknowledge")]
    Unacknowledge,
    #[serde(rename = "claims.post")]
    PostClaims,
    #[serde(rename = "webhook.replay")]
    ReplayWebhook,
    #[serde(rename = "webhook.enable")]
    EnableWebhook,
    /// A request was refused: wrong token, foreign host or origin, too many requests.
    #[serde(rename = "request.refused")]
    Refused,
}

/// Something for the audit log.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct AuditEntry {
    pub action: AuditAction,
    /// The name of the token that was used; null where it has none, or none was asked for.
    pub actor: Option<String>,
    /// Network address of the client, or "unix".
    pub client: String,
    /// What was acted on: an alert's id, a webhook's name, a route.
    pub target: Option<String>,
    /// The note of an acknowledgement, the outcome of claims, the reason of a refusal.
    pub detail: Option<String>,
    /// Requests that this row stands for: repetitions within a minute share one.
    pub count: u64,
}

/// A row of the audit log.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct AuditRecord {
    /// Grows with time; the place in the list.
    pub id: u64,
    /// Wall clock.
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    #[serde(flatten)]
    pub entry: AuditEntry,
}

impl Store {
    /// Newest first, older than `before` where it is given.
    pub(super) fn audit(&self, before: Option<u64>, limit: usize) -> Result<Vec<AuditRecord>, rusqlite::Error> {
        let before = before.and_then(|id| i64::try_from(id).ok()).unwrap_or(i64::MAX);
        let mut statement = self.db.prepare_cached(
            "SELECT id, at_us, action, actor, client, target, detail, count FROM audit
             WHERE id < ?1 ORDER BY id DESC LIMIT ?2",
        )?;
        let rows = statement.query_map(params![before, limit as i64], record)?;
        rows.filter_map(Result::transpose).collect()
    }

    /// Removes rows from before `cutoff_us` and all but the newest.
    pub(super) fn trim_audit(&self, cutoff_us: i64, in_memory: bool) -> Result<usize, rusqlite::Error> {
        let most = if in_memory { MOST_ROWS_IN_MEMORY } else { MOST_ROWS };
        self.db.execute(
            "DELETE FROM audit WHERE at_us < ?1 OR id <= (SELECT id FROM audit ORDER BY id DESC LIMIT 1 OFFSET ?2)",
            params![cutoff_us, most as i64],
        )
    }
}

fn record(row: &Row) -> Result<Option<AuditRecord>, rusqlite::Error> {
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

pub(super) fn put(tx: &Connection, record: &AuditRecord) -> Result<(), rusqlite::Error> {
    // A write that is repeated after a failure finds its row in place.
    let entry = &record.entry;
    tx.prepare_cached("INSERT OR IGNORE INTO audit VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")?
        .execute(params![
            record.id,
            record.at.as_microsecond(),
            word(&entry.action),
            entry.actor,
            entry.client,
            entry.target,
            entry.detail,
            entry.count,
        ])?;
    Ok(())
}
