//! Follows the claims log as it grows, is rotated or replaced.

use std::fs::{File, Metadata};
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use jiff::Timestamp;

use super::format::LineReader;
use super::{Claim, Config, LineError, rotated};

/// Longest line accepted; a longer one is refused as a whole.
pub const LONGEST_LINE: usize = 64 * 1024;
/// Bytes read in one poll, so that a huge log cannot hold up the caller.
const POLL_BYTES: u64 = 1 << 20;
/// The start of the file that tells a rewritten log from a grown one.
const HEAD_BYTES: usize = 256;
/// Lines that are no claims that a poll names.
const MOST_NAMED: usize = 100;

/// Follows the network's log like `tail -F`: through rotation, truncation, a rewrite in place and a file that is
/// not there yet. A line is taken once its newline has been written. Only [`Follower::poll`] touches the disk.
#[derive(Debug)]
pub struct Follower {
    path: PathBuf,
    config: Config,
    open: Option<Open>,
    /// The file before, which its writer may go on with until it opens the new one.
    rotated: Option<Open>,
    /// A file that was rotated away after this time is read before the log itself.
    missed_since: Option<SystemTime>,
    /// How far behind the log's end reading may be before what lies between is passed over.
    most_behind: Option<u64>,
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
    /// The first of the lines that are no claims; a log of nothing else must not fill the memory.
    pub refused: Vec<Refused>,
    /// How many there were.
    pub refused_count: u64,
    /// The log was replaced, truncated or rewritten since the last poll.
    pub restarted: bool,
    /// There is more to read at once.
    pub more: bool,
    /// Bytes of a log longer than is read at its opening that were passed over.
    pub skipped_at_start_bytes: u64,
    /// Bytes passed over because the log grew faster than it is read.
    pub skipped_bytes: u64,
}

/// A line that is no claim.
#[derive(Debug)]
pub struct Refused {
    /// Counted from 1 in the file as it is now; from where reading went on, where bytes were passed over.
    pub line: u64,
    pub error: LineError,
}

/// Cuts a stream of bytes into lines and reads each.
#[derive(Debug, Default)]
struct Lines {
    number: u64,
    partial: Vec<u8>,
    overlong: bool,
    /// The line at hand lost its beginning.
    is_cut: bool,
    reader: LineReader,
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
        if std::mem::take(&mut self.is_cut) {
            self.partial.clear();
            self.overlong = false;
            return;
        }
        self.number += 1;
        let read = if self.overlong {
            Err(LineError::TooLong { limit: LONGEST_LINE })
        } else if self.partial.trim_ascii().is_empty() {
            self.partial.clear();
            return;
        } else {
            self.reader.read(&self.partial, config)
        };
        self.partial.clear();
        self.overlong = false;
        match read {
            Ok(claim) => poll.claims.extend(claim),
            Err(error) => {
                poll.refused_count += 1;
                if poll.refused.len() < MOST_NAMED {
                    let line = self.number;
                    poll.refused.push(Refused { line, error });
                }
            }
        }
    }

    /// Starts somewhere in a line, whose end is no claim's and no error.
    fn skip(&mut self) {
        *self = Self {
            is_cut: true,
            reader: std::mem::take(&mut self.reader),
            ..Self::default()
        };
    }

    /// Ends the line at hand if it is a claim without its newline; more may come of one that is not.
    fn finish_claim(&mut self, config: &Config, poll: &mut Poll) {
        if !self.is_cut && !self.overlong && self.reader.clone().read(&self.partial, config).is_ok() {
            self.finish(config, poll);
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
            rotated: None,
            missed_since: None,
            most_behind: None,
        }
    }

    /// Follows a live log: reading that is more than `[claims] tail_bytes` behind the log's end, at the start or later, goes on
    /// from there. If the log was rotated after `since`, the file before it is read first.
    pub fn live(self, since: SystemTime) -> Self {
        Self {
            most_behind: Some(self.config.tail_bytes),
            missed_since: Some(since),
            ..self
        }
    }

    /// Reads lines by other rules from now on, and another log from its start where `path` is another.
    pub fn change(&mut self, path: &Path, config: &Config) {
        if path != self.path {
            self.path = path.to_owned();
            self.open = None;
            self.rotated = None;
        }
        self.config = config.clone();
        self.most_behind = self.most_behind.map(|_| config.tail_bytes);
    }

    /// Reads what has been written since the last poll. A log that does not exist (yet) gives nothing. An error says
    /// that there is nothing else to tell: what has been read comes first.
    pub fn poll(&mut self) -> io::Result<Poll> {
        let mut poll = Poll::default();
        let on_disk = match std::fs::metadata(&self.path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            other => Some(other),
        };
        if let Some(since) = self.missed_since.take() {
            let before = rotated::predecessors(&self.path).into_iter().next();
            let missed = before.filter(|(written, _)| *written >= since);
            self.rotated = missed.and_then(|(_, path)| Open::new(&path).ok());
        }
        self.read_rotated(&mut poll);
        if poll.more {
            return Ok(poll);
        }
        if let Some(open) = &mut self.open {
            if open.was_rewritten()? {
                open.restart()?;
                poll.restarted = true;
            }
            open.read(&self.config, self.most_behind, &mut poll)?;
            let replaced = match &on_disk {
                None => false,
                Some(Ok(meta)) => (meta.dev(), meta.ino()) != open.identity,
                // We may not look any more; what we have open we still have.
                Some(Err(_)) => false,
            };
            if !replaced || poll.more {
                return Ok(poll);
            }
            open.lines.finish_claim(&self.config, &mut poll);
            let before = std::mem::replace(&mut self.rotated, self.open.take());
            if let Some(mut before) = before {
                before.end(&self.config, &mut poll);
            }
            poll.restarted = true;
        }
        match self.begin(on_disk, &mut poll) {
            Err(e) if !poll.restarted && poll.claims.is_empty() && poll.refused_count == 0 => Err(e),
            // The next poll meets the error again.
            _ => Ok(poll),
        }
    }

    /// Reads the file before until the next rotation, or until it has been deleted.
    fn read_rotated(&mut self, poll: &mut Poll) {
        let Some(before) = &mut self.rotated else { return };
        let is_deleted = before.file.metadata().is_ok_and(|meta| meta.nlink() == 0);
        let outcome = before.read(&self.config, self.most_behind, poll);
        if outcome.is_err() || is_deleted && !poll.more {
            before.end(&self.config, poll);
            self.rotated = None;
        }
    }

    /// Opens what stands at the log's path now.
    fn begin(&mut self, on_disk: Option<io::Result<Metadata>>, poll: &mut Poll) -> io::Result<()> {
        let Some(meta) = on_disk else { return Ok(()) };
        // Opening a pipe would wait for its writer, and a folder opens but cannot be read.
        if !meta?.is_file() {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{}: expected a file, found something else", self.path.display()),
            ));
        }
        match Open::new(&self.path) {
            Ok(mut open) => {
                open.read(&self.config, self.most_behind, poll)?;
                self.open = Some(open);
                Ok(())
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(e) => Err(e),
        }
    }
}

