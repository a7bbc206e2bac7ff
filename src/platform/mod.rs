//! The platform that the camera is mounted on: where its poses come from (none for a fixed one, a recording, an autopilot), and
//! the camera's sight at a frame's time.

mod buffer;
mod config;
mod delay;
mod inbox;
#[allow(
    clippy::disallowed_methods,
    reason = "telemetry is dated when it arrives, and waits have an end"
)]
pub mod mavlink;
mod place;
pub mod px4_log;
mod replay;
mod source;
mod telemetry;

use std::collections::VecDeque;
use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use nalgebra::Vector6;

pub use buffer::{Counts, Outcome, PoseAt, PoseBuffer};
pub use config::{Config, ConfigError, Kind};
pub use inbox::PoseInbox;
pub use place::{Origin, Place, SeaLevelPlace, Unplaced};
pub use replay::{Error as ReplayError, LineError};
pub use telemetry::{Error as TelemetryError, Telemetry, open as open_telemetry};

use crate::geo::{self, Sight, Terrain};
use crate::optics::{Camera, Smear};
use crate::pose::{Mount, Pose};
use crate::time::seconds;
use buffer::UNIFORM_S;
use delay::DelayEstimate;
use replay::Replay;
use source::Source;

/// Age of the newest pose, s, from which on it has ended rather than is late, and frames do not wait for another.
const ENDED_S: f64 = 1.0;

/// Why there are no poses.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("platform.poses: {0}")]
    Replay(#[from] ReplayError),
    #[error("world.terrain: {0}")]
    Terrain(#[from] geo::TerrainError),
    #[error(
        "[optics] altitude_m: expected a lens above the ground, which [world] terrain has at z = {ground_m:.1} m there, found {altitude_m} m above world.origin.height_m"
    )]
    Buried { altitude_m: f64, ground_m: f64 },
}

/// Rates are taken over this time to either side of a frame, s: much longer than from pose to pose, so that the poses' own noise
/// is little of them, and short against a sway.
const RATES_OVER_S: f64 = 0.1;
/// Rates within an exposure are taken over at least this time to either side of its middle, s: longer misses a sway's turning, shorter takes
/// the poses' own noise for motion: 3 mrad a pose make 0.04 rad/s, or 0.4 mrad of smear in 10 ms.
const SMEAR_OVER_S: f64 = 0.05;
/// Frames that wait for the poses after them.
const MOST_WAITING: usize = 64;

/// The platform and the camera's mount on it.
pub struct Platform {
    source: Source,
    mount: Mount,
    /// The ground; without it the plane z = 0.
    terrain: Option<Arc<Terrain>>,
    delay_s: Option<f64>,
    lost_s: f64,
    /// What is learned of the delay where none is configured.
    learned: DelayEstimate,
    /// When a pose was first asked for in vain.
    waiting_since: Option<Timestamp>,
    /// The newest frame that has been learned from.
    learned_at: Option<Timestamp>,
    /// Pose errors by the time of their pose, until the poses after them are there.
    unlearned: VecDeque<Unlearned>,
}
/// The pose error of a frame, by the time of its pose, which was taken `delay_s` late.
#[derive(Clone, Copy)]
struct Unlearned {
    time: Timestamp,
    error: Vector6<f64>,
    delay_s: f64,
}

/// Where the camera is in one frame.
#[derive(Clone, Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "a frame has one, and boxing it would allocate in each"
)]
pub enum Placement {
    /// Level over (0, 0) at the camera's own altitude.
    Level,
    At {
        sight: Sight,
        pose: Box<PoseAt>,
        /// The newest pose is older than is tolerated.
        is_lost: bool,
    },
    /// No pose has come yet.
    Unknown { waited_s: f64, is_lost: bool },
}

impl Platform {
    /// Opens what a config names; `altitude_m` is a fixed platform's. An autopilot's poses come in through [`Platform::inbox`].
    pub fn open(config: &Config, world: &geo::Config, altitude_m: f64) -> Result<Self, Error> {
        config.validate()?;
        let terrain = Terrain::of_config(world)?;
        let source = match (config.kind, &config.poses) {
            (Kind::Replay, Some(path)) => {
                let replay = Replay::open(path, world, config.poses_start)?;
                Source::Replay(Box::new(replay), PoseBuffer::default())
            }
            (Kind::Fixed, _) if config.mount.is_none() && terrain.is_none() => Source::Level,
            (Kind::Fixed, _) => Source::Fixed(Pose::level(Timestamp::UNIX_EPOCH, [0.0, 0.0, altitude_m])),
            _ => Source::Live(PoseInbox::default(), PoseBuffer::default()),
        };
        if let (Source::Fixed(_), Some(ground)) = (&source, terrain.as_ref().and_then(|t| t.at([0.0, 0.0])))
            && !(altitude_m > ground.z_m)
        {
            let ground_m = ground.z_m;
            return Err(Error::Buried { altitude_m, ground_m });
        }
        Ok(Self {
            source,
            mount: config.mount,
            terrain: terrain.map(Arc::new),
            delay_s: config.delay_s,
            lost_s: config.pose_lost_s,
            learned: DelayEstimate::default(),
            waiting_since: None,
            learned_at: None,
            unlearned: VecDeque::new(),
        })
    }

    /// A fixed, level platform.
    pub fn level() -> Self {
        Self {
            source: Source::Level,
            mount: Mount::default(),
            terrain: None,
            delay_s: None,
            lost_s: Config::default().pose_lost_s,
            learned: DelayEstimate::default(),
            waiting_since: None,
            learned_at: None,
            unlearned: VecDeque::new(),
        }
    }

