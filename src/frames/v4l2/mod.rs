//! A V4L2 device as a source. Every fault is counted, the device is reopened with back-off, and an unusable frame is reported once
//! a second while there is none.

mod clock;
mod config;
mod devices;
mod exposure_control;
mod faults;
mod format;
mod image;
mod jpeg;
mod ranking;
mod response;
mod session;
mod sys;
mod unpack;

pub use config::Config;
pub use devices::{Device, DeviceFormat, devices};
pub use format::{Light, PixelFormat};
pub use image::{Bayer, Counts, DecodeError, Decoding, Granted, Layout, LayoutError, Region, to_joules};
pub use jpeg::{HuffmanTable, USUAL_HUFFMAN_TABLES, usual_tables};
pub use ranking::{Offer, rank, why};
pub use response::{Response, Transfer};
pub use session::{Settings, StartError, probe};
pub use sys::Sizes;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use v4l::v4l_sys::V4L2_BUF_FLAG_ERROR;

use super::{Arrivals, Error, FrameSource, Next};
use crate::frame::Frame;
use crate::metric;
use crate::optics::Camera;
use crate::toml_file::Key;
use clock::{Moment, Numbering, Stamped, exposed, is_monotonic};
use exposure_control::{Brightness, ExposureControl};
use faults::{Fault, Faults};
use session::Session;
use sys::{Format, Meta};

/// Without a frame for this long (two intervals of a slower device) the source reports an unusable frame, and again after as long.
const SILENCE: Duration = Duration::from_secs(1);
const SHORTEST_RETRY: Duration = Duration::from_millis(20);
const LONGEST_RETRY: Duration = Duration::from_secs(2);
/// A clock set back by more than this was corrected; a smaller step is jitter.
const CLOCK_STEP: SignedDuration = SignedDuration::from_secs(1);

/// Frames of a V4L2 capture device.
pub struct V4l2 {
    device: PathBuf,
    config: Config,
    rate_hz: f64,
    silence: Duration,
    stall: Duration,
    shape: (usize, usize),
    joules_per_count: f64,
    saturation_j: Option<f64>,
    control: Option<ExposureControl>,
    state: State,
    faults: Faults,
    numbering: Numbering,
    last_format: Option<Format>,
    last_time: Option<Timestamp>,
    last_usable: Instant,
    last_told: Instant,
    retry: Duration,
    /// Why there is no frame, for the report.
    trouble: String,
}

enum State {
    Closed { retry_at: Instant },
    Open { session: Box<Session>, settling: u32 },
}

