//! A simulated recording on disk: frames.npy, truth.ndjson and claims.ndjson, valid at every moment.

use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::truth::SimulatedFrame;

/// Element type of frames.npy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Element {
    /// Half the size; rounds a pixel by at most 6·10⁻⁸ of itself.
    #[default]
    F4,
    F8,
}

/// Could not write a file of the recording.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct WriteError {
    pub path: PathBuf,
    pub reason: io::Error,
}

/// Writes frames as they come. Every [`Recording::commit`] leaves the three files telling of the same frames; what was
/// written after the last one is cut off when a write fails, and lies beyond the header's count when the program is
/// killed.
#[derive(Debug)]
pub struct Recording {
    frames: Part,
    truth: Part,
    claims: Part,
    shape: (usize, usize),
    element: Element,
    /// Frames written, and frames committed.
    written: u64,
    committed: u64,
}

#[derive(Debug)]
struct Part {
    path: PathBuf,
    file: BufWriter<File>,
    length: u64,
    committed: u64,
}

impl Recording {
    /// Creates `folder` and, in it, the three files without a frame. `shape` is (Ny, Nx).
    pub fn create(folder: &Path, shape: (usize, usize), element: Element) -> Result<Self, WriteError> {
        std::fs::create_dir_all(folder).map_err(|reason| WriteError {
            path: folder.to_owned(),
            reason,
        })?;
        let mut recording = Self {
            frames: Part::create(folder.join("frames.npy"))?,
            truth: Part::create(folder.join("truth.ndjson"))?,
            claims: Part::create(folder.join("claims.ndjson"))?,
            shape,
            element,
            written: 0,
            committed: 0,
        };
        let header = recording.header(0);
        recording.frames.append(&header)?;
        recording.commit()?;
        Ok(recording)
    }

    /// Frames that the files hold.
    pub fn frames(&self) -> u64 {
        self.committed
    }

    /// Appends one frame. Call [`Recording::commit`] every so often.
    pub fn append(&mut self, frame: &SimulatedFrame) -> Result<(), WriteError> {
        let done = self.append_parts(frame);
        self.rescue(done)
    }

    /// Makes the files tell of every frame appended so far.
    pub fn commit(&mut self) -> Result<(), WriteError> {
        let done = self.commit_parts();
        self.rescue(done)
    }

    fn append_parts(&mut self, simulated: &SimulatedFrame) -> Result<(), WriteError> {
        let pixels = simulated.frame.pixels.iter();
        let bytes: Vec<u8> = match self.element {
            Element::F4 => pixels.flat_map(|p| (*p as f32).to_le_bytes()).collect(),
            Element::F8 => pixels.flat_map(|p| p.to_le_bytes()).collect(),
        };
        self.frames.append(&bytes)?;
        self.truth.append_json(&simulated.truth)?;
        for claim in &simulated.claims {
            self.claims.append_json(claim)?;
        }
        self.written += 1;
        Ok(())
    }

    fn commit_parts(&mut self) -> Result<(), WriteError> {
        for part in [&mut self.frames, &mut self.truth, &mut self.claims] {
            part.flush()?;
        }
        let header = self.header(self.written);
        self.frames.overwrite_start(&header)?;
        for part in [&mut self.frames, &mut self.truth, &mut self.claims] {
            part.committed = part.length;
        }
        self.committed = self.written;
        Ok(())
    }

    /// After a failure: cuts the files back to what was committed.
    fn rescue(&mut self, done: Result<(), WriteError>) -> Result<(), WriteError> {
        if done.is_err() {
            for part in [&mut self.frames, &mut self.truth, &mut self.claims] {
                // The first error is the one to report; a file that cannot be cut keeps a tail beyond the header's count.
                let _ = part.cut_back();
            }
            let header = self.header(self.committed);
            let _ = self.frames.overwrite_start(&header);
            self.written = self.committed;
        }
        done
    }

    /// NPY version 1.0 (NumPy Enhancement Proposal 1), always 128 bytes, so that the count can be overwritten in place.
    fn header(&self, count: u64) -> Vec<u8> {
        let descr = match self.element {
            Element::F4 => "<f4",
            Element::F8 => "<f8",
        };
        let (ny, nx) = self.shape;
        let dictionary = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({count}, {ny}, {nx}), }}");
        let mut header = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        header.extend(format!("{dictionary:<117}\n").bytes());
        header
    }
}

impl Part {
    fn create(path: PathBuf) -> Result<Self, WriteError> {
        let file = File::create(&path).map_err(|reason| WriteError {
            path: path.clone(),
            reason,
        })?;
        Ok(Self {
            path,
            file: BufWriter::with_capacity(1 << 16, file),
            length: 0,
            committed: 0,
        })
    }

    fn append(&mut self, bytes: &[u8]) -> Result<(), WriteError> {
        let done = self.file.write_all(bytes);
        self.length += bytes.len() as u64;
        self.named(done)
    }

    fn append_json(&mut self, value: &impl serde::Serialize) -> Result<(), WriteError> {
        let mut line = serde_json::to_vec(value).expect("plain data always serialises");
        line.push(b'\n');
        self.append(&line)
    }

    fn flush(&mut self) -> Result<(), WriteError> {
        let done = self.file.flush();
        self.named(done)
    }

    fn overwrite_start(&mut self, header: &[u8]) -> Result<(), WriteError> {
        let file = self.file.get_mut();
        let done = file
            .seek(SeekFrom::Start(0))
            .and_then(|_| file.write_all(header))
            .and_then(|()| file.seek(SeekFrom::End(0)))
            .map(drop);
        self.named(done)
    }

    fn cut_back(&mut self) -> io::Result<()> {
        let file = self.file.get_ref().try_clone()?;
        // A BufWriter that failed still holds its bytes and would write them when dropped.
        let failed = std::mem::replace(&mut self.file, BufWriter::new(file));
        let (mut file, _) = failed.into_parts();
        file.set_len(self.committed)?;
        file.seek(SeekFrom::End(0))?;
        self.length = self.committed;
        Ok(())
    }

    fn named(&self, done: io::Result<()>) -> Result<(), WriteError> {
        done.map_err(|reason| WriteError {
            path: self.path.clone(),
            reason,
        })
    }
}
