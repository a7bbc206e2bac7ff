//! Reads recordings of `[record]`: one file, or a folder of them in order.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use super::tape::{Seen, TapeReader};
use crate::frames::{Arrivals, Error};

/// Reads the events of several files in order.
#[derive(Debug)]
pub(in crate::frames) struct Player {
    files: VecDeque<PathBuf>,
    tape: TapeReader,
    /// What stood when the first file begins; it comes with the first frame. None once it has.
    standing: Option<Arrivals>,
}

impl Player {
    /// `files` oldest first, at least one.
    pub fn open(mut files: VecDeque<PathBuf>) -> Result<Option<Self>, Error> {
        let Some(first) = files.pop_front() else {
            return Ok(None);
        };
        let (tape, standing) = TapeReader::open(&first)?;
        Ok(Some(Self {
            files,
            tape,
            standing: Some(standing),
        }))
    }

    pub fn path(&self) -> &Path {
        self.tape.path()
    }

    pub fn next(&mut self) -> Result<Option<Seen>, Error> {
        loop {
            if let Some(mut seen) = self.tape.next()? {
                if let Some(mut arrivals) = self.standing.take() {
                    arrivals.append(seen.entry.arrivals);
                    seen.entry.arrivals = arrivals;
                }
                return Ok(Some(seen));
            }
            let Some(file) = self.files.pop_front() else {
                return Ok(None);
            };
            self.tape = TapeReader::open(&file)?.0;
        }
    }
}
