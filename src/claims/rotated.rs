//! Log files that stood at a log's path before it was rotated, gzip'd or not.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use flate2::bufread::MultiGzDecoder;

const GZIP: [u8; 2] = [0x1f, 0x8b];
/// A gzip'd log that is longer when unpacked is refused: it would fill the disk. A day of 1,000 users at 1 Hz takes some 8 GB
/// as NDJSON; such logs are rotated more often.
const MOST_UNPACKED: u64 = 8 << 30;

/// Opens a log; a gzip'd one is unpacked into a temporary file that has no name.
pub(super) fn open(path: &Path) -> io::Result<File> {
    let mut file = File::open(path)?;
    let mut head = Vec::new();
    (&file).take(GZIP.len() as u64).read_to_end(&mut head)?;
    file.rewind()?;
    if head != GZIP {
        return Ok(file);
    }
    let mut unpacked = tempfile::tempfile()?;
    let mut lines = MultiGzDecoder::new(BufReader::new(file)).take(MOST_UNPACKED + 1);
    if io::copy(&mut lines, &mut unpacked)? > MOST_UNPACKED {
        let detail = format!("expected at most {MOST_UNPACKED} bytes when unpacked, found more");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, detail));
    }
    unpacked.rewind()?;
    Ok(unpacked)
}

/// Rotated files of the log at `path` with the time each was last written, newest first: `path.1`, `path.2.gz`, `path-20261121.gz`.
pub(super) fn predecessors(path: &Path) -> Vec<(SystemTime, PathBuf)> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let Some(name) = path.file_name().and_then(|name| name.to_str()) else {
        return Vec::new();
    };
    // A folder that cannot be listed has no rotated logs for us.
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<_> = entries
        .filter(|entry| entry.file_name().to_str().is_some_and(|other| is_rotated(name, other)))
        .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
        .collect();
    found.sort();
    found.reverse();
    found
}

fn is_rotated(name: &str, other: &str) -> bool {
    let Some(suffix) = other.strip_prefix(name) else {
        return false;
    };
    let suffix = suffix.strip_suffix(".gz").unwrap_or(suffix);
    let mut rest = suffix.chars();
    matches!(rest.next(), Some('.' | '-'))
        && suffix.len() > 1
        && rest.all(|c| c.is_ascii_digit() || ['-', '.', '_', ':', 'T', 'Z'].contains(&c))
}

#[cfg(test)]
mod tests {
    use super::is_rotated;

    #[test]
    fn what_logrotate_names_is_a_rotated_log() {
        for (other, expected) in [
            ("claims.ndjson.1", true),
            ("claims.ndjson.12.gz", true),
            ("claims.ndjson-20261121", true),
            ("claims.ndjson-20261121-0800.gz", true),
            ("claims.ndjson", false),
            ("claims.ndjson.gz", false),
            ("claims.ndjson.bak", false),
            ("claims.ndjson2", false),
            ("other.ndjson.1", false),
        ] {
            assert_eq!(is_rotated("claims.ndjson", other), expected, "{other}");
        }
    }
}