    /// What of the ground the operator should know.
    pub fn warnings(&self) -> Vec<String> {
        self.terrain
            .as_ref()
            .map(|terrain| terrain.warnings())
            .unwrap_or_default()
    }

    /// Where a receiver of poses puts them; none but for an autopilot's.
    pub fn inbox(&self) -> Option<PoseInbox> {
        match &self.source {
            Source::Live(inbox, _) => Some(inbox.clone()),
            _ => None,
        }
    }

    /// Takes the poses that are there for a frame at `time`, after those that a recording has `with_frame`. Returns them, so that a
    /// recording of them has [`Platform::at`] say the same again. A file of poses is preferred to those of a recording. One that shows
    /// `camera` no ground cannot be true and is refused.
    pub fn receive(&mut self, with_frame: Vec<Pose>, time: Timestamp, camera: &Camera) -> Vec<Pose> {
        let stamp = self.stamp(time);
        let (mount, terrain) = (&self.mount, &self.terrain);
        let shows_ground = |pose: &Pose| Sight::new(pose, mount).over(terrain.clone()).sees_ground(camera);
        self.source.receive(with_frame, stamp, shows_ground)
    }

    /// Whether the poses received tell of a frame at `time` as exactly as rates that go on do, or will not: none come, or they have ended.
    pub fn is_posed(&self, time: Timestamp) -> bool {
        let newest = self.source.read(|poses| poses.newest().map(|pose| pose.time)).flatten();
        newest.is_none_or(|newest| !(UNIFORM_S..ENDED_S).contains(&seconds(newest, self.stamp(time))))
    }

    /// A frame's time on the clock of the poses.
    fn stamp(&self, time: Timestamp) -> Timestamp {
        let delay = SignedDuration::from_secs_f64(self.delay_s());
        time.saturating_add(delay).unwrap_or(time)
    }

    /// Pose stamps minus frame stamps, s: as configured, or as learned so far.
    pub fn delay_s(&self) -> f64 {
        self.delay_s.unwrap_or(self.learned.delay_s())
    }

    /// How exactly that is known, s.
    pub fn delay_std_s(&self) -> f64 {
        self.delay_s.map_or(self.learned.std_s(), |_| 0.0)
    }

    /// Learns the delay from the pose error that the beams of a frame share, where it is not configured. `pose` is that of the
    /// frame.
    pub fn learn(&mut self, error: &Vector6<f64>, pose: &PoseAt) {
        if self.delay_s.is_some() || pose.age_s >= UNIFORM_S {
            return;
        }
        if self.unlearned.len() == MOST_WAITING {
            self.unlearned.pop_front();
        }
        self.unlearned.push_back(Unlearned {
            time: pose.pose.time,
            error: *error,
            delay_s: self.delay_s(),
        });
        let Some(newest) = self.source.read(|poses| poses.newest().map(|pose| pose.time)).flatten() else {
            return;
        };
        while let Some(Unlearned { time, error, delay_s }) = self.unlearned.front().copied()
            && seconds(time, newest) >= RATES_OVER_S
        {
            self.unlearned.pop_front();
            let rates = self.source.read(|poses| poses.rates_about(time, RATES_OVER_S));
            if let Some(rates) = rates.flatten() {
                let dt_s = self.learned_at.map_or(0.0, |t| seconds(t, time));
                self.learned_at = Some(time);
                self.learned.learn(&error, delay_s, &rates, dt_s);
            }
        }
    }

    /// How spots move during an exposure of `exposure_s` at `time`, where the camera is placed as said; `None` where that is not known.
    pub fn smear(&self, placement: &Placement, camera: &Camera, time: Timestamp, exposure_s: f64) -> Option<Smear> {
        let Placement::At { sight, .. } = placement else {
            return None;
        };
        let half_s = (0.5 * exposure_s).max(SMEAR_OVER_S);
        let rates = self.source.read(|poses| poses.mean_rates(self.stamp(time), half_s));
        sight.smear(camera, &rates.flatten()?, exposure_s)
    }

    /// The sight of a placed camera, where it may be another in the next frame.
    pub fn passing_sight<'p>(&self, placement: &'p Placement) -> Option<&'p Sight> {
        match (placement, &self.source) {
            (Placement::At { sight, .. }, Source::Replay(..) | Source::Live(..)) => Some(sight),
            _ => None,
        }
    }

    /// Where `camera` is at a frame's `time`, by the poses received. One that shows it no ground, such as a fixed one of a wrong mount, is none.
    pub fn at(&mut self, time: Timestamp, camera: &Camera) -> Placement {
        let stamp = self.stamp(time);
        if let Source::Level = self.source {
            return Placement::Level;
        }
        let found = self.source.at(stamp);
        let seen = found.and_then(|mut pose| {
            let by_delay = pose.rates * self.delay_std_s();
            pose.pose.cov += by_delay * by_delay.transpose();
            let sight = Sight::new(&pose.pose, &self.mount).over(self.terrain.clone());
            sight.sees_ground(camera).then_some((sight, pose))
        });
        let Some((sight, pose)) = seen else {
            let waited_s = seconds(*self.waiting_since.get_or_insert(time), time).max(0.0);
            return Placement::Unknown {
                waited_s,
                is_lost: waited_s > self.lost_s,
            };
        };
        self.waiting_since = None;
        Placement::At {
            sight,
            is_lost: pose.age_s > self.lost_s,
            pose: Box::new(pose),
        }
    }
}

#[cfg(test)]
#[path = "platform_test.rs"]
mod tests;
