//! Opening a journal file: permissions, ownership check, migrations and pragmas.

use std::fs::{OpenOptions, Permissions};
use std::io::ErrorKind;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, OpenFlags, TransactionBehavior};
use url::Url;

use super::Error;

/// "OAPW": distinguishes a journal from any other SQLite file, here and for `file`.
const APPLICATION_ID: i64 = 0x4F41_5057;

/// Longest wait for another process (a backup, a shell) that holds the file.
const BUSY: Duration = Duration::from_millis(1000);

/// Pages a connection keeps in memory, KiB: a writer and some readers each have their own, and the system's own cache
/// stands behind them.
const CACHE_KIB: i64 = 512;

/// Mode of the journal's files: alerts and users' positions are for its owner only.
pub(super) const PRIVATE: u32 = 0o600;

/// Step k takes a journal from `user_version` k to k + 1. Never edit a step that was released: add one.
const MIGRATIONS: &[&str] = &[
    "
    CREATE TABLE journal (
        id       TEXT NOT NULL,
        last_seq INTEGER NOT NULL
    );
    INSERT INTO journal VALUES (lower(hex(randomblob(6))), 0);

    CREATE TABLE alert (
        id          TEXT PRIMARY KEY,
        kind        TEXT NOT NULL,
        state       TEXT NOT NULL,
        raised_us   INTEGER NOT NULL,
        first_seq   INTEGER NOT NULL,
        recorded_us INTEGER NOT NULL,
        body        TEXT NOT NULL
    );
    CREATE INDEX alert_newest ON alert (raised_us, first_seq);
    CREATE INDEX alert_open ON alert (state) WHERE state <> 'cleared';
    CREATE INDEX alert_oldest ON alert (recorded_us);

    CREATE TABLE event (
        seq         INTEGER PRIMARY KEY,
        alert       TEXT NOT NULL REFERENCES alert (id) ON DELETE CASCADE,
        at_us       INTEGER NOT NULL,
        recorded_us INTEGER NOT NULL,
        body        TEXT NOT NULL
    );
    CREATE INDEX event_alert ON event (alert, seq);

    CREATE TABLE delivery (
        seq        INTEGER NOT NULL REFERENCES event (seq) ON DELETE CASCADE,
        endpoint   TEXT NOT NULL,
        state      TEXT NOT NULL CHECK (state IN ('waiting', 'sent', 'dead')),
        step       INTEGER NOT NULL,
        attempts   INTEGER NOT NULL,
        next_us    INTEGER NOT NULL,
        settled_us INTEGER,
        error      TEXT,
        PRIMARY KEY (seq, endpoint)
    ) WITHOUT ROWID;
    CREATE INDEX delivery_unsent ON delivery (endpoint, state, seq) WHERE state <> 'sent';

    CREATE TABLE endpoint (
        id              TEXT PRIMARY KEY,
        sent            INTEGER NOT NULL DEFAULT 0,
        last_success_us INTEGER,
        last_failure_us INTEGER,
        last_error      TEXT,
        disabled_us     INTEGER
    );
",
    "
    CREATE TABLE audit (
        id     INTEGER PRIMARY KEY,
        at_us  INTEGER NOT NULL,
        action TEXT NOT NULL,
        actor  TEXT,
        client TEXT NOT NULL,
        target TEXT,
        detail TEXT,
        count  INTEGER NOT NULL
    );
",
    "
    CREATE TABLE origin (
        source   TEXT PRIMARY KEY,
        last_seq INTEGER NOT NULL
    ) WITHOUT ROWID;
",
    "
    CREATE TABLE kept (
        kind TEXT NOT NULL,
        id   TEXT NOT NULL,
        body TEXT NOT NULL,
        PRIMARY KEY (kind, id)
    ) WITHOUT ROWID;
",
];

/// Opens a journal for writing, creating or migrating it where needed. `None` is a journal in memory.
pub(super) fn open_writable(path: Option<&Path>) -> Result<Connection, Error> {
    let name = path.unwrap_or(Path::new(":memory:"));
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let unusable = |source: rusqlite::Error| match source.sqlite_error_code() {
        Some(rusqlite::ErrorCode::NotADatabase) => Error::Foreign { path: name.to_owned() },
        _ => Error::Unusable {
            path: name.to_owned(),
            source,
        },
    };
    if let Some(path) = path {
        create_private(path);
    }
    let mut db = Connection::open_with_flags(name, flags).map_err(unusable)?;
    db.busy_timeout(BUSY).map_err(unusable)?;
    db.pragma_update(None, "cache_size", -CACHE_KIB).map_err(unusable)?;
    check(&db, name, unusable)?;
    prepare(&mut db).map_err(unusable)?;
    if let Some(path) = path {
        make_private(path);
    }
    Ok(db)
}

