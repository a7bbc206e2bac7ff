//! Writes a simulated recording: frames.npy, truth.ndjson and claims.ndjson, which hold the same frames even after an error.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::frames::npy;
use crate::scene::SimulatedFrame;

/// Why a file of the recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("{path}: {reason}")]
    Io { path: PathBuf, reason: io::Error },
    #[error(transparent)]
    Npy(#[from] npy::Error),
}

/// Writes batches of frames. The lines of a batch are written before its frames; the header of frames.npy counts complete frames,
/// and after a failed write the lines are truncated to them.
#[derive(Debug)]
pub struct Recording {
    frames: npy::Writer,
    truth: Lines,
    claims: Lines,
}

#[derive(Debug)]
struct Lines {
    path: PathBuf,
    file: File,
    length: u64,
}

impl Recording {
    /// Creates `folder` and, in it, the three files without a frame. `shape` is (Ny, Nx).
    pub fn create(folder: &Path, shape: (usize, usize)) -> Result<Self, WriteError> {
        std::fs::create_dir_all(folder).map_err(|reason| WriteError::Io {
            path: folder.to_owned(),
            reason,
        })?;
        Ok(Self {
            frames: npy::Writer::create(folder.join("frames.npy"), shape)?,
            truth: Lines::create(folder.join("truth.ndjson"))?,
            claims: Lines::create(folder.join("claims.ndjson"))?,
        })
    }

    /// Frames that the files hold.
    pub fn frames(&self) -> u64 {
        self.frames.frames()
    }

    /// Appends frames. After an error the files hold those that were written completely.
    pub fn append(&mut self, batch: &[SimulatedFrame]) -> Result<(), WriteError> {
        let before = self.frames();
        let done = self.append_parts(batch);
        if done.is_err() {
            // The first error is the one to report.
            let kept = &batch[..(self.frames() - before) as usize];
            let _ = self.truth.cut_to(kept, truth_lines);
            let _ = self.claims.cut_to(kept, claim_lines);
        }
        done
    }

    fn append_parts(&mut self, batch: &[SimulatedFrame]) -> Result<(), WriteError> {
        let truth: Vec<u8> = batch.iter().flat_map(truth_lines).collect();
        let claims: Vec<u8> = batch.iter().flat_map(claim_lines).collect();
        self.truth.append(&truth)?;
        self.claims.append(&claims)?;
        for simulated in batch {
            self.frames.push(simulated.frame.pixels.view())?;
        }
        self.truth.length += truth.len() as u64;
        self.claims.length += claims.len() as u64;
        Ok(())
    }
}

fn truth_lines(simulated: &SimulatedFrame) -> Vec<u8> {
    line(&simulated.truth)
}

fn claim_lines(simulated: &SimulatedFrame) -> Vec<u8> {
    simulated.claims.iter().flat_map(line).collect()
}

fn line(value: &impl serde::Serialize) -> Vec<u8> {
    let mut line = serde_json::to_vec(value).expect("plain data always serialises");
    line.push(b'\n');
    line
}

impl Lines {
    fn create(path: PathBuf) -> Result<Self, WriteError> {
        match File::create(&path) {
            Ok(file) => Ok(Self { path, file, length: 0 }),
            Err(reason) => Err(WriteError::Io { path, reason }),
        }
    }

    fn append(&mut self, bytes: &[u8]) -> Result<(), WriteError> {
        self.file.write_all(bytes).map_err(|reason| WriteError::Io {
            path: self.path.clone(),
            reason,
        })
    }

    /// Truncates the file to the lines before the batch and those of the frames that were `kept`.
    fn cut_to(&mut self, kept: &[SimulatedFrame], lines: impl Fn(&SimulatedFrame) -> Vec<u8>) -> io::Result<()> {
        self.length += kept.iter().map(|f| lines(f).len() as u64).sum::<u64>();
        self.file.set_len(self.length)?;
        self.file.seek(SeekFrom::End(0)).map(drop)
    }
}
