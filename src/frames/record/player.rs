//! Reads recordings of `[record]`: one file, or a folder of them in order.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use super::tape::{Seen, TapeReader};
use crate::claim::Claim;
use crate::frames::Error;

/// Reads the events of several files in order.
#[derive(Debug)]
pub(in crate::frames) struct Player {
    files: VecDeque<PathBuf>,
    tape: TapeReader,
    /// The claims that stood when the first file begins; they come with the first frame.
    standing: Vec<Claim>,
}

impl Player {
    /// `files` oldest first, at least one.
    pub fn open(mut files: VecDeque<PathBuf>) -> Result<Option<Self>, Error> {
        let Some(first) = files.pop_front() else {
            return Ok(None);
        };
        let (tape, standing) = TapeReader::open(&first)?;
        Ok(Some(Self { files, tape, standing }))
    }

    pub fn path(&self) -> &Path {
        self.tape.path()
    }

    pub fn next(&mut self) -> Result<Option<Seen>, Error> {
        loop {
            if let Some(mut seen) = self.tape.next()? {
                if !self.standing.is_empty() {
                    seen.entry.claims.splice(0..0, self.standing.drain(..));
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
