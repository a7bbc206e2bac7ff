//! The chain from a frame to a report, the same for the daemon and for `review`.

use std::time::{Duration, Instant};

use jiff::Timestamp;

use crate::claims::{self, Claim, Store};
use crate::config::Config;
use crate::estimate::{self, Estimate, Estimator};
use crate::frame::Frame;
use crate::frames::{self, SourceKind};
use crate::monitor::zones::{self, Zone};
use crate::monitor::{self, KnownLight, Look, Monitor, Observation, Report, Window};
use crate::notify;
use crate::optics::Camera;
use crate::platform::{self, Placement, Platform};
use crate::pose::Pose;

/// Why a config describes no pipeline.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Estimator(#[from] estimate::ConfigError),
    #[error(transparent)]
    Monitor(#[from] monitor::ConfigError),
    #[error("{0}")]
    Places(String),
    #[error(transparent)]
    Claims(#[from] claims::ConfigError),
    #[error(transparent)]
    Source(#[from] frames::Error),
    #[error(transparent)]
    Platform(#[from] platform::Error),
}

/// Owns everything that one frame after another goes through.
pub struct Pipeline {
    estimator: Box<dyn Estimator>,
    /// Time allowed a frame.
    budget: Option<Duration>,
    camera: Camera,
    platform: Platform,
    pub claims: Store,
    pub monitor: Monitor,
}

/// The zones, known lights and maintenance windows of a config, checked.
#[derive(Clone, Debug)]
pub struct Places {
    zones: Vec<Zone>,
    lights: Vec<KnownLight>,
    windows: Vec<Window>,
}

impl Places {
    pub fn of(config: &Config) -> Result<Self, Error> {
        let zones =
            zones::load(&config.zone, config.world.axes().as_ref()).map_err(|e| Error::Places(e.to_string()))?;
        let known = notify::names(&config.webhook);
        for zone in &zones {
            if let Some(name) = zone.webhooks.iter().flatten().find(|name| !known.contains(name)) {
                let message = format!(
                    "zone {:?}: webhooks: expected the name of a [[webhook]], found {name:?}",
                    zone.name
                );
                return Err(Error::Places(message));
            }
        }
        Ok(Self {
            zones,
            lights: monitor::known_lights_of(&config.known_light).map_err(Error::Places)?,
            windows: monitor::windows_of(&config.maintenance).map_err(Error::Places)?,
        })
    }

    /// Puts them in force in place of those of an earlier config.
    pub fn put(self, monitor: &mut Monitor) -> Result<(), Error> {
        let put = monitor.set_fixed(self.zones, self.lights, self.windows);
        put.map_err(|e| Error::Places(e.to_string()))
    }
}

/// What became of a frame.
pub struct Step {
    pub report: Report,
    pub estimate: Result<Estimate, estimate::Error>,
    /// Where the camera was.
    pub placement: Placement,
    /// Time the estimator took.
    pub estimation: Duration,
    /// Time the monitor took.
    pub verdicts: Duration,
}

impl Pipeline {
    pub fn new(config: &Config, camera: &Camera) -> Result<Self, Error> {
        config.monitor.validate()?;
        config.claims.validate()?;
        let file = (config.source.kind == SourceKind::Replay)
            .then_some(config.source.frames.as_ref())
            .flatten();
        let source = monitor::Source {
            kind: config.source.kind.name().to_owned(),
            file: file.map(|f| f.display().to_string()),
            rate_hz: config.source.frame_rate_hz()?,
        };
        let mut monitor = Monitor::new(&config.monitor, &config.claims, camera, source);
        Places::of(config)?.put(&mut monitor)?;
        Ok(Self {
            estimator: estimate::build(&config.estimator, camera)?,
            budget: config.estimator.budget(),
            camera: camera.clone(),
            platform: Platform::open(&config.platform, &config.world, camera.altitude_m)?,
            claims: Store::new(&config.claims),
            monitor,
        })
    }

    /// What of the platform's surroundings the operator should know.
    pub fn warnings(&self) -> Vec<String> {
        self.platform.warnings()
    }

    /// Where an autopilot's poses go; none where they come from elsewhere.
    pub fn pose_inbox(&self) -> Option<platform::PoseInbox> {
        self.platform.inbox()
    }

    /// Takes the poses for a frame at `time`, after those `with_frame`. Returns all, for a recording.
    pub fn receive_poses(&mut self, with_frame: Vec<Pose>, time: Timestamp) -> Vec<Pose> {
        self.platform.receive(with_frame, time, &self.camera)
    }

    /// Whether the poses received tell of `time`, or will not.
    pub fn is_posed(&self, time: Timestamp) -> bool {
        self.platform.is_posed(time)
    }

    pub fn estimator(&self) -> &'static str {
        self.estimator.name()
    }

    /// Goes on with other settings for claims and monitor; users, tracks and alerts stay.
    pub fn reconfigure(&mut self, monitor: &monitor::Config, claims: &claims::Config) {
        self.monitor.reconfigure(monitor, claims);
        self.claims.reconfigure(claims);
    }

    /// Takes claims that came in at `now`, the frames' clock.
    pub fn claim(&mut self, claims: impl IntoIterator<Item = Claim>, now: Timestamp) {
        for claim in claims {
            self.claims.insert(claim, now);
        }
    }

    /// One frame through calibration, estimation and cross-check, with the claims and poses that came before.
    pub fn step(&mut self, frame: &Frame) -> Step {
        let began = Instant::now();
        let digest = frame.digest();
        let placement = self.platform.at(frame.time, &self.camera);
        let smear = frame
            .exposure_s
            .and_then(|s| self.platform.smear(&placement, &self.camera, frame.time, s));
        self.estimator.set_smear(smear.as_ref());
        self.estimator.set_sight(self.platform.passing_sight(&placement));
        let digested = Instant::now();
        let is_over = || self.budget.is_some_and(|budget| digested.elapsed() >= budget);
        let estimate = match self.blinding_share(frame) {
            Some(share) => Ok(self.blinded(share)),
            None => self.estimator.estimate_until(frame, &is_over),
        };
        let estimated = Instant::now();
        let look = match &placement {
            Placement::Level => Look::Level,
            Placement::At { sight, pose, is_lost } => Look::From {
                sight,
                age_s: pose.age_s,
                is_lost: *is_lost,
                delay_s: self.platform.delay_s(),
                by_delay: pose.rates * self.platform.delay_std_s(),
            },
            Placement::Unknown { waited_s, is_lost } => Look::Unknown {
                waited_s: *waited_s,
                is_lost: *is_lost,
            },
        };
        let observation = Observation {
            frame: frame.index,
            time: frame.time,
            result: estimate.as_ref(),
            energy_scale: frame.energy_scale,
            digest,
            look,
        };
        let report = self.monitor.step(observation, &mut self.claims);
        if let (Placement::At { pose, .. }, Some(error)) = (&placement, self.monitor.pose_error()) {
            self.platform.learn(error, pose);
        }
        Step {
            report,
            estimate,
            placement,
            estimation: estimated - began,
            verdicts: estimated.elapsed(),
        }
    }

    /// Share of the frame's pixels that are saturated, where it is too large for the frame to show anything. Whoever dazzles the
    /// sensor must not buy time with frames that take long to make sense of.
    fn blinding_share(&self, frame: &Frame) -> Option<f64> {
        let limit_j = self.camera.saturation_limit_j();
        let saturated = frame.pixels.iter().filter(|p| **p >= limit_j).count();
        let share = saturated as f64 / frame.pixels.len().max(1) as f64;
        (share >= monitor::BLINDING_SHARE).then_some(share)
    }

    fn blinded(&self, saturated_share: f64) -> Estimate {
        Estimate {
            emitters: Vec::new(),
            is_cut_short: false,
            is_limited: false,
            estimator: self.estimator.name(),
            reduced_chi2: f64::NAN,
            spot_error: 0.0,
            saturated_share,
            condition: 1.0,
            steps: 0,
        }
    }

    /// A frame that the source could not deliver whole.
    pub fn unusable(&mut self, index: u64, time: Timestamp, reason: &str) -> Report {
        self.monitor.unusable(index, time, reason, &mut self.claims)
    }
}
