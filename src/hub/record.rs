//! Records what the chain is given: a ring of NDJSON files. The first line of each holds what alerts depend on at its begin, each
//! further line one thing heard and the hub's time. A thread writes, so that a slow disk costs recordings and never alerts.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::JoinHandle;

use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};

use super::chain::{Chain, Heard, SavedChain};
use crate::frames::Error;
use crate::frames::record::Config;
use crate::metric;

/// Version of the files. A reader refuses others.
pub const VERSION: u32 = 1;
/// Ending of the files.
const EXTENSION: &str = "ndjson";
/// Bytes that wait for the disk at most: a second of a thousand stations.
const QUEUE: usize = 64 << 20;
/// After lines were lost, a new file is begun after this long.
const RETRY: SignedDuration = SignedDuration::from_secs(1);

/// First line of a file.
#[derive(Debug, Serialize, Deserialize)]
pub struct Head {
    pub version: u32,
    /// Counts the files of a folder.
    pub number: u64,
    /// The file before, where nothing is missing between both.
    pub follows: Option<u64>,
    pub at: Timestamp,
    pub chain: SavedChain,
}

/// Any further line; `H` is [`Heard`], or a reference to one that is written.
#[derive(Debug, Serialize, Deserialize)]
pub struct Line<H> {
    pub at: Timestamp,
    pub heard: H,
}

/// Handle of the thread that writes. Dropping it writes what is queued and ends the thread.
pub struct Recorder {
    folder: PathBuf,
    segment: SignedDuration,
    segment_bytes: usize,
    next_number: u64,
    current: Option<Segment>,
    /// No file is begun before.
    waits_until: Timestamp,
    link: Arc<Link>,
    queue: Option<Sender<Order>>,
    thread: Option<JoinHandle<()>>,
}

/// The file that lines go to.
struct Segment {
    number: u64,
    began: Timestamp,
    bytes: usize,
}

/// What both sides of the queue share.
#[derive(Default)]
struct Link {
    waiting: AtomicUsize,
    /// The latest file could not be written.
    is_failing: AtomicBool,
}

enum Order {
    Begin { path: PathBuf, head: Vec<u8> },
    Line(Vec<u8>),
}

impl Recorder {
    /// Starts recording; `None` when the config names no folder.
    pub fn start(config: &Config) -> Result<Option<Self>, Error> {
        let Some(folder) = config.folder.clone() else {
            return Ok(None);
        };
        let failed = |source| Error::Recording {
            path: folder.clone(),
            source,
        };
        // A folder that exists keeps the mode that its owner gave it.
        let mut builder = std::fs::DirBuilder::new();
        builder.recursive(true).mode(0o700).create(&folder).map_err(failed)?;
        let number = |path: &PathBuf| path.file_name()?.to_str()?.split_once('-')?.0.parse::<u64>().ok();
        let next_number = recordings(&folder).map_err(failed)?.iter().filter_map(number).max();
        let limit = (config.limit_mb * 1e6) as u64;
        let (queue, orders) = channel();
        let link = Arc::new(Link::default());
        let writer = Writer {
            folder: folder.clone(),
            limit,
            file: None,
            is_told: false,
            link: link.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || writer.run(&orders))
            .map_err(failed)?;
        Ok(Some(Self {
            segment: SignedDuration::from_secs_f64(config.segment_s),
            segment_bytes: usize::try_from(limit / 8).unwrap_or(usize::MAX),
            folder,
            next_number: next_number.map_or(0, |n| n + 1),
            current: None,
            waits_until: Timestamp::UNIX_EPOCH,
            link,
            queue: Some(queue),
            thread: Some(thread),
        }))
    }

    /// Records what `chain` is about to be given.
    pub fn heard(&mut self, at: Timestamp, heard: &Heard, chain: &Chain) {
        if self.link.is_failing.swap(false, Ordering::Relaxed) {
            self.lose(at);
        }
        let is_over = |s: &Segment| at.duration_since(s.began).abs() >= self.segment || s.bytes >= self.segment_bytes;
        if self.current.as_ref().is_none_or(is_over) {
            self.begin(at, chain);
        }
        let Some(segment) = &mut self.current else { return };
        let line = line(&Line { at, heard });
        segment.bytes += line.len();
        self.order(Order::Line(line), at);
    }

    /// Begins anew with the next thing heard, after the chain was changed by something else.
    pub fn interrupt(&mut self) {
        self.current = None;
    }

    fn begin(&mut self, at: Timestamp, chain: &Chain) {
        let follows = self.current.take().map(|segment| segment.number);
        if at < self.waits_until {
            return;
        }
        let number = self.next_number;
        self.next_number += 1;
        let head = line(&Head {
            version: VERSION,
            number,
            follows,
            at,
            chain: chain.saved(),
        });
        let name = format!("{number:08}-{}.{EXTENSION}", at.strftime("%Y%m%dT%H%M%SZ"));
        self.current = Some(Segment {
            number,
            began: at,
            bytes: head.len(),
        });
        let path = self.folder.join(name);
        self.order(Order::Begin { path, head }, at);
    }

