//! Replays a recording at its own speed, a multiple of it, or as fast as the reader accepts frames.

use std::path::Path;
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};

use super::npy::Reader;
use super::record::{self, Player};
use super::{Arrivals, Config, Error, FrameSource, Next};
use crate::frame::Frame;
use crate::toml_file::Key;

/// Opens `source.frames`: a folder of recordings of `[record]`, or one of them, with its own times and claims; or any .npy
/// file, whose times follow from `source.start` and `source.rate_hz`.
pub(super) fn open(config: &Config, joules_per_count: Option<f64>) -> Result<Box<dyn FrameSource>, Error> {
    let path = config.frames.as_ref().ok_or(Error::Missing {
        field: "frames",
        kind: "replay",
    })?;
    if !holds_times(path, config) {
        return Ok(Box::new(Replay::open(path, config, joules_per_count)?));
    }
    let files = if path.is_dir() {
        record::recordings(path).map_err(|source| Error::Recording {
            path: path.clone(),
            source,
        })?
    } else {
        vec![path.clone()]
    };
    if config.r#loop {
        return Err(Error::LoopWithTimes);
    }
    let player = Player::open(files.into())?.ok_or(Error::NoRecording { path: path.clone() })?;
    Ok(Box::new(Playback {
        player,
        pace: Pace::new(config.speed)?,
        waiting: None,
        failure: None,
        last: (0, Timestamp::UNIX_EPOCH),
    }))
}

/// Whether frames come with their own times, claims and poses: a folder of recordings of `[record]`, or one of them where
/// `source.start` says nothing else.
pub fn holds_times(path: &Path, config: &Config) -> bool {
    path.is_dir() || config.start.is_none() && record::index_of(path).exists()
}

/// A recording of `[record]`: frames, gaps and claims as the monitor received them.
struct Playback {
    player: Player,
    pace: Pace,
    /// The next event, held until it is due.
    waiting: Option<(Timestamp, Next)>,
    /// Why it ended early.
    failure: Option<String>,
    /// Index and time of the last event given.
    last: (u64, Timestamp),
}

impl FrameSource for Playback {
    fn next(&mut self, patience: Duration) -> Next {
        if self.failure.is_some() {
            return Next::End;
        }
        let (time, next) = match self.waiting.take() {
            Some(waiting) => waiting,
            None => match self.player.next() {
                Ok(Some(seen)) => {
                    self.last = (seen.entry.index, seen.entry.time);
                    (seen.entry.time, seen.next())
                }
                Ok(None) => return Next::End,
                Err(error) => {
                    tracing::error!(%error, "the recording ends early");
                    let (index, time) = self.last;
                    let reason = error.to_string();
                    self.failure = Some(reason.clone());
                    return Next::Unusable {
                        index: index + 1,
                        time,
                        reason,
                        arrivals: Arrivals::default(),
                    };
                }
            },
        };
        if self.pace.wait(time, patience) {
            return next;
        }
        self.waiting = Some((time, next));
        Next::Nothing
    }

    fn file(&self) -> Option<&Path> {
        Some(self.player.path())
    }

    fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    fn waits(&self) -> bool {
        true
    }
}

/// Frames of one .npy file. Frame k is at start + k/rate_hz at any speed; frame numbers continue over a loop.
struct Replay {
    reader: Reader,
    start: Timestamp,
    rate_hz: f64,
    exposure_s: Option<f64>,
    looped: bool,
    pace: Pace,
    next: u64,
    /// Why it ended early.
    failure: Option<String>,
}

impl Replay {
    fn open(path: &Path, config: &Config, joules_per_count: Option<f64>) -> Result<Self, Error> {
        let rate_hz = config.rate_hz.unwrap_or(Config::DEFAULT_RATE_HZ);
        Key::new("source.rate_hz").positive(rate_hz)?;
        let start = config.start.unwrap_or_else(|| {
            tracing::warn!(frames = %path.display(), "source.start is not set: frame 0 is taken to be at 1970-01-01T00:00:00Z");
            Timestamp::UNIX_EPOCH
        });
        Ok(Self {
            reader: Reader::open(path, joules_per_count)?,
            start,
            rate_hz,
            exposure_s: config.exposure_s,
            looped: config.r#loop,
            pace: Pace::new(config.speed)?,
            next: 0,
            failure: None,
        })
    }

    fn time(&self, frame: u64) -> Timestamp {
        frame_time(self.start, self.rate_hz, frame)
    }
}

/// The time of a recording's frame: start + frame/rate.
pub fn frame_time(start: Timestamp, rate_hz: f64, frame: u64) -> Timestamp {
    let nanos = (frame as f64 / rate_hz * 1e9).round();
    start
        .checked_add(SignedDuration::from_nanos_i128(nanos as i128))
        .unwrap_or(Timestamp::MAX)
}

impl FrameSource for Replay {
    fn next(&mut self, patience: Duration) -> Next {
        if self.failure.is_some() {
            return Next::End;
        }
        let time = self.time(self.next);
        if !self.pace.wait(time, patience) {
            return Next::Nothing;
        }
        if self.looped && self.reader.position() == self.reader.frames() && self.reader.seek(0).is_err() {
            return Next::End;
        }
        let index = self.next;
        match self.reader.next() {
            Some(Ok(pixels)) => {
                self.next += 1;
                let frame = Frame {
                    index,
                    time,
                    pixels,
                    masked: None,
                    exposure_s: self.exposure_s,
                    energy_scale: 1.0,
                };
                Next::Frame(frame, Arrivals::default())
            }
            Some(Err(error)) => {
                tracing::error!(%error, "the recording ends early");
                let reason = error.to_string();
                self.failure = Some(reason.clone());
                Next::Unusable {
                    index,
                    time,
                    reason,
                    arrivals: Arrivals::default(),
                }
            }
            None => Next::End,
        }
    }

    fn file(&self) -> Option<&Path> {
        Some(self.reader.path())
    }

    fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    fn waits(&self) -> bool {
        true
    }
}

/// Delays events until their recorded times are due on the wall clock.
#[derive(Debug)]
pub(super) struct Pace {
    speed: f64,
    origin: Option<(Timestamp, Instant)>,
}

impl Pace {
    /// `speed` is a multiple of the original speed; 0 is as fast as possible.
    pub fn new(speed: f64) -> Result<Self, Error> {
        match speed.is_finite() && speed >= 0.0 {
            true => Ok(Self { speed, origin: None }),
            false => Err(Key::new("source.speed")
                .refuse("0 (as fast as possible) or a positive finite number", speed)
                .into()),
        }
    }

    /// Waits until `time` is due, at most `patience`; `false` when it is not due yet. The first time asked for is due at once.
    pub fn wait(&mut self, time: Timestamp, patience: Duration) -> bool {
        if self.speed == 0.0 {
            return true;
        }
        let (first, began) = *self.origin.get_or_insert_with(|| (time, Instant::now()));
        let offset = time.duration_since(first).as_secs_f64().max(0.0) / self.speed;
        // With a speed close to zero the due time may overflow the clock: never due.
        let due = Duration::try_from_secs_f64(offset)
            .ok()
            .and_then(|d| began.checked_add(d));
        let left = due.map(|d| d.saturating_duration_since(Instant::now()));
        match left {
            Some(left) if left <= patience => {
                std::thread::sleep(left);
                true
            }
            _ => {
                std::thread::sleep(patience);
                false
            }
        }
    }
}
