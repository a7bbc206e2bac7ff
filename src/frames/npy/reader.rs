//! Reads frame files frame by frame.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use ndarray::Array2;

use super::{Dtype, Error, Header};

/// Reads a frame file frame by frame, in joules. As an iterator it gives every complete frame and then,
/// if the file is cut short, one error that names the frame.
#[derive(Debug)]
pub struct Reader {
    path: PathBuf,
    file: BufReader<File>,
    header: Header,
    joules_per_count: f64,
    next: u64,
    failed: bool,
    bytes: Vec<u8>,
}

impl Reader {
    /// Opens a frame file. `joules_per_count` turns integer frames into joules; float frames are joules
    /// already and leave it unused.
    pub fn open(path: impl AsRef<Path>, joules_per_count: Option<f64>) -> Result<Self, Error> {
        let path = path.as_ref().to_owned();
        let io = |source| Error::Io {
            path: path.clone(),
            source,
        };
        let file = File::open(&path).map_err(io)?;
        if file.metadata().map_err(io)?.is_dir() {
            return Err(io(std::io::ErrorKind::IsADirectory.into()));
        }
        let mut file = BufReader::new(file);
        let header = Header::read(&path, &mut file)?;
        let joules_per_count = match (header.dtype.is_counts(), joules_per_count) {
            (false, _) => 1.0,
            (true, Some(scale)) => scale,
            (true, None) => {
                return Err(Error::NoScale {
                    path,
                    dtype: header.dtype,
                });
            }
        };
        Ok(Self {
            path,
            file,
            header,
            joules_per_count,
            next: 0,
            failed: false,
            bytes: Vec::new(),
        })
    }

    /// Whether the file holds counts rather than joules.
    pub fn is_counts(&self) -> bool {
        self.header.dtype.is_counts()
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Number of frames according to the header.
    pub fn frames(&self) -> u64 {
        self.header.frames
    }

    /// Shape of each frame, (Ny, Nx).
    pub fn shape(&self) -> (usize, usize) {
        (self.header.ny, self.header.nx)
    }

    /// The frame that the next read gives.
    pub fn position(&self) -> u64 {
        self.next
    }

    /// Moves to a frame.
    pub fn seek(&mut self, frame: u64) -> Result<(), Error> {
        if frame >= self.header.frames {
            return Err(Error::NoSuchFrame {
                path: self.path.clone(),
                frame,
                frames: self.header.frames,
            });
        }
        let offset = self.header.data_start + frame * self.header.frame_bytes() as u64;
        self.file.seek(SeekFrom::Start(offset)).map_err(|e| self.io(e))?;
        self.next = frame;
        self.failed = false;
        Ok(())
    }

    fn io(&self, source: std::io::Error) -> Error {
        Error::Io {
            path: self.path.clone(),
            source,
        }
    }

    fn read_frame(&mut self) -> Result<Array2<f64>, Error> {
        let expected = self.header.frame_bytes();
        // `take` allocates for the bytes that exist, not for what the header claims.
        self.bytes.clear();
        let read = (&mut self.file).take(expected as u64).read_to_end(&mut self.bytes);
        read.map_err(|e| self.io(e))?;
        if self.bytes.len() < expected {
            return Err(Error::Truncated {
                path: self.path.clone(),
                frame: self.next,
                frames: self.header.frames,
                expected,
                found: self.bytes.len(),
            });
        }
        let mut pixels = Vec::with_capacity(self.header.ny * self.header.nx);
        decode(self.header.dtype, &self.bytes, self.joules_per_count, &mut pixels);
        Ok(Array2::from_shape_vec(self.shape(), pixels).expect("as many pixels as the shape says"))
    }
}

impl Iterator for Reader {
    type Item = Result<Array2<f64>, Error>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.failed || self.next == self.header.frames {
            return None;
        }
        let frame = self.read_frame();
        match frame {
            Ok(_) => self.next += 1,
            Err(_) => self.failed = true,
        }
        Some(frame)
    }
}

fn decode(dtype: Dtype, bytes: &[u8], joules_per_count: f64, out: &mut Vec<f64>) {
    fn each<const N: usize>(bytes: &[u8], out: &mut Vec<f64>, value: impl Fn([u8; N]) -> f64) {
        out.extend(bytes.as_chunks::<N>().0.iter().map(|b| value(*b)));
    }
    let k = joules_per_count;
    match dtype {
        Dtype::U1 => each(bytes, out, |[b]| k * f64::from(b)),
        Dtype::U2 { big: false } => each(bytes, out, |b| k * f64::from(u16::from_le_bytes(b))),
        Dtype::U2 { big: true } => each(bytes, out, |b| k * f64::from(u16::from_be_bytes(b))),
        Dtype::F4 { big: false } => each(bytes, out, |b| f64::from(f32::from_le_bytes(b))),
        Dtype::F4 { big: true } => each(bytes, out, |b| f64::from(f32::from_be_bytes(b))),
        Dtype::F8 { big: false } => each(bytes, out, f64::from_le_bytes),
        Dtype::F8 { big: true } => each(bytes, out, f64::from_be_bytes),
    }
}
