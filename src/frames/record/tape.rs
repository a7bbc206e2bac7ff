//! One file of a recording: frames in NAME.npy, and in NAME.frames.ndjson one line for each event that the monitor received, in
//! order: times, claims, poses, masks, and why a frame was unusable.

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use ndarray::Array2;
use serde::{Deserialize, Serialize};

use crate::frame::Frame;
use crate::frames::{Arrivals, Error, Next, npy};

/// First line of the index.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Head {
    /// Version of the format.
    pub oapwatch_recording: u32,
    /// Claims in force and poses known when the file begins, for a replay that begins with it.
    #[serde(flatten)]
    pub standing: Arrivals,
}

/// A line of the index after the first.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(in crate::frames) struct Entry {
    pub index: u64,
    pub time: Timestamp,
    /// Why there is no frame; otherwise the next frame of the .npy is meant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unusable: Option<String>,
    /// Masked pixels, row and column.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masked: Option<Vec<[usize; 2]>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_s: Option<f64>,
    #[serde(default = "unchanged", skip_serializing_if = "is_unchanged")]
    pub energy_scale: f64,
    #[serde(flatten)]
    pub arrivals: Arrivals,
}

/// [`Frame::energy_scale`] of a source that keeps its exposure.
fn unchanged() -> f64 {
    1.0
}

fn is_unchanged(energy_scale: &f64) -> bool {
    *energy_scale == unchanged()
}

/// One event: an entry with its pixels.
#[derive(Clone, Debug)]
pub(in crate::frames) struct Seen {
    pub entry: Entry,
    pub pixels: Option<Array2<f64>>,
}

impl Seen {
    pub fn frame(frame: &Frame, arrivals: &Arrivals) -> Self {
        let masked = frame.masked.as_ref().map(|masked| {
            let marked = masked.indexed_iter().filter(|(_, m)| **m);
            marked.map(|((y, x), _)| [y, x]).collect()
        });
        let entry = Entry {
            index: frame.index,
            time: frame.time,
            unusable: None,
            masked,
            exposure_s: frame.exposure_s,
            energy_scale: frame.energy_scale,
            arrivals: arrivals.clone(),
        };
        Self {
            entry,
            pixels: Some(frame.pixels.clone()),
        }
    }

    pub fn next(self) -> Next {
        let Entry {
            index,
            time,
            unusable,
            masked,
            exposure_s,
            energy_scale,
            arrivals,
        } = self.entry;
        let Some(pixels) = self.pixels else {
            let reason = unusable.unwrap_or_default();
            return Next::Unusable {
                index,
                time,
                reason,
                arrivals,
            };
        };
        let masked = masked.map(|marked| {
            let mut mask = Array2::from_elem(pixels.dim(), false);
            for at in marked {
                if let Some(pixel) = mask.get_mut(at) {
                    *pixel = true;
                }
            }
            mask
        });
        let frame = Frame {
            index,
            time,
            pixels,
            masked,
            exposure_s,
            energy_scale,
        };
        Next::Frame(frame, arrivals)
    }
}

/// Path of the index of a recording.
pub(in crate::frames) fn index_of(npy: &Path) -> PathBuf {
    npy.with_extension("frames.ndjson")
}

/// Creates or empties a file that only its owner may read, whatever the umask: recordings show where every user was.
fn create_private(path: &Path) -> std::io::Result<File> {
    let mut options = File::options();
    let file = options.write(true).create(true).truncate(true).mode(0o600).open(path)?;
    // The mode above holds for a new file only. A file system without modes is no reason not to record.
    let _ = file.set_permissions(std::fs::Permissions::from_mode(0o600));
    Ok(file)
}

/// Writes one file. A frame's pixels are written before its line, so that the index names only frames that are complete.
#[derive(Debug)]
pub(super) struct TapeWriter {
    frames: npy::Writer,
    index: File,
}

impl TapeWriter {
    /// Creates both files or neither.
    pub fn create(path: &Path, shape: (usize, usize), standing: Arrivals) -> Result<Self, Error> {
        Self::create_both(path, shape, standing).inspect_err(|_| {
            // The first error is the one to report.
            let _ = std::fs::remove_file(path);
            let _ = std::fs::remove_file(index_of(path));
        })
    }

    fn create_both(path: &Path, shape: (usize, usize), standing: Arrivals) -> Result<Self, Error> {
        let frames = npy::Writer::create_with(create_private(path), path, shape)?;
        let index = create_private(&index_of(path)).map_err(|source| Error::Recording {
            path: index_of(path),
            source,
        })?;
        let mut tape = Self { frames, index };
        tape.line(&Head {
            oapwatch_recording: 1,
            standing,
        })?;
        Ok(tape)
    }

    pub fn path(&self) -> &Path {
        self.frames.path()
    }

    pub fn push(&mut self, seen: &Seen) -> Result<(), Error> {
        if let Some(pixels) = &seen.pixels {
            self.frames.push(pixels.view())?;
        }
        self.line(&seen.entry)
    }

    fn line(&mut self, value: &impl Serialize) -> Result<(), Error> {
        let mut line = serde_json::to_vec(value).expect("plain data has a JSON form");
        line.push(b'\n');
        self.index.write_all(&line).map_err(|source| Error::Recording {
            path: index_of(self.frames.path()),
            source,
        })
    }
}

/// Reads one file. A truncated last line, left by a killed recorder, is skipped.
#[derive(Debug)]
pub(in crate::frames) struct TapeReader {
    path: PathBuf,
    lines: std::io::Lines<BufReader<File>>,
    number: u64,
    frames: Option<npy::Reader>,
}

impl TapeReader {
    /// Opens a file; returns the claims in force and the poses known when it begins.
    pub fn open(path: &Path) -> Result<(Self, Arrivals), Error> {
        let index = index_of(path);
        let file = File::open(&index).map_err(|source| Error::Recording { path: index, source })?;
        let mut tape = Self {
            path: path.to_owned(),
            lines: BufReader::new(file).lines(),
            number: 0,
            frames: None,
        };
        let head = tape.line::<Head>()?;
        Ok((tape, head.map(|h| h.standing).unwrap_or_default()))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    fn line<T: serde::de::DeserializeOwned>(&mut self) -> Result<Option<T>, Error> {
        let Some(line) = self.lines.next() else {
            return Ok(None);
        };
        self.number += 1;
        let line = line.map_err(|source| Error::Recording {
            path: index_of(&self.path),
            source,
        })?;
        match serde_json::from_str(&line) {
            Ok(value) => Ok(Some(value)),
            Err(_) if self.lines.next().is_none() => Ok(None),
            Err(source) => Err(Error::Index {
                path: index_of(&self.path),
                line: self.number,
                source,
            }),
        }
    }

    /// The next entry of the index, without its pixels. Not to be mixed with [`TapeReader::next`].
    pub fn entry(&mut self) -> Result<Option<Entry>, Error> {
        self.line()
    }

    /// The next event.
    pub fn next(&mut self) -> Result<Option<Seen>, Error> {
        let Some(entry) = self.line::<Entry>()? else {
            return Ok(None);
        };
        if entry.unusable.is_some() {
            return Ok(Some(Seen { entry, pixels: None }));
        }
        let frames = match &mut self.frames {
            Some(frames) => frames,
            None => self.frames.insert(npy::Reader::open(&self.path, None)?),
        };
        let pixels = frames.next().transpose()?;
        Ok(pixels.map(|pixels| Seen {
            entry,
            pixels: Some(pixels),
        }))
    }
}
