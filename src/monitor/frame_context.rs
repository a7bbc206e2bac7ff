//! What rules may read: one frame's claims, tracks and their association, our pose, and the alerts as they stand.

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::alert_lifecycle::AlertLifecycle;
use super::ambiguity;
use super::config::{Config, Source};
use super::input::claim_state::ActiveClaim;
use super::input::claim_timing::ClaimTiming;
use super::input::crowding::Crowding;
use super::input::sensor_health::SensorHealth;
use super::pose::consensus::PoseConsensus;
use super::stats::error_budget::{ErrorBudget, TestFamily};
use super::track::association::Association;
use super::track::beam_track::Track;
use super::track::detection::{OVERLAP, spot_m};
use super::track::tracker::Tracker;
use super::track::user_tracks::UserTracks;
use crate::claims::{Squeeze, seconds};
use crate::optics::Camera;

/// Standard deviation of what is systematic in positions and does not average out, m. Larger delays the alert of a drift, smaller
/// takes calibration errors for one. Not measured.
const SYSTEMATIC_M: f64 = 0.05;

/// Largest score of a track in thresholds: beyond it more hits do not outweigh later misses. Not measured.
const MAX_SCORE: f64 = 1.5;
/// Time since a user was last seen, beside any blindness, within which they count as visible, s. Longer takes users who have left
/// for a lost sensor, shorter forgets those whom a few frames missed. Not measured.
const VISIBLE_S: f64 = 2.0;

/// Claims that found no room or time, lately, and the room there is.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Overload {
    pub squeezed: Squeeze,
    /// Claims that bear on the view and that the frame had no time for.
    pub left_out: usize,
    pub users: usize,
    pub max_users: usize,
}

/// Largest score of a track.
fn max_score(budget: &ErrorBudget) -> f64 {
    MAX_SCORE * budget.threshold(TestFamily::Unclaimed, 1.0)
}

/// What all rules read: the settings, what frames and claims so far have shown, and the newest frame. The monitor alone changes it.
pub(super) struct FrameContext {
    pub config: Config,
    pub camera: Camera,
    pub budget: ErrorBudget,
    /// Standard deviation of claims that state none, m.
    pub default_sigma_m: f64,
    /// The newest time so far.
    pub time: Option<Timestamp>,
    pub sensor: SensorHealth,
    pub timing: ClaimTiming,
    pub tracker: Tracker,
    pub pose: PoseConsensus,
    pub users: UserTracks,
    pub alerts: AlertLifecycle,
    /// Time of this frame.
    pub now: Timestamp,
    /// Active claims, by user.
    pub claims: Vec<ActiveClaim>,
    /// The track of each of `claims`.
    pub association: Association,
    /// Seconds since the newest claim came and since it was made; none before the first.
    pub claims_quiet_s: Option<(f64, f64)>,
    /// What of the log found no room or time.
    pub overload: Overload,
    /// Whether a claim near a beam is evidence.
    pub crowding: Crowding,
    /// Seconds by which the log's clock is ahead of ours.
    pub clock_offset_s: f64,
}

impl FrameContext {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        let budget = ErrorBudget::new(config, source.rate_hz);
        Self {
            config: config.clone(),
            camera: camera.clone(),
            budget,
            default_sigma_m: claims.default_sigma_m,
            time: None,
            sensor: SensorHealth::default(),
            timing: ClaimTiming::default(),
            tracker: Tracker::new(max_score(&budget)),
            pose: PoseConsensus::default(),
            users: UserTracks::default(),
            alerts: AlertLifecycle::new(source.kind, source.file, config.cool_down_s),
            now: Timestamp::UNIX_EPOCH,
            claims: Vec::new(),
            association: Association::none(0),
            claims_quiet_s: None,
            overload: Overload::default(),
            crowding: Crowding::default(),
            clock_offset_s: 0.0,
        }
    }

    /// Goes on with other settings.
    pub fn reconfigure(&mut self, config: &Config, claims: &crate::claims::Config) {
        self.config = config.clone();
        self.budget = self.budget.reconfigured(config);
        self.default_sigma_m = claims.default_sigma_m;
        self.tracker.set_max_score(max_score(&self.budget));
        self.alerts.set_cool_down(config.cool_down_s);
    }

    /// Forgets what frames have shown: all but the settings and the alerts.
    pub fn forget(&mut self) {
        self.tracker.forget();
        self.time = None;
        self.sensor = SensorHealth::default();
        self.timing = ClaimTiming::default();
        self.pose = PoseConsensus::default();
        self.users = UserTracks::default();
    }

    /// Takes the time of a frame.
    pub fn saw_time(&mut self, now: Timestamp) {
        self.time = Some(self.time.map_or(now, |t| t.max(now)));
    }

    /// Active users whose beam was seen a moment ago, or just before the sensor went blind.
    pub fn visible_users(&self) -> usize {
        let within_s = VISIBLE_S + self.sensor.blind_s(self.now);
        let active = self.claims.iter().filter(|a| !a.ended);
        active
            .filter_map(|a| a.before.last_seen)
            .filter(|t| seconds(*t, self.now) < within_s)
            .count()
    }

    /// The track that claim `i` is associated with.
    pub fn track(&self, i: usize) -> Option<&Track> {
        self.tracker.get(self.association.track_id(i)?)
    }

    /// Whether everybody has had time to claim once. Before that our own pose and the log's clock are not known.
    pub fn is_settled(&self) -> bool {
        self.timing.is_settled(self.now)
    }

    /// How long what may be a user's waits for a claim, s.
    pub fn claim_wait_s(&self) -> f64 {
        self.timing.claim_wait_s(self.config.decision_s)
    }

    /// What the log's clock may still be off, s.
    pub fn clock_uncertainty_s(&self) -> f64 {
        let tolerated_s = self.config.tolerated_clock_offset_s;
        self.timing.clock_uncertainty_s(self.now, tolerated_s)
    }

    /// Covariance of what all residuals of a user at `p` share, m²: our own pose and what is systematic in positions.
    pub fn systematic_cov(&self, p: Vector2<f64>) -> Matrix2<f64> {
        Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance(p))
    }

    /// σ of a spot on the ground, m.
    pub fn spot_m(&self) -> f64 {
        spot_m(&self.camera)
    }

    /// Distance within which two beams disturb each other, m.
    pub fn overlap_m(&self) -> f64 {
        OVERLAP * self.spot_m()
    }

    /// How far from its own place the beam of `track` may be taken for, m.
    pub fn confusion_m(&self, track: &Track) -> f64 {
        ambiguity::confusion_m(track, &self.tracker, &self.association, self.overlap_m())
    }
}