impl Open {
    fn new(path: &Path) -> io::Result<Self> {
        let meta = std::fs::metadata(path)?;
        Ok(Self {
            file: rotated::open(path)?,
            identity: (meta.dev(), meta.ino()),
            offset: 0,
            head: Vec::new(),
            lines: Lines::default(),
        })
    }

    /// Nobody will finish the last line.
    fn end(&mut self, config: &Config, poll: &mut Poll) {
        if self.lines.is_midline() {
            self.lines.finish(config, poll);
        }
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

    fn read(&mut self, config: &Config, most_behind: Option<u64>, poll: &mut Poll) -> io::Result<()> {
        if let Some(most_behind) = most_behind {
            let end = self.file.metadata()?.len();
            if end.saturating_sub(self.offset) > most_behind {
                self.skip_to(end - most_behind, config, poll)?;
            }
        }
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

    /// Reads the first line, without which no other can be. One that is none is refused with every line that follows.
    fn read_header(&mut self, config: &Config) -> io::Result<()> {
        let mut start = Vec::new();
        self.file.seek(SeekFrom::Start(0))?;
        (&self.file).take(LONGEST_LINE as u64).read_to_end(&mut start)?;
        if let Some(end) = start.iter().position(|&b| b == b'\n') {
            let _ = self.lines.reader.read(&start[..end], config);
        }
        Ok(())
    }

    /// Passes over what lies before `offset`, but for the head that tells a rewritten log.
    fn skip_to(&mut self, offset: u64, config: &Config, poll: &mut Poll) -> io::Result<()> {
        if self.lines.reader.needs_header(config) {
            self.read_header(config)?;
        }
        let missing = HEAD_BYTES.saturating_sub(self.head.len());
        self.file.seek(SeekFrom::Start(self.head.len() as u64))?;
        (&self.file).take(missing as u64).read_to_end(&mut self.head)?;
        match self.offset {
            0 => poll.skipped_at_start_bytes += offset,
            read => poll.skipped_bytes += offset - read,
        }
        self.offset = offset;
        self.lines.skip();
        Ok(())
    }
}

/// Reads a whole log for a review: claims by rising time (lines of equal time in the log's order). The last line may lack its
/// newline. Where the log begins after `since`, what was rotated away before it is read too.
pub fn read_log(path: &Path, config: &Config, since: Option<Timestamp>) -> io::Result<Poll> {
    let mut poll = read_whole(path, config)?;
    for (_, path) in rotated::predecessors(path) {
        let first = poll.claims.iter().map(|claim| claim.time).min();
        if since.is_none_or(|since| first.is_some_and(|first| first <= since)) {
            break;
        }
        tracing::info!(
            "the claims log begins after the recording; reading {} too",
            path.display()
        );
        let before = read_whole(&path, config)?;
        poll.refused_count += before.refused_count;
        poll.claims.splice(0..0, before.claims);
    }
    poll.claims.sort_by_key(|claim| claim.time);
    Ok(poll)
}

fn read_whole(path: &Path, config: &Config) -> io::Result<Poll> {
    let mut open = Open::new(path)?;
    let mut poll = Poll::default();
    loop {
        poll.more = false;
        open.read(config, None, &mut poll)?;
        if !poll.more {
            break;
        }
    }
    open.end(config, &mut poll);
    Ok(poll)
}
