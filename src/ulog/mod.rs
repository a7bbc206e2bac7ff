//! Flight logs of PX4 (`.ulg`): attitudes, places and GNSS time (docs.px4.io, "ULog File Format").

mod log;
mod message;
mod parser;

use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

pub use log::{Attitude, Axes, Log, Place};
use parser::Parser;

const MAGIC: [u8; 7] = *b"ULog\x01\x12\x35";
const HEADER: usize = 16;

/// Why a file is no log that can be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: at byte {at}: {message}")]
    Malformed { path: PathBuf, at: u64, message: String },
}

/// Reads a log.
///
/// # Errors
/// The file cannot be read, or is no log; the message names the byte.
pub fn read(path: &Path) -> Result<Log, Error> {
    let unreadable = |source| Error::Unreadable {
        path: path.to_owned(),
        source,
    };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    read_from(std::io::BufReader::new(file)).map_err(|fault| match fault {
        Fault::Read(source) => unreadable(source),
        Fault::Malformed(at, message) => Error::Malformed {
            path: path.to_owned(),
            at,
            message,
        },
    })
}

/// Why bytes are no log: they cannot be read, or what stands at a byte.
#[derive(Debug)]
pub enum Fault {
    Read(std::io::Error),
    Malformed(u64, String),
}

impl From<std::io::Error> for Fault {
    fn from(error: std::io::Error) -> Self {
        Self::Read(error)
    }
}

/// Reads a log from its first byte.
///
/// # Errors
/// As of [`read`].
pub fn read_from(mut input: impl Read) -> Result<Log, Fault> {
    let mut header = [0; HEADER];
    let length = fill(&mut input, &mut header)?;
    if length < HEADER || header[..7] != MAGIC {
        return Err(Fault::Malformed(
            0,
            "expected a PX4 log (ULog), found something else".to_owned(),
        ));
    }
    let mut at = HEADER as u64;
    let mut parser = Parser::default();
    let mut body = Vec::new();
    loop {
        let mut head = [0; 3];
        let length = fill(&mut input, &mut head)?;
        body.resize(usize::from(u16::from_le_bytes([head[0], head[1]])), 0);
        if length == 0 {
            break;
        }
        if length < head.len() || fill(&mut input, &mut body)? < body.len() {
            parser.log.is_cut_off = true;
            break;
        }
        parser
            .message(head[2], &body)
            .map_err(|message| Fault::Malformed(at, message))?;
        at += (head.len() + body.len()) as u64;
    }
    Ok(parser.finish())
}

/// Reads until `buffer` is full or the input ends.
fn fill(input: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match input.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}
