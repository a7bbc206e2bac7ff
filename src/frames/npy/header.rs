//! The .npy header (NumPy Enhancement Proposal 1): magic, version, length, then a Python dict literal.
//! Parsed here because files come from outside: a general literal parser recurses as deep as the file
//! says, allocates what the file says and multiplies shapes without looking.

use std::io::Read;
use std::path::Path;

use super::dtype::Dtype;
use super::error::Error;

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// A header of three numbers needs about 100 bytes; NumPy itself refuses more than 10,000.
const MAX_HEADER: usize = 10_000;
/// Pixels a side, as for `[optics] pixels`.
const MAX_SIDE: u64 = 4096;

/// The header: number, shape and type of the frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    pub dtype: Dtype,
    pub frames: u64,
    pub ny: usize,
    pub nx: usize,
    /// Offset of the first frame in the file.
    pub data_start: u64,
}

impl Header {
    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> usize {
        self.ny * self.nx * self.dtype.size()
    }

    /// Bytes of a file that [`super::Writer`] wrote with these frames.
    pub fn file_bytes(&self) -> u64 {
        self.data_start + self.frames * self.frame_bytes() as u64
    }

    pub(super) fn read(path: &Path, from: &mut impl Read) -> Result<Self, Error> {
        let path = || path.to_owned();
        let not_npy = |e: std::io::Error| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => Error::NotNpy { path: path() },
            _ => Error::Io {
                path: path(),
                source: e,
            },
        };
        let mut start = [0; 8];
        from.read_exact(&mut start).map_err(not_npy)?;
        if &start[..6] != MAGIC {
            return Err(Error::NotNpy { path: path() });
        }
        let (length, before) = match start[6] {
            1 => {
                let mut n = [0; 2];
                from.read_exact(&mut n).map_err(not_npy)?;
                (usize::from(u16::from_le_bytes(n)), 10)
            }
            2 | 3 => {
                let mut n = [0; 4];
                from.read_exact(&mut n).map_err(not_npy)?;
                (u32::from_le_bytes(n) as usize, 12)
            }
            major => {
                return Err(Error::Version {
                    path: path(),
                    major,
                    minor: start[7],
                });
            }
        };
        if length > MAX_HEADER {
            return Err(Error::HeaderLength {
                path: path(),
                found: length,
                most: MAX_HEADER,
            });
        }
        let mut text = vec![0; length];
        from.read_exact(&mut text).map_err(not_npy)?;
        let malformed = || Error::Header {
            path: path(),
            found: String::from_utf8_lossy(&text).trim().chars().take(120).collect(),
        };
        let dict = std::str::from_utf8(&text)
            .ok()
            .and_then(Dict::parse)
            .ok_or_else(malformed)?;
        dict.header(path(), before + length as u64)
    }

    /// The header's bytes for a given number of frames. Their length does not depend on that number, so
    /// that the count can be patched in place.
    pub fn bytes(&self) -> Vec<u8> {
        let dict = format!(
            "{{'descr': '{}', 'fortran_order': False, 'shape': ({}, {}, {}), }}",
            self.dtype.descr(),
            self.frames,
            self.ny,
            self.nx
        );
        let width = WRITTEN_HEADER - 11;
        let mut bytes = Vec::with_capacity(WRITTEN_HEADER);
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&[1, 0]);
        bytes.extend_from_slice(&((WRITTEN_HEADER - 10) as u16).to_le_bytes());
        bytes.extend_from_slice(format!("{dict:<width$}\n").as_bytes());
        bytes
    }
}

/// Length of the headers written here: a multiple of 64 with room for any count.
pub(super) const WRITTEN_HEADER: usize = 128;

struct Dict<'a> {
    descr: &'a str,
    fortran: bool,
    shape: Vec<u64>,
}

impl<'a> Dict<'a> {
    fn parse(text: &'a str) -> Option<Self> {
        let mut rest = text.trim_start().strip_prefix('{')?;
        let (mut descr, mut fortran, mut shape) = (None, None, None);
        loop {
            rest = rest.trim_start();
            if let Some(after) = rest.strip_prefix('}') {
                if !after.trim_matches(|c: char| c.is_whitespace() || c == '\0').is_empty() {
                    return None;
                }
                return Some(Self {
                    descr: descr?,
                    fortran: fortran?,
                    shape: shape?,
                });
            }
            let (key, after) = quoted(rest)?;
            rest = after.trim_start().strip_prefix(':')?.trim_start();
            match key {
                "descr" if rest.starts_with('[') => {
                    let end = rest.rfind(']')?;
                    descr = Some(&rest[..=end]);
                    rest = &rest[end + 1..];
                }
                "descr" => {
                    let (value, after) = quoted(rest)?;
                    descr = Some(value);
                    rest = after;
                }
                "fortran_order" => {
                    let (value, after) = match rest.strip_prefix("True") {
                        Some(after) => (true, after),
                        None => (false, rest.strip_prefix("False")?),
                    };
                    fortran = Some(value);
                    rest = after;
                }
                "shape" => {
                    let (inside, after) = rest.strip_prefix('(')?.split_once(')')?;
                    let mut sizes: Vec<&str> = inside.split(',').map(str::trim).collect();
                    if sizes.last() == Some(&"") {
                        sizes.pop();
                    }
                    // Python 2 wrote long integers with a trailing L.
                    let parsed = sizes.iter().map(|s| s.trim_end_matches('L').parse().ok());
                    shape = Some(parsed.collect::<Option<Vec<u64>>>()?);
                    rest = after;
                }
                _ => return None,
            }
            rest = rest.trim_start();
            rest = rest.strip_prefix(',').unwrap_or(rest);
        }
    }

    fn header(self, path: std::path::PathBuf, data_start: u64) -> Result<Header, Error> {
        let Some(dtype) = Dtype::from_descr(self.descr) else {
            return Err(Error::Dtype {
                path,
                found: self.descr.to_owned(),
            });
        };
        let (frames, ny, nx) = match *self.shape {
            [ny, nx] => (1, ny, nx),
            [frames, ny, nx] => (frames, ny, nx),
            _ => {
                return Err(Error::Dimensions {
                    path,
                    found: self.shape,
                });
            }
        };
        if self.fortran {
            return Err(Error::FortranOrder { path });
        }
        if frames == 0 || ny == 0 || nx == 0 {
            return Err(Error::Empty {
                path,
                found: self.shape,
            });
        }
        let fits = ny <= MAX_SIDE && nx <= MAX_SIDE;
        let total = fits
            .then(|| ny * nx * dtype.size() as u64)
            .and_then(|frame| frame.checked_mul(frames)?.checked_add(data_start));
        match total {
            Some(total) if i64::try_from(total).is_ok() => Ok(Header {
                dtype,
                frames,
                ny: ny as usize,
                nx: nx as usize,
                data_start,
            }),
            _ => Err(Error::TooLarge {
                path,
                found: self.shape,
            }),
        }
    }
}

/// A quoted string at the start of `text`, and what follows it. No type string holds an escape.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote)
}