/// Creates the file for its owner only, whatever the umask. SQLite gives the files beside it the same mode. A failure is
/// not reported here: opening the file reports it.
fn create_private(path: &Path) {
    let _ = OpenOptions::new().write(true).create_new(true).mode(PRIVATE).open(path);
}

/// Removes permissions that an earlier version, or a copy, gave to other users.
fn make_private(path: &Path) {
    for suffix in ["", "-wal", "-shm", ".lock"] {
        let file = beside(path, suffix);
        let is_open = std::fs::metadata(&file).is_ok_and(|meta| meta.permissions().mode() & 0o077 != 0);
        if is_open && let Err(error) = std::fs::set_permissions(&file, Permissions::from_mode(PRIVATE)) {
            tracing::warn!(path = %file.display(), %error, "other users of this machine can read the journal");
        }
    }
}

/// Opens a journal that exists for reading beside its writer; whether it sees what is written later. On a full or read-only disk there cannot be
/// the files that tell it: what a journal held when it was closed is read all the same.
pub(super) fn open_readable(path: &Path) -> Result<(Connection, bool), rusqlite::Error> {
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let open = |name: &Path, flags| {
        let db = Connection::open_with_flags(name, flags)?;
        db.busy_timeout(BUSY)?;
        db.pragma_update(None, "cache_size", -CACHE_KIB)?;
        pragma(&db, "user_version")?;
        Ok(db)
    };
    let failed = match open(path, flags) {
        Ok(db) => return Ok((db, true)),
        Err(error) => error,
    };
    let log = std::fs::metadata(beside(path, "-wal"));
    let is_closed = log.map_or_else(|e| e.kind() == ErrorKind::NotFound, |meta| meta.len() == 0);
    let url = std::path::absolute(path)
        .ok()
        .and_then(|path| Url::from_file_path(path).ok());
    match url.filter(|_| is_closed) {
        Some(mut url) => {
            url.set_query(Some("immutable=1"));
            open(Path::new(url.as_str()), flags | OpenFlags::SQLITE_OPEN_URI).map(|db| (db, false))
        }
        None => Err(failed),
    }
}

/// Whether no step of the schema was taken yet.
pub(super) fn is_blank(db: &Connection) -> Result<bool, rusqlite::Error> {
    Ok(pragma(db, "user_version")? == 0)
}

pub(super) fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

fn pragma(db: &Connection, name: &str) -> Result<i64, rusqlite::Error> {
    db.pragma_query_value(None, name, |row| row.get(0))
}

fn check(db: &Connection, path: &Path, unusable: impl Fn(rusqlite::Error) -> Error) -> Result<(), Error> {
    let tables: i64 = db
        .query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))
        .map_err(&unusable)?;
    let owner = pragma(db, "application_id").map_err(&unusable)?;
    if tables > 0 && owner != APPLICATION_ID {
        return Err(Error::Foreign { path: path.to_owned() });
    }
    let found = pragma(db, "user_version").map_err(&unusable)?;
    let known = MIGRATIONS.len() as i64;
    if found > known {
        return Err(Error::NewerSchema {
            path: path.to_owned(),
            found,
            known,
        });
    }
    Ok(())
}

fn prepare(db: &mut Connection) -> Result<(), rusqlite::Error> {
    // Only takes effect in a file that has no tables yet.
    db.pragma_update(None, "auto_vacuum", "INCREMENTAL")?;
    db.pragma_update_and_check(None, "journal_mode", "WAL", |_| Ok(()))?;
    db.pragma_update(None, "synchronous", "FULL")?;
    db.pragma_update(None, "foreign_keys", true)?;
    db.pragma_update(None, "journal_size_limit", 4 << 20)?;
    if pragma(db, "user_version")? == MIGRATIONS.len() as i64 {
        return Ok(());
    }
    let tx = db.transaction_with_behavior(TransactionBehavior::Immediate)?;
    // Read again under the lock: another process may have migrated in between.
    let from = pragma(&tx, "user_version")?;
    for step in MIGRATIONS.iter().skip(from as usize) {
        tx.execute_batch(step)?;
    }
    tx.pragma_update(None, "application_id", APPLICATION_ID)?;
    tx.pragma_update(None, "user_version", MIGRATIONS.len() as i64)?;
    tx.commit()
}