impl V4l2 {
    /// Checks the config. The device itself is opened by the first wait; while it is absent the source waits for it.
    pub fn new(source: &super::Config, camera: &Camera) -> Result<Self, Error> {
        let missing = |field| Error::Missing { field, kind: "v4l2" };
        let positive = |name, found| Key::new("source").at(name).positive(found);
        let device = source.device.clone().ok_or(missing("device"))?;
        let config = source.v4l2.clone();
        let rate_hz = positive("rate_hz", source.rate_hz.unwrap_or(super::Config::DEFAULT_RATE_HZ))?;
        let seconds = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::MAX);
        let stall_s = positive("v4l2.stall_s", config.stall_s)?;
        if let Some(exposure) = config.exposure_us {
            positive("v4l2.exposure_us", exposure)?;
        }
        metrics::gauge!(metric::SOURCE_CONNECTED).set(0.0);
        let now = Instant::now();
        Ok(Self {
            faults: Faults::new(device.display().to_string()),
            trouble: format!("{} was not opened yet", device.display()),
            device,
            config,
            rate_hz,
            silence: SILENCE.max(seconds(2.0 / rate_hz)),
            stall: seconds(stall_s.max(3.0 / rate_hz)),
            shape: camera.shape(),
            joules_per_count: camera.joules_per_count.ok_or(Error::NoScale)?,
            saturation_j: camera.saturation_j,
            control: None,
            state: State::Closed { retry_at: now },
            numbering: Numbering::default(),
            last_format: None,
            last_time: None,
            last_usable: now,
            last_told: now,
            retry: SHORTEST_RETRY,
        })
    }

    /// What the device is and how it stands, while it is open.
    pub fn settings(&self) -> Option<&Settings> {
        match &self.state {
            State::Open { session, .. } => Some(session.settings()),
            State::Closed { .. } => None,
        }
    }

    fn close(&mut self, fault: Fault, why: impl std::fmt::Display) {
        self.trouble = why.to_string();
        self.faults.count(fault, why);
        metrics::gauge!(metric::SOURCE_CONNECTED).set(0.0);
        self.state = State::Closed {
            retry_at: Instant::now() + self.retry,
        };
        self.retry = (self.retry * 2).min(LONGEST_RETRY);
    }

    fn open(&mut self) {
        match Session::start(&self.device, &self.config, self.rate_hz, self.shape, &mut self.faults) {
            Ok(session) => {
                let format = session.granted();
                if self.last_format.is_none() {
                    // The wait for the first frame begins here, however long the start took.
                    self.last_told = Instant::now();
                }
                if let Some(before) = self.last_format.replace(format).filter(|before| *before != format) {
                    self.faults
                        .count(Fault::FormatChanged, format_args!("from {before:?} to {format:?}"));
                }
                self.control = match (self.config.auto_exposure, session.settings().exposure) {
                    (true, Some(exposure)) => Some(ExposureControl::new(1e6 * exposure.as_secs_f64())),
                    _ => None,
                };
                self.numbering.restart();
                self.last_usable = Instant::now();
                metrics::counter!(metric::SOURCE_OPENED).increment(1);
                metrics::gauge!(metric::SOURCE_CONNECTED).set(1.0);
                let settling = self.config.settle_frames;
                self.state = State::Open {
                    session: Box::new(session),
                    settling,
                };
            }
            Err(error) => self.close(error.fault(), error),
        }
    }

    /// One step: an event, or none after at most `patience`.
    fn step(&mut self, patience: Duration) -> Option<Next> {
        let (session, settling) = match &mut self.state {
            State::Closed { retry_at } => {
                let left = retry_at.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    self.open();
                } else {
                    std::thread::sleep(left.min(patience));
                }
                return None;
            }
            State::Open { session, settling } => (session, settling),
        };
        if self.last_usable.elapsed() > self.stall {
            let silent = self.last_usable.elapsed().as_secs_f64();
            self.close(Fault::Stalled, format_args!("no usable frame for {silent:.1} s"));
            return None;
        }
        match session.wait(patience) {
            Ok(true) => {}
            Ok(false) => return None,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {
                self.faults.count(Fault::Interrupted, "a signal interrupted the wait");
                return None;
            }
            Err(error) => {
                self.close(Fault::of(&error), format_args!("poll: {error}"));
                return None;
            }
        }
        let (started, exposure) = (session.started(), session.exposure());
        match session.next() {
            Ok(Some((decoded, meta))) => {
                let stale = is_monotonic(meta.flags) && meta.timestamp < started.monotonic;
                if stale || *settling > 0 {
                    *settling = settling.saturating_sub(1);
                    self.numbering.number(meta.sequence);
                    if stale {
                        self.faults
                            .count(Fault::StaleFrame, "a frame from before the stream was started");
                    }
                    return None;
                }
                Some(self.take(decoded, meta, exposure))
            }
            // A stream in error is readable without a buffer; the next dequeue gives the error.
            Ok(None) => {
                std::thread::sleep(Duration::from_millis(1).min(patience));
                None
            }
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {
                self.faults.count(Fault::Interrupted, "a signal interrupted a dequeue");
                None
            }
            Err(error) => {
                self.close(Fault::of(&error), format_args!("buffer: {error}"));
                None
            }
        }
    }

    fn take(&mut self, decoded: Result<Counts, DecodeError>, meta: Meta, exposure: Duration) -> Next {
        let (index, lost) = self.numbering.number(meta.sequence);
        if lost > 0 {
            metrics::counter!(metric::SOURCE_FRAMES_LOST).increment(lost);
            self.faults.count(
                Fault::SequenceGap,
                format_args!("{lost} frames lost before frame {index}"),
            );
        }
        let time = self.time(&meta, exposure);
        let flagged = meta.flags & V4L2_BUF_FLAG_ERROR != 0;
        let decoded = match flagged {
            true => Err((Fault::ErrorFlag, format!("the driver flags frame {index} as corrupt"))),
            false => decoded.map_err(|error| {
                let fault = match error {
                    DecodeError::Short { .. } => Fault::ShortFrame,
                    DecodeError::Jpeg(_) => Fault::DamagedImage,
                };
                (fault, format!("frame {index}: {error}"))
            }),
        };
        let Counts {
            counts: mut pixels,
            saturated,
            brightest,
        } = match decoded {
            Ok(counts) => counts,
            Err((fault, reason)) => {
                self.faults.count(fault, &reason);
                self.last_told = Instant::now();
                return Next::Unusable {
                    index,
                    time,
                    reason,
                    arrivals: Arrivals::default(),
                };
            }
        };
        let energy_scale = self.energy_scale(exposure);
        let frame = Brightness {
            share: brightest,
            is_saturated: saturated.is_some(),
        };
        self.control_exposure(index, frame);
        let masked = to_joules(&mut pixels, saturated, self.joules_per_count, self.saturation_j);
        self.last_usable = Instant::now();
        self.last_told = self.last_usable;
        self.retry = SHORTEST_RETRY;
        let frame = Frame {
            index,
            time,
            pixels,
            masked,
            exposure_s: Some(exposure.as_secs_f64()).filter(|s| *s > 0.0),
            energy_scale,
        };
        Next::Frame(frame, Arrivals::default())
    }

    /// Configured exposure over a frame's own.
    fn energy_scale(&self, exposure: Duration) -> f64 {
        match (&self.control, self.config.exposure_us) {
            (Some(_), Some(configured_us)) if !exposure.is_zero() => configured_us / (1e6 * exposure.as_secs_f64()),
            _ => 1.0,
        }
    }

    /// Changes the exposure after a frame where the control says so. Frames are skipped until the change is in force, as after a start.
    fn control_exposure(&mut self, index: u64, frame: Brightness) {
        let State::Open { session, settling } = &mut self.state else {
            return;
        };
        let Some(control) = &mut self.control else { return };
        let was_pair = control.is_pair();
        let Some(next_us) = control.after(frame) else { return };
        if let Some(granted) = session.set_exposure(next_us, &mut self.faults) {
            let exposure_us = 1e6 * granted.as_secs_f64();
            control.granted(exposure_us);
            *settling = self.config.settle_frames.max(1);
            let from_frame = index + 1 + u64::from(*settling);
            let is_pair = control.is_pair();
            if is_pair && was_pair {
                tracing::debug!(
                    exposure_us,
                    from_frame,
                    brightest = frame.share,
                    "the other exposure of a pair"
                );
            } else {
                tracing::info!(
                    exposure_us,
                    from_frame,
                    brightest = frame.share,
                    is_pair,
                    "the exposure changes"
                );
            }
        }
    }

    /// The time of a frame; it increases from frame to frame unless the clock was set back.
    fn time(&mut self, meta: &Meta, exposure: Duration) -> Timestamp {
        let Stamped { mut time, fault } = exposed(meta.flags, meta.timestamp, exposure, Moment::now());
        if let Some(fault) = fault {
            self.faults.count(
                fault,
                format_args!(
                    "stamp {:?}, flags {:#x}: the time of arrival is used",
                    meta.timestamp, meta.flags
                ),
            );
        }
        if let Some(last) = self.last_time.filter(|last| time <= *last) {
            let back = last.duration_since(time);
            self.faults.count(
                Fault::TimestampBackwards,
                format_args!("{back:#} before the last frame"),
            );
            if back < CLOCK_STEP {
                time = last.checked_add(SignedDuration::from_micros(1)).unwrap_or(last);
            }
        }
        self.last_time = Some(time);
        time
    }
}

impl FrameSource for V4l2 {
    fn next(&mut self, patience: Duration) -> Next {
        let deadline = Instant::now() + patience;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if let Some(next) = self.step(left) {
                return next;
            }
            if self.last_told.elapsed() >= self.silence {
                self.last_told = Instant::now();
                let silent = self.last_usable.elapsed().as_secs_f64();
                let reason = match self.state {
                    State::Open { .. } => format!("no frame for {silent:.0} s"),
                    State::Closed { .. } => format!("no device: {}", self.trouble),
                };
                let time = Timestamp::now();
                self.last_time = Some(time);
                return Next::Unusable {
                    index: self.numbering.next(),
                    time,
                    reason,
                    arrivals: Arrivals::default(),
                };
            }
            if left.is_zero() {
                return Next::Nothing;
            }
        }
    }
}
