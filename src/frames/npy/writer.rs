//! Writes frame files that are valid after every frame.

use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use ndarray::ArrayView2;

use super::header::WRITTEN_HEADER;
use super::{Dtype, Error, Header};

/// Writes joules, or counts of 16 bits, frame by frame. The file is a valid npy at every moment: a frame's bytes go out before the
/// header counts them, so that a killed process loses at most the frame it was writing.
#[derive(Debug)]
pub struct Writer {
    path: PathBuf,
    file: File,
    header: Header,
    bytes: Vec<u8>,
}

impl Writer {
    /// Creates (or replaces) a frame file for frames of shape (Ny, Nx).
    pub fn create(path: impl AsRef<Path>, shape: (usize, usize)) -> Result<Self, Error> {
        Self::create_with(File::create(&path), path.as_ref(), shape)
    }

    /// Creates (or replaces) a file of counts from 0 to 65535.
    pub fn create_counts(path: impl AsRef<Path>, shape: (usize, usize)) -> Result<Self, Error> {
        let counts = Dtype::U2 { big: false };
        Self::create_of(counts, File::create(&path), path.as_ref(), shape)
    }

    /// Writes to a file just opened, empty, at `path`.
    pub fn create_with(file: std::io::Result<File>, path: &Path, shape: (usize, usize)) -> Result<Self, Error> {
        Self::create_of(Dtype::JOULES, file, path, shape)
    }

    fn create_of(
        dtype: Dtype,
        file: std::io::Result<File>,
        path: &Path,
        (ny, nx): (usize, usize),
    ) -> Result<Self, Error> {
        let path = path.to_owned();
        let header = Header {
            dtype,
            frames: 0,
            ny,
            nx,
            data_start: WRITTEN_HEADER as u64,
        };
        let created = file.and_then(|mut file| {
            file.write_all(&header.bytes())?;
            Ok(file)
        });
        match created {
            Ok(file) => Ok(Self {
                path,
                file,
                header,
                bytes: Vec::new(),
            }),
            Err(source) => Err(Error::Io { path, source }),
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Frames written so far.
    pub fn frames(&self) -> u64 {
        self.header.frames
    }

    /// Size of the file, bytes.
    pub fn size(&self) -> u64 {
        self.end_of(self.header.frames)
    }

    /// Appends a frame. After an error the file holds what it held before.
    pub fn push(&mut self, pixels: ArrayView2<f64>) -> Result<(), Error> {
        let (ny, nx) = pixels.dim();
        if (ny, nx) != (self.header.ny, self.header.nx) {
            return Err(Error::Shape {
                path: self.path.clone(),
                expected_x: self.header.nx,
                expected_y: self.header.ny,
                found_x: nx,
                found_y: ny,
            });
        }
        self.bytes.clear();
        match self.header.dtype {
            Dtype::U2 { .. } => self
                .bytes
                .extend(pixels.iter().flat_map(|v| (v.round() as u16).to_le_bytes())),
            _ => self.bytes.extend(pixels.iter().flat_map(|v| v.to_le_bytes())),
        }
        self.append().map_err(|source| {
            // A partial frame that cannot be truncated is harmless: the header does not count it.
            let _ = self.file.set_len(self.end_of(self.header.frames));
            Error::Io {
                path: self.path.clone(),
                source,
            }
        })
    }

    /// Flushes everything to the disk.
    pub fn sync(&mut self) -> Result<(), Error> {
        self.file.sync_data().map_err(|source| Error::Io {
            path: self.path.clone(),
            source,
        })
    }

    fn append(&mut self) -> std::io::Result<()> {
        self.file.seek(SeekFrom::Start(self.end_of(self.header.frames)))?;
        self.file.write_all(&self.bytes)?;
        let counted = Header {
            frames: self.header.frames + 1,
            ..self.header
        };
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(&counted.bytes())?;
        self.header = counted;
        Ok(())
    }

    fn end_of(&self, frames: u64) -> u64 {
        self.header.data_start + frames * self.header.frame_bytes() as u64
    }
}
