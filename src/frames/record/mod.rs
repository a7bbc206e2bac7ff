//! Records the input of the monitor: a ring of files, and a copy of the time around each alert as evidence. A separate thread
//! writes, so that a slow disk costs recordings and never alerts. On a full disk the oldest recordings are removed, so that the
//! ring does not take the space that the journal needs.

mod config;
mod evidence;
mod player;
mod ring;
mod standing;
mod tape;

pub use config::Config;
pub use evidence::{Evidence, EvidenceFrame, file_name as evidence_file_name, frame_at};
pub(super) use player::Player;
pub use ring::frame_files;
pub(super) use ring::recordings;
pub(super) use tape::index_of;

use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use jiff::{SignedDuration, Timestamp};

use super::{Arrivals, Error, npy};
use crate::frame::Frame;
use crate::metric;
use standing::Standing;
use tape::{Entry, Seen, TapeReader, TapeWriter};

/// Folder for evidence, within the recorder's own.
pub const EVIDENCE: &str = "evidence";
/// Most clips of evidence recorded at a time; a further alert falls within the time of another clip.
const MOST_CLIPS: usize = 8;
/// Most frames that wait for the disk.
const QUEUE: usize = 64;
/// While writing fails, a new file is tried after this long.
const RETRY: SignedDuration = SignedDuration::from_secs(1);

/// Handle of the recorder thread. Dropping it writes what is queued and ends the thread.
#[derive(Debug)]
pub struct Recorder {
    folder: PathBuf,
    segment: SignedDuration,
    /// Bytes of pixels after which a file ends, whatever its length.
    segment_bytes: u64,
    next_number: u64,
    current: Option<Segment>,
    /// Time after an alert that its evidence covers.
    after: SignedDuration,
    /// Evidence that is still being recorded: the alert's time and its file.
    clips: Vec<(Timestamp, Arc<Path>)>,
    /// The recorder thread could not write the latest frame.
    failing: Arc<AtomicBool>,
    queue: Option<SyncSender<Order>>,
    thread: Option<JoinHandle<()>>,
}

/// A frame that the recorder thread has taken.
#[derive(Clone, Debug)]
pub struct Taken {
    /// The file that holds it; `None` while writing fails. Its claims and poses are still written to the head of the next file.
    pub file: Option<Arc<Path>>,
}

/// The file that frames go to.
#[derive(Clone, Debug)]
struct Segment {
    path: Arc<Path>,
    began: Timestamp,
    shape: (usize, usize),
    bytes: u64,
}

#[derive(Debug)]
enum Order {
    Write {
        path: Arc<Path>,
        shape: (usize, usize),
        seen: Box<Seen>,
    },
    Evidence {
        path: Arc<Path>,
        time: Timestamp,
    },
}

