//! The folder of the recorder: numbered files, of which the oldest are removed.

use std::io;
use std::path::{Path, PathBuf};

use super::tape::index_of;

/// Recordings of a folder, oldest first: NNNNNNNN-TIME.npy with its index beside it.
pub(in crate::frames) fn recordings(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "npy") && index_of(&path).exists() {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The frame files behind a path: the recordings of a folder, oldest first, or the file itself.
pub fn frame_files(path: &Path) -> io::Result<Vec<PathBuf>> {
    match path.is_dir() {
        true => recordings(path),
        false => Ok(vec![path.to_owned()]),
    }
}

/// The number of the next file in a folder.
pub(super) fn next_number(folder: &Path) -> io::Result<u64> {
    let number = |path: &PathBuf| path.file_name()?.to_str()?.split_once('-')?.0.parse::<u64>().ok();
    Ok(recordings(folder)?.iter().filter_map(number).max().map_or(0, |n| n + 1))
}

/// Bytes of all recordings of a folder.
pub(super) fn size(folder: &Path) -> io::Result<u64> {
    Ok(recordings(folder)?.iter().map(|path| bytes(path)).sum())
}

/// Bytes of a recording and its index.
fn bytes(path: &Path) -> u64 {
    let size = |path: &Path| std::fs::metadata(path).map_or(0, |m| m.len());
    size(path) + size(&index_of(path))
}

/// Removes the oldest recordings until the rest is within `limit` bytes; `keep` stays. Returns the number removed.
pub(super) fn trim(folder: &Path, limit: u64, keep: &Path) -> io::Result<u64> {
    let mut all: Vec<(PathBuf, u64)> = recordings(folder)?
        .into_iter()
        .map(|path| {
            let bytes = bytes(&path);
            (path, bytes)
        })
        .collect();
    // Evidence is named by its alert, not by its age.
    all.sort_by_key(|(path, _)| std::fs::metadata(path).and_then(|m| m.modified()).ok());
    let mut total: u64 = all.iter().map(|(_, bytes)| bytes).sum();
    let mut removed = 0;
    for (path, bytes) in all.iter().filter(|(path, _)| path != keep) {
        if total <= limit {
            break;
        }
        // The index is removed last: a recording without an index would never be found again, an index without frames is harmless.
        std::fs::remove_file(path)?;
        std::fs::remove_file(index_of(path))?;
        total -= bytes;
        removed += 1;
    }
    Ok(removed)
}
