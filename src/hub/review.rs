//! Runs the chain over what a hub has recorded: the same bytes in, the same events out.

use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use super::chain::{Chain, Heard, Settings};
use super::record::{Head, Line, VERSION, recordings};
use crate::monitor::AlertEvent;

/// Why a recording cannot be reviewed.
#[derive(Debug, thiserror::Error)]
pub enum ReviewError {
    #[error("{path}: expected a readable recording of a hub, found: {source}")]
    Unreadable { path: PathBuf, source: io::Error },
    #[error("{path}: expected recordings of a hub, found none")]
    Nothing { path: PathBuf },
    #[error("{path}:{line}: expected {expected}, found: {found}")]
    Malformed {
        path: PathBuf,
        line: u64,
        expected: &'static str,
        found: String,
    },
    #[error(transparent)]
    Output(io::Error),
}

/// Gives every event of the recording at `path`, a file or a folder, to `tell`, in order.
pub fn review(
    path: &Path,
    settings: Settings,
    mut tell: impl FnMut(&AlertEvent) -> io::Result<()>,
) -> Result<(), ReviewError> {
    let unreadable = |path: &Path| {
        let path = path.to_owned();
        move |source| ReviewError::Unreadable { path, source }
    };
    let files = recordings(path).map_err(unreadable(path))?;
    let mut running: Option<(u64, Chain)> = None;
    for file in &files {
        let reader = File::open(file).map_err(unreadable(file))?;
        let mut lines = Lines {
            path: file,
            reader: BufReader::new(reader),
            number: 0,
        };
        // The hub was ended before the first line of its newest file was written.
        let Some(head) = lines.next::<Head>("the first line of a hub's recording")? else {
            continue;
        };
        if head.version != VERSION {
            return Err(lines.malformed("version 1", format!("version {}", head.version)));
        }
        let mut chain = match running.take() {
            Some((number, chain)) if head.follows == Some(number) => chain,
            _ => Chain::resume(settings, head.chain),
        };
        while let Some(Line { at, heard }) = lines.next::<Line<Heard>>("a thing that a hub has heard")? {
            for taken in chain.take(heard, at).taken {
                tell(&taken.event).map_err(ReviewError::Output)?;
            }
        }
        running = Some((head.number, chain));
    }
    match files.is_empty() {
        true => Err(ReviewError::Nothing { path: path.to_owned() }),
        false => Ok(()),
    }
}

struct Lines<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    /// Of the line read last, from 1.
    number: u64,
}

impl Lines<'_> {
    /// `None` at the end. A last line that is not whole is where the hub was killed.
    fn next<T: DeserializeOwned>(&mut self, expected: &'static str) -> Result<Option<T>, ReviewError> {
        let mut line = Vec::new();
        let read = self.reader.read_until(b'\n', &mut line);
        read.map_err(|source| ReviewError::Unreadable {
            path: self.path.to_owned(),
            source,
        })?;
        self.number += 1;
        if line.last() != Some(&b'\n') {
            return Ok(None);
        }
        let parsed = serde_json::from_slice(&line);
        parsed
            .map(Some)
            .map_err(|error| self.malformed(expected, error.to_string()))
    }

    fn malformed(&self, expected: &'static str, found: String) -> ReviewError {
        ReviewError::Malformed {
            path: self.path.to_owned(),
            line: self.number,
            expected,
            found,
        }
    }
}
