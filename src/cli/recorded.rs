//! The frames that `locate` reads: of an .npy file, at times that follow from the config, or of a recording of `[record]`, with its own
//! times, masks and poses.

use std::path::{Path, PathBuf};
use std::time::Duration;

use jiff::Timestamp;

use super::Failure;
use crate::config::Config;
use crate::frame::Frame;
use crate::frames::{self, FrameSource, Next, SourceKind, npy};
use crate::optics::Camera;
use crate::pose::Pose;

/// A frame, or why there is none, and the poses that came with it.
pub struct Shot {
    pub index: u64,
    pub time: Timestamp,
    pub frame: Result<Frame, String>,
    pub poses: Vec<Pose>,
}

/// Gives shots until the file ends, or one error where it is damaged.
pub struct Recorded {
    path: PathBuf,
    source: Source,
}

enum Source {
    File {
        frames: std::iter::Enumerate<npy::Reader>,
        start: Timestamp,
        rate_hz: f64,
        exposure_s: Option<f64>,
    },
    Recording(Box<dyn FrameSource>),
}

impl Recorded {
    pub fn open(path: &Path, config: &Config, camera: &Camera) -> Result<Self, Failure> {
        let is_stdin = path == Path::new("-");
        let path = if is_stdin { Path::new("/dev/stdin") } else { path };
        let source = if !is_stdin && frames::holds_times(path, &config.source) {
            let replay = frames::Config {
                kind: SourceKind::Replay,
                frames: Some(path.to_owned()),
                speed: 0.0,
                r#loop: false,
                ..config.source.clone()
            };
            Source::Recording(frames::open(&replay, camera).map_err(Failure::input)?)
        } else {
            Source::File {
                frames: npy::Reader::open(path, camera.joules_per_count)
                    .map_err(Failure::input)?
                    .enumerate(),
                start: config.source.start.unwrap_or(Timestamp::UNIX_EPOCH),
                rate_hz: config.source.rate_hz.unwrap_or(frames::Config::DEFAULT_RATE_HZ),
                exposure_s: config.source.exposure_s,
            }
        };
        let path = path.to_owned();
        Ok(Self { path, source })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Iterator for Recorded {
    type Item = Result<Shot, npy::Error>;

    fn next(&mut self) -> Option<Self::Item> {
        match &mut self.source {
            Source::File {
                frames,
                start,
                rate_hz,
                exposure_s,
            } => {
                let (index, pixels) = frames.next()?;
                let index = index as u64;
                let time = frames::frame_time(*start, *rate_hz, index);
                Some(pixels.map(|pixels| Shot {
                    index,
                    time,
                    frame: Ok(Frame {
                        index,
                        time,
                        pixels,
                        masked: None,
                        exposure_s: *exposure_s,
                        energy_scale: 1.0,
                    }),
                    poses: Vec::new(),
                }))
            }
            Source::Recording(source) => loop {
                let shot = match source.next(Duration::ZERO) {
                    Next::Frame(frame, arrivals) => Shot {
                        index: frame.index,
                        time: frame.time,
                        frame: Ok(frame),
                        poses: arrivals.poses,
                    },
                    Next::Unusable {
                        index,
                        time,
                        reason,
                        arrivals,
                    } => Shot {
                        index,
                        time,
                        frame: Err(reason),
                        poses: arrivals.poses,
                    },
                    Next::Nothing => continue,
                    Next::End => return None,
                };
                return Some(Ok(shot));
            },
        }
    }
}
