//! Why the journal cannot be opened, written or read.

use std::path::PathBuf;

/// Why the journal cannot be opened, written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: schema version {found} was written by a newer oapwatch; this one knows versions up to {known}")]
    NewerSchema { path: PathBuf, found: i64, known: i64 },
    #[error("{path}: not an oapwatch journal; name another file in [journal] path, or move this one away")]
    Foreign { path: PathBuf },
    #[error("{path}: another oapwatch has this journal open")]
    InUse { path: PathBuf },
    #[error("{path}: cannot be used as a journal: {source}")]
    Unusable { path: PathBuf, source: rusqlite::Error },
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{lost} alert events were lost: {limit} are already waiting for the disk")]
    BacklogFull { lost: u64, limit: usize },
    #[error("the disk takes too long")]
    Hung,
    #[error("the journal's disk thread ended")]
    Closed,
    #[error("reading the journal broke off inside oapwatch")]
    Panicked,
    #[error("the journal cannot be read: {0}")]
    Read(#[from] rusqlite::Error),
    #[error("`{0}` is not a cursor of this list")]
    Cursor(String),
}

/// Whether the same write may succeed later, because the fault is the disk's and not the file's.
pub(super) fn is_passing(error: &rusqlite::Error) -> bool {
    use rusqlite::ErrorCode::*;
    matches!(
        error.sqlite_error_code(),
        Some(DiskFull | ReadOnly | SystemIoFailure | DatabaseBusy | DatabaseLocked | OutOfMemory)
    )
}
