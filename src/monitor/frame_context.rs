//! What rules may read: one frame's claims, tracks and their association, our pose, and the alerts as they stand.

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::alert_lifecycle::AlertLifecycle;
use super::ambiguity;
use super::config::Config;
use super::input::claim_state::ActiveClaim;
use super::input::claim_timing::ClaimTiming;
use super::input::crowding::Crowding;
use super::input::sensor_health::SensorHealth;
use super::pose::consensus::PoseConsensus;
use super::stats::error_budget::ErrorBudget;
use super::track::association::{Association, UserTracks};
use super::track::detection::{OVERLAP, spot_m};
use super::track::tracker::{Track, Tracker};
use crate::claims::Squeeze;
use crate::optics::Camera;

/// Standard deviation of what is systematic in positions and does not average out, m. Larger delays the alert of a drift, smaller
/// takes calibration errors for one. Not measured.
const SYSTEMATIC_M: f64 = 0.05;

/// Claims that found no room or time, lately, and the room there is.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Overload {
    pub squeezed: Squeeze,
    /// Claims that bear on the view and that the frame had no time for.
    pub left_out: usize,
    pub users: usize,
    pub max_users: usize,
}

/// Read-only view of one frame.
#[derive(Clone, Copy)]
pub(super) struct FrameContext<'a> {
    pub now: Timestamp,
    pub config: &'a Config,
    pub camera: &'a Camera,
    pub budget: &'a ErrorBudget,
    pub sensor: &'a SensorHealth,
    pub timing: &'a ClaimTiming,
    /// Seconds by which the log's clock is ahead of ours.
    pub clock_offset_s: f64,
    /// Seconds since the newest claim came and since it was made; none before the first.
    pub claims_quiet_s: Option<(f64, f64)>,
    /// What of the log found no room or time.
    pub overload: Overload,
    /// Whether a claim near a beam is evidence.
    pub crowding: Crowding,
    /// Active claims, by user.
    pub claims: &'a [ActiveClaim],
    pub tracker: &'a Tracker,
    /// The track of each of `claims`.
    pub association: &'a Association,
    pub users: &'a UserTracks,
    pub pose: &'a PoseConsensus,
    pub alerts: &'a AlertLifecycle,
}

impl<'a> FrameContext<'a> {
    /// The track that claim `i` is associated with.
    pub fn track(&self, i: usize) -> Option<&'a Track> {
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
        spot_m(self.camera)
    }

    /// Distance within which two beams disturb each other, m.
    pub fn overlap_m(&self) -> f64 {
        OVERLAP * self.spot_m()
    }

    /// How far from its own place the beam of `track` may be taken for, m.
    pub fn confusion_m(&self, track: &Track) -> f64 {
        ambiguity::confusion_m(track, self.tracker, self.association, self.overlap_m())
    }
}