    fn order(&mut self, order: Order, at: Timestamp) {
        let bytes = order.bytes();
        let is_taken = self.link.waiting.load(Ordering::Relaxed) + bytes <= QUEUE
            && self.queue.as_ref().is_some_and(|queue| {
                self.link.waiting.fetch_add(bytes, Ordering::Relaxed);
                queue.send(order).is_ok()
            });
        if !is_taken {
            metrics::counter!(metric::RECORDER_DROPPED).increment(1);
            self.lose(at);
        }
    }

    /// The file ends where lines are lost.
    fn lose(&mut self, at: Timestamp) {
        self.current = None;
        self.waits_until = at + RETRY;
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the recorder's thread panicked");
        }
    }
}

impl Order {
    fn bytes(&self) -> usize {
        match self {
            Self::Begin { head, .. } => head.len(),
            Self::Line(line) => line.len(),
        }
    }
}

fn line(value: &impl Serialize) -> Vec<u8> {
    let mut line = serde_json::to_vec(value).expect("lines hold no maps with keys other than strings");
    line.push(b'\n');
    line
}

struct Writer {
    folder: PathBuf,
    limit: u64,
    /// `None` from a failed write to the next file.
    file: Option<BufWriter<File>>,
    /// Nothing has reached the disk since a failure that is in the log.
    is_told: bool,
    link: Arc<Link>,
}

impl Writer {
    fn run(mut self, orders: &Receiver<Order>) {
        loop {
            let order = match orders.try_recv() {
                Ok(order) => order,
                Err(TryRecvError::Empty) => {
                    let flushed = self.file.as_mut().map(Write::flush);
                    self.is_told &= !matches!(flushed, Some(Ok(())));
                    self.note(flushed.unwrap_or(Ok(())));
                    match orders.recv() {
                        Ok(order) => order,
                        Err(_) => break,
                    }
                }
                Err(TryRecvError::Disconnected) => break,
            };
            let bytes = order.bytes();
            let written = self.write(order);
            self.note(written);
            self.link.waiting.fetch_sub(bytes, Ordering::Relaxed);
        }
        let flushed = self.file.take().map_or(Ok(()), |mut file| file.flush());
        self.note(flushed);
    }

    fn write(&mut self, order: Order) -> io::Result<()> {
        match order {
            Order::Begin { path, head } => {
                let ended = self.file.take().map_or(Ok(()), |mut file| file.flush());
                trim(&self.folder, self.limit)?;
                let mut file = BufWriter::new(File::create_new(path)?);
                file.write_all(&head)?;
                self.file = Some(file);
                ended
            }
            Order::Line(line) => self.file.as_mut().map_or(Ok(()), |file| file.write_all(&line)),
        }
    }

    fn note(&mut self, outcome: io::Result<()>) {
        if let Err(error) = outcome {
            if !std::mem::replace(&mut self.is_told, true) {
                tracing::warn!(folder = %self.folder.display(), %error, "what the hub hears is not recorded");
            }
            metrics::counter!(metric::RECORDER_ERRORS).increment(1);
            self.file = None;
            self.link.is_failing.store(true, Ordering::Relaxed);
        }
    }
}

/// The files of a folder, oldest first, or the file itself.
pub fn recordings(path: &Path) -> io::Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(path)? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == EXTENSION) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// Removes the oldest files until the rest is within `limit` bytes.
fn trim(folder: &Path, limit: u64) -> io::Result<()> {
    let all = recordings(folder)?;
    let bytes: Vec<u64> = all
        .iter()
        .map(|path| std::fs::metadata(path).map_or(0, |m| m.len()))
        .collect();
    let mut total: u64 = bytes.iter().sum();
    for (path, bytes) in all.iter().zip(bytes) {
        if total <= limit {
            break;
        }
        std::fs::remove_file(path)?;
        total -= bytes;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hub::chain::Settings;

    #[test]
    fn the_ring_stays_within_its_limit_and_its_files_follow_each_other() {
        let dir = tempfile::tempdir().unwrap();
        let config = Config {
            folder: Some(dir.path().to_owned()),
            limit_mb: 0.02,
            segment_s: 3600.0,
            ..Config::default()
        };
        let settings = Settings {
            lost_after_s: 10.0,
            tolerated_m: 5.0,
        };
        let chain = Chain::new(settings, Vec::new(), Default::default(), Timestamp::UNIX_EPOCH);
        let mut recorder = Recorder::start(&config).unwrap().unwrap();
        for k in 0..2000 {
            recorder.heard(Timestamp::from_second(k).unwrap(), &Heard::Tick, &chain);
            if k == 1900 {
                recorder.interrupt();
            }
        }
        drop(recorder);
        let files = recordings(dir.path()).unwrap();
        let bytes: u64 = files.iter().map(|path| std::fs::metadata(path).unwrap().len()).sum();
        assert!((15_000..=25_000).contains(&bytes), "{bytes} bytes in {files:?}");
        let heads: Vec<Head> = files
            .iter()
            .map(|path| serde_json::from_str(std::fs::read_to_string(path).unwrap().lines().next().unwrap()).unwrap())
            .collect();
        assert!(heads[0].number > 0 && heads.len() > 4, "{heads:?}");
        let torn = heads[1..].iter().filter(|head| head.follows != Some(head.number - 1));
        assert_eq!(
            torn.map(|head| head.follows).collect::<Vec<_>>(),
            [None],
            "at the interruption only"
        );
    }
}
