//! Where the poses of a platform come from.

use jiff::Timestamp;
use nalgebra::Vector6;

use super::buffer::{PoseAt, PoseBuffer};
use super::inbox::PoseInbox;
use super::replay::Replay;
use super::telemetry;
use crate::pose::Pose;

#[allow(clippy::large_enum_variant, reason = "a platform has one")]
pub(super) enum Source {
    /// Level over (0, 0) at the camera's own altitude.
    Level,
    Fixed(Pose),
    /// From a file.
    Replay(Box<Replay>, PoseBuffer),
    /// From an autopilot, or with the frames of a recording.
    Live(PoseInbox, PoseBuffer),
}

impl Source {
    /// Reads the poses so far; `None` where there is no buffer of them.
    pub fn read<T>(&self, reader: impl FnOnce(&PoseBuffer) -> T) -> Option<T> {
        match self {
            Self::Level | Self::Fixed(_) => None,
            Self::Replay(_, poses) | Self::Live(_, poses) => Some(reader(poses)),
        }
    }

    /// Takes the poses up to `stamp`, their clock, or those that have come in after those `with_frame`; those that show no ground are
    /// refused. Returns all of them.
    pub fn receive(
        &mut self,
        with_frame: Vec<Pose>,
        stamp: Timestamp,
        shows_ground: impl Fn(&Pose) -> bool,
    ) -> Vec<Pose> {
        let (received, buffer) = match self {
            Self::Level | Self::Fixed(_) => return Vec::new(),
            Self::Replay(replay, buffer) => (replay.until(stamp), buffer),
            Self::Live(inbox, buffer) => {
                let mut received = with_frame;
                received.extend(inbox.take());
                (received, buffer)
            }
        };
        for pose in &received {
            match shows_ground(pose) {
                true => telemetry::count(buffer.insert(pose.clone())),
                false => telemetry::refused("no_ground"),
            }
        }
        received
    }

    /// The pose at `stamp`, its clock; none before the first has come.
    pub fn at(&self, stamp: Timestamp) -> Option<PoseAt> {
        match self {
            Self::Level => None,
            Self::Fixed(pose) => Some(PoseAt {
                pose: pose.clone(),
                age_s: 0.0,
                rates: Vector6::zeros(),
            }),
            Self::Replay(_, poses) | Self::Live(_, poses) => poses.at(stamp),
        }
    }
}