impl Recorder {
    /// Starts recording; `None` when the config names no folder.
    pub fn start(config: &Config) -> Result<Option<Self>, Error> {
        config.check()?;
        let Some(folder) = config.folder.clone() else {
            return Ok(None);
        };
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| Error::Recording { path, source }
        };
        let evidence = folder.join(EVIDENCE);
        // Folders that exist keep the mode that their owner gave them.
        let mut builder = std::fs::DirBuilder::new();
        builder
            .recursive(true)
            .mode(0o700)
            .create(&evidence)
            .map_err(failed(&evidence))?;
        let next_number = ring::next_number(&folder).map_err(failed(&folder))?;
        let (queue, orders) = sync_channel(QUEUE);
        let failing = Arc::new(AtomicBool::new(false));
        let worker = RecorderThread {
            folder: folder.clone(),
            evidence,
            config: config.clone(),
            tape: None,
            broken: None,
            failing: failing.clone(),
            standing: Standing::default(),
            clips: Vec::new(),
        };
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || worker.run(&orders))
            .map_err(failed(&folder))?;
        Ok(Some(Self {
            segment: seconds(config.segment_s),
            segment_bytes: (bytes(config.limit_mb) / 8).max(1),
            folder,
            next_number,
            current: None,
            after: seconds(config.after_s),
            clips: Vec::new(),
            failing,
            queue: Some(queue),
            thread: Some(thread),
        }))
    }

    /// Records a frame as it came, before any correction, with what came since the one before. `None`
    /// when the disk cannot keep up and the frame was dropped.
    pub fn frame(&mut self, frame: &Frame, arrivals: &Arrivals) -> Option<Taken> {
        let bytes = 8 * frame.pixels.len() as u64;
        self.write(Some(frame.pixels.dim()), bytes, Seen::frame(frame, arrivals))
    }

    /// Records that there was no usable frame.
    pub fn unusable(&mut self, index: u64, time: Timestamp, reason: &str, arrivals: &Arrivals) -> Option<Taken> {
        let entry = Entry {
            index,
            time,
            unusable: Some(reason.to_owned()),
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
            arrivals: arrivals.clone(),
        };
        self.write(None, 0, Seen { entry, pixels: None })
    }

    /// Records the time around an alert under its id. Returns the file: the alert's own or, where the most clips are already being
    /// recorded, that of an earlier alert, which covers its time too. `None` while writing fails.
    pub fn evidence(&mut self, alert: &str, time: Timestamp) -> Option<Arc<Path>> {
        if self.failing.load(Ordering::Relaxed) {
            return None;
        }
        let after = self.after;
        self.clips
            .retain(|(began, _)| time.duration_since(*began).abs() <= after);
        if self.clips.len() >= MOST_CLIPS {
            return self.clips.last().map(|(_, path)| path.clone());
        }
        let path: Arc<Path> = self.folder.join(EVIDENCE).join(evidence_file_name(alert)).into();
        let path_of_order = path.clone();
        if !self.order(Order::Evidence {
            path: path_of_order,
            time,
        }) {
            return None;
        }
        self.clips.push((time, path.clone()));
        Some(path)
    }

    fn write(&mut self, shape: Option<(usize, usize)>, bytes: u64, seen: Seen) -> Option<Taken> {
        let time = seen.entry.time;
        let is_failing = self.failing.load(Ordering::Relaxed);
        let longest = if is_failing { RETRY } else { self.segment };
        let fits = |segment: &Segment| {
            shape.is_none_or(|shape| shape == segment.shape)
                && time.duration_since(segment.began).abs() < longest
                && segment.bytes + bytes <= self.segment_bytes.max(bytes)
        };
        let mut segment = match self.current.take().filter(fits) {
            Some(segment) => segment,
            None => {
                let name = format!("{:08}-{}.npy", self.next_number, time.strftime("%Y%m%dT%H%M%SZ"));
                self.next_number += 1;
                Segment {
                    path: self.folder.join(name).into(),
                    began: time,
                    shape: shape.unwrap_or((1, 1)),
                    bytes: 0,
                }
            }
        };
        segment.bytes += bytes;
        let path = segment.path.clone();
        let shape = segment.shape;
        self.current = Some(segment);
        let sent = self.order(Order::Write {
            path: path.clone(),
            shape,
            seen: Box::new(seen),
        });
        let file = (!is_failing).then_some(path);
        sent.then_some(Taken { file })
    }

    fn order(&self, order: Order) -> bool {
        let sent = self.queue.as_ref().is_some_and(|queue| queue.try_send(order).is_ok());
        if !sent {
            metrics::counter!(metric::RECORDER_DROPPED).increment(1);
        }
        sent
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the recorder thread ended in a panic");
        }
    }
}

/// State of the recorder thread.
struct RecorderThread {
    folder: PathBuf,
    evidence: PathBuf,
    config: Config,
    tape: Option<TapeWriter>,
    /// The file that could not be written; the next file is tried.
    broken: Option<Arc<Path>>,
    failing: Arc<AtomicBool>,
    standing: Standing,
    clips: Vec<Clip>,
}

/// Evidence that is still being recorded.
struct Clip {
    tape: TapeWriter,
    until: Timestamp,
}

impl RecorderThread {
    fn run(mut self, orders: &Receiver<Order>) {
        for order in orders {
            let was_failing = self.failing.load(Ordering::Relaxed);
            let done = match order {
                Order::Write { path, shape, seen } => self.write(path, shape, &seen),
                Order::Evidence { path, time } => self.keep(&path, time),
            };
            let Err(error) = done else { continue };
            metrics::counter!(metric::RECORDER_ERRORS).increment(1);
            if !was_failing {
                tracing::error!(%error, "not recorded");
            }
            if error.is_full_disk() {
                self.free_disk();
            }
        }
    }

