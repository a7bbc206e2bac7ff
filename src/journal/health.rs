//! The journal's state for `/readyz`, metrics and the dashboard.

use std::path::{Path, PathBuf};

use crate::metric;

/// How the journal fares: for `/readyz`, metrics and the dashboard.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct Health {
    /// `None` where alerts are kept in memory only and a restart forgets them.
    #[schema(value_type = Option<String>)]
    pub path: Option<PathBuf>,
    /// `false` while the disk refuses writes; alert events then wait in memory.
    pub writable: bool,
    /// Why the last refused write failed, also after the disk is back.
    pub last_error: Option<String>,
    /// Alert events in memory that the disk has not taken.
    pub unwritten: usize,
    /// Alert events that found the memory full too; 0 unless the disk was gone for very long.
    pub lost: u64,
    pub size_bytes: u64,
}

impl Health {
    pub(super) fn working(&mut self, size_bytes: u64, unwritten: usize) {
        self.writable = true;
        self.unwritten = unwritten;
        self.size_bytes = size_bytes;
        self.report();
    }

    pub(super) fn failed(&mut self, error: String, unwritten: usize) {
        self.writable = false;
        self.last_error = Some(error);
        self.unwritten = unwritten;
        self.report();
    }

    fn report(&self) {
        metrics::gauge!(metric::JOURNAL_WRITABLE).set(f64::from(u8::from(self.writable)));
        metrics::gauge!(metric::JOURNAL_UNWRITTEN).set(self.unwritten as f64);
        metrics::gauge!(metric::JOURNAL_BYTES).set(self.size_bytes as f64);
    }
}

/// The journal with its write-ahead log, bytes.
pub(super) fn size(path: &Path) -> u64 {
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    [path, Path::new(&log)]
        .iter()
        .filter_map(|file| std::fs::metadata(file).ok())
        .map(|meta| meta.len())
        .sum()
}
