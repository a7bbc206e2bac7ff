use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::{Claim, Config, LineError, parse_line};

/// Longest line accepted; a longer one is refused as a whole.
pub const LONGEST_LINE: usize = 64 * 1024;
/// Bytes read in one poll, so that a huge log cannot hold up the caller.
const POLL_BYTES: u64 = 4 << 20;
/// The start of the file that tells a rewritten log from a grown one.
const HEAD_BYTES: usize = 256;

/// Follows the network's log like `tail -F`: through rotation, truncation, a rewrite in place and a file that is
/// not there yet. A line is taken once its newline has been written. Only [`Follower::poll`] touches the disk.
#[derive(Debug)]
pub struct Follower {
    path: PathBuf,
    config: Config,
    open: Option<Open>,
}

#[derive(Debug)]
struct Open {
    file: File,
    /// (device, inode).
    identity: (u64, u64),
    offset: u64,
    head: Vec<u8>,
    lines: Lines,
}

/// What one poll found.
#[derive(Debug, Default)]
pub struct Poll {
    pub claims: Vec<Claim>,
    pub refused: Vec<Refused>,
    /// The log was replaced, truncated or rewritten since the last poll.
    pub restarted: bool,
    /// There is more to read at once.
    pub more: bool,
}

/// A line that is no claim.
#[derive(Debug)]
pub struct Refused {
    /// Counted from 1 in the file as it is now.
    pub line: u64,
    pub error: LineError,
}

/// Cuts a stream of bytes into lines and reads each.
#[derive(Debug, Default)]
struct Lines {
    number: u64,
    partial: Vec<u8>,
    overlong: bool,
}

impl Lines {
    fn feed(&mut self, mut bytes: &[u8], config: &Config, poll: &mut Poll) {
        while let Some(end) = bytes.iter().position(|&b| b == b'\n') {
            self.keep(&bytes[..end]);
            self.finish(config, poll);
            bytes = &bytes[end + 1..];
        }
        self.keep(bytes);
    }

    fn keep(&mut self, bytes: &[u8]) {
        self.overlong |= self.partial.len() + bytes.len() > LONGEST_LINE;
        if self.overlong {
            self.partial.clear();
        } else {
            self.partial.extend_from_slice(bytes);
        }
    }

    /// Ends the line at hand: at its newline, or where the file it was in ends for good.
    fn finish(&mut self, config: &Config, poll: &mut Poll) {
        self.number += 1;
        let read = if self.overlong {
            Err(LineError::TooLong { limit: LONGEST_LINE })
        } else if self.partial.trim_ascii().is_empty() {
            self.partial.clear();
            return;
        } else {
            parse_line(&self.partial, config)
        };
        self.partial.clear();
        self.overlong = false;
        match read {
            Ok(claim) => poll.claims.push(claim),
            Err(error) => poll.refused.push(Refused {
                line: self.number,
                error,
            }),
        }
    }

    fn is_midline(&self) -> bool {
        self.overlong || !self.partial.is_empty()
    }
}

impl Follower {
    pub fn new(path: &Path, config: &Config) -> Self {
        Self {
            path: path.to_owned(),
            config: config.clone(),
            open: None,
        }
    }

    /// Reads what has been written since the last poll. A log that does not exist (yet) gives nothing.
    pub fn poll(&mut self) -> io::Result<Poll> {
        let mut poll = Poll::default();
        let on_disk = match std::fs::metadata(&self.path) {
            Ok(meta) => Some(meta),
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            Err(e) => return Err(e),
        };
        if let Some(open) = &mut self.open {
            if open.was_rewritten()? {
                open.restart()?;
                poll.restarted = true;
            }
            open.read(&self.config, &mut poll)?;
            let replaced = on_disk
                .as_ref()
                .is_some_and(|meta| (meta.dev(), meta.ino()) != open.identity);
            if !replaced || poll.more {
                return Ok(poll);
            }
            // The old file has been read to its end; nobody will finish its last line.
            if open.lines.is_midline() {
                open.lines.finish(&self.config, &mut poll);
            }
            self.open = None;
            poll.restarted = true;
        }
        if on_disk.is_some() {
            match Open::new(&self.path) {
                Ok(mut open) => {
                    open.read(&self.config, &mut poll)?;
                    self.open = Some(open);
                }
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                Err(e) => return Err(e),
            }
        }
        Ok(poll)
    }
}

impl Open {
    fn new(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let meta = file.metadata()?;
        Ok(Self {
            file,
            identity: (meta.dev(), meta.ino()),
            offset: 0,
            head: Vec::new(),
            lines: Lines::default(),
        })
    }

    fn was_rewritten(&mut self) -> io::Result<bool> {
        if self.file.metadata()?.len() < self.offset {
            return Ok(true);
        }
        let mut head = vec![0; self.head.len()];
        self.file.seek(SeekFrom::Start(0))?;
        match self.file.read_exact(&mut head) {
            Ok(()) => Ok(head != self.head),
            Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Ok(true),
            Err(e) => Err(e),
        }
    }

    fn restart(&mut self) -> io::Result<()> {
        self.offset = 0;
        self.head.clear();
        self.lines = Lines::default();
        Ok(())
    }

    fn read(&mut self, config: &Config, poll: &mut Poll) -> io::Result<()> {
        self.file.seek(SeekFrom::Start(self.offset))?;
        let mut bytes = Vec::new();
        let read = (&self.file).take(POLL_BYTES).read_to_end(&mut bytes)?;
        self.offset += read as u64;
        let missing = HEAD_BYTES.saturating_sub(self.head.len()).min(read);
        self.head.extend_from_slice(&bytes[..missing]);
        self.lines.feed(&bytes, config, poll);
        poll.more |= read as u64 == POLL_BYTES;
        Ok(())
    }
}

/// Reads a whole log for a review: claims by rising time (lines of equal time in the log's order). The last line
/// may lack its newline.
pub fn read_log(path: &Path, config: &Config) -> io::Result<Poll> {
    let mut open = Open::new(path)?;
    let mut poll = Poll::default();
    loop {
        poll.more = false;
        open.read(config, &mut poll)?;
        if !poll.more {
            break;
        }
    }
    if open.lines.is_midline() {
        open.lines.finish(config, &mut poll);
    }
    poll.claims.sort_by_key(|claim| claim.time);
    Ok(poll)
}