    /// Removes the older half of the ring.
    fn free_disk(&self) {
        let half = ring::size(&self.folder).map(|bytes| bytes / 2);
        match half.and_then(|half| ring::trim(&self.folder, half, Path::new(""))) {
            Ok(0) => {}
            Ok(removed) => tracing::warn!(removed, "the disk is full: the oldest recordings were removed"),
            Err(error) => tracing::error!(%error, "the disk is full, and the oldest recordings could not be removed"),
        }
    }

    fn write(&mut self, path: Arc<Path>, shape: (usize, usize), seen: &Seen) -> Result<(), Error> {
        if self.broken.as_ref() == Some(&path) {
            return Ok(());
        }
        let written = self.append(&path, shape, seen);
        self.standing.take(&seen.entry.arrivals);
        self.clips.retain(|clip| seen.entry.time <= clip.until);
        let mut appended = Ok(());
        self.clips.retain_mut(|clip| match clip.tape.push(seen) {
            Ok(()) => true,
            Err(error) => {
                appended = Err(error);
                false
            }
        });
        let was_failing = self.failing.swap(written.is_err(), Ordering::Relaxed);
        if written.is_err() {
            self.broken = Some(path);
            self.tape = None;
        } else if was_failing {
            tracing::info!(path = %path.display(), "recording again");
        }
        written.and(appended)
    }

    fn append(&mut self, path: &Path, shape: (usize, usize), seen: &Seen) -> Result<(), Error> {
        let tape = match self.tape.take().filter(|tape| tape.path() == path) {
            Some(tape) => self.tape.insert(tape),
            None => {
                let tape = TapeWriter::create(path, shape, self.standing.arrivals())?;
                self.trim(&self.folder, self.config.limit_mb, path);
                self.tape.insert(tape)
            }
        };
        tape.push(seen)
    }

    fn trim(&self, folder: &Path, limit_mb: f64, keep: &Path) {
        if let Err(error) = ring::trim(folder, bytes(limit_mb), keep) {
            metrics::counter!(metric::RECORDER_ERRORS).increment(1);
            tracing::error!(folder = %folder.display(), %error, "old recordings could not be removed");
        }
    }

    /// Starts a clip with the part of the ring before the alert.
    fn keep(&mut self, path: &Path, time: Timestamp) -> Result<(), Error> {
        let from = time
            .saturating_sub(seconds(self.config.before_s))
            .unwrap_or(Timestamp::MIN);
        let until = time
            .saturating_add(seconds(self.config.after_s))
            .unwrap_or(Timestamp::MAX);
        let mut files = recordings(&self.folder).map_err(|source| Error::Recording {
            path: self.folder.clone(),
            source,
        })?;
        // File names give the order of the files; those far before the alert need not be read.
        let few = (self.config.before_s / self.config.segment_s).ceil() as usize + 2;
        files.drain(..files.len().saturating_sub(few.max(10)));
        let mut standing = Standing::default();
        let mut clip: Option<TapeWriter> = None;
        for file in files {
            let (mut tape, stood) = TapeReader::open(&file)?;
            if clip.is_none() {
                standing = Standing::default();
                standing.take(&stood);
            }
            while let Some(seen) = tape.next()? {
                if clip.is_none() && (seen.entry.time < from || seen.pixels.is_none()) {
                    standing.take(&seen.entry.arrivals);
                    continue;
                }
                let shape = seen.pixels.as_ref().map_or((1, 1), ndarray::Array2::dim);
                let writer = match &mut clip {
                    Some(writer) => writer,
                    None => clip.insert(TapeWriter::create(path, shape, standing.arrivals())?),
                };
                match writer.push(&seen) {
                    // The camera changed its shape: the evidence ends there.
                    Err(Error::Npy(npy::Error::Shape { .. })) => break,
                    done => done?,
                }
            }
        }
        if let Some(tape) = clip {
            self.clips.push(Clip { tape, until });
            self.trim(&self.evidence, self.config.evidence_limit_mb, path);
        }
        Ok(())
    }
}

fn seconds(s: f64) -> SignedDuration {
    SignedDuration::try_from_secs_f64(s).unwrap_or(SignedDuration::MAX)
}

fn bytes(mb: f64) -> u64 {
    (mb * 1e6) as u64
}
