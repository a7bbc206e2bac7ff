//! What rules may read: one frame's claims, tracks and their association, our pose, and the alerts as they stand.

use jiff::Timestamp;
use nalgebra::{Matrix2, Matrix2x6, Matrix6, Vector2, Vector6};

use super::alert_lifecycle::AlertLifecycle;
use super::ambiguity;
use super::config::{Config, Source};
use super::input::claim_state::{ActiveClaim, is_near_view};
use super::input::claim_timing::ClaimTiming;
use super::input::crowding::Crowding;
use super::input::overload::Overload;
use super::input::sensor_health::SensorHealth;
use super::known_lights::{KnownLight, KnownLights, LightError, Request};
use super::light_history::LightHistory;
use super::maintenance::Maintenance;
use super::pose::bias::PoseBias;
use super::pose::consensus::PoseConsensus;
use super::pose::wander::PoseWander;
use super::pose::witness::residuals;
use super::report::Look;
use super::stats::error_budget::{ErrorBudget, TestFamily};
use super::stats::gaussian::largest_eigenvalue;
use super::track::association::Association;
use super::track::beam_track::Track;
use super::track::common_course::{CommonCourse, Pull};
use super::track::detection::{Detection, OVERLAP, spot_m};
use super::track::registration::register;
use super::track::tracker::Tracker;
use super::track::user_tracks::UserTracks;
use super::zones::ZoneMap;
use crate::geo::{LocalAxes, View};
use crate::optics::Camera;
use crate::time::seconds;

/// Standard deviation of what is systematic in positions and does not average out, m. Larger delays the alert of a drift, smaller
/// takes calibration errors for one. Not measured.
const SYSTEMATIC_M: f64 = 0.05;

/// Share of the pose's variance that is left at a place beside the lasting error, what changes within seconds, until users have shown that for so
/// long, s. Larger delays the alert of a displaced user, smaller takes such a rest for a displacement. Not measured.
const UNMODELLED: f64 = 0.05;
const SHOWN_S: f64 = 10.0;

/// Age of a pose up to which it says where tracks are, s.
const FRESH_S: f64 = 0.3;

/// Largest score of a track in thresholds: beyond it more hits do not outweigh later misses. Not measured.
const MAX_SCORE: f64 = 1.5;
/// Time since a user was last seen, beside any blindness, within which they count as visible, s. Longer takes users who have left
/// for a lost sensor, shorter forgets those whom a few frames missed. Not measured.
const VISIBLE_S: f64 = 2.0;

/// Largest score of a track.
fn max_score(budget: &ErrorBudget) -> f64 {
    MAX_SCORE * budget.threshold(TestFamily::Unclaimed, 1.0)
}

/// What all rules read: the settings, what frames and claims so far have shown, and the newest frame. The monitor alone changes it.
pub(super) struct FrameContext {
    pub config: Config,
    /// What the camera sees in this frame.
    pub view: View,
    /// Where the world's axes lie on the earth, where that is known.
    pub axes: Option<LocalAxes>,
    pub budget: ErrorBudget,
    /// Standard deviation of claims that state none, m.
    pub default_sigma_m: f64,
    /// The newest time so far.
    pub time: Option<Timestamp>,
    pub sensor: SensorHealth,
    pub timing: ClaimTiming,
    pub tracker: Tracker,
    pub pose: PoseConsensus,
    /// The pose error that lasts.
    pub bias: PoseBias,
    /// How the displacement that users share changes.
    pub wander: PoseWander,
    /// The error of this frame's pose that its beams share, but for a steady course.
    pub pose_error: Option<Vector6<f64>>,
    /// Whether it is known where the camera is.
    pub is_placed: bool,
    /// Age of the newest pose, s.
    pose_age_s: f64,
    /// Age of the newest pose, where it is older than is tolerated, s.
    pub pose_lost_s: Option<f64>,
    /// Covariance of the pose error that all tracks share.
    track_frame_cov: Option<Matrix6<f64>>,
    /// How fast tracks follow the poses.
    course: CommonCourse,
    pub users: UserTracks,
    pub alerts: AlertLifecycle,
    pub light: LightHistory,
    pub lights: KnownLights,
    pub zones: ZoneMap,
    pub maintenance: Maintenance,
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
            view: View::level(camera),
            axes: claims.axes,
            budget,
            default_sigma_m: claims.default_sigma_m,
            time: None,
            sensor: SensorHealth::default(),
            timing: ClaimTiming::default(),
            tracker: Tracker::new(max_score(&budget)),
            pose: PoseConsensus::default(),
            bias: PoseBias::default(),
            wander: PoseWander::default(),
            pose_error: None,
            is_placed: true,
            pose_age_s: 0.0,
            pose_lost_s: None,
            track_frame_cov: None,
            course: CommonCourse::default(),
            users: UserTracks::default(),
            alerts: AlertLifecycle::new(source.kind, source.file, config.cool_down_s),
            light: LightHistory::default(),
            lights: KnownLights::default(),
            zones: ZoneMap::default(),
            maintenance: Maintenance::default(),
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
        self.bias = PoseBias::default();
        self.wander = PoseWander::default();
        self.track_frame_cov = None;
        self.course.restart();
        self.users = UserTracks::default();
        self.lights.forget_tracks();
        self.light = LightHistory::default();
    }

    /// Takes where the camera is and looks in this frame.
    pub fn look(&mut self, look: Look) {
        self.pose_age_s = match look {
            Look::From { age_s, .. } => age_s,
            _ => 0.0,
        };
        (self.is_placed, self.pose_lost_s) = match look {
            Look::Level => (true, None),
            Look::From { age_s, is_lost, .. } => (true, is_lost.then_some(age_s)),
            Look::Unknown { waited_s, is_lost } => (false, is_lost.then_some(waited_s)),
        };
        self.pose_error = None;
        self.view.sight = match look {
            Look::From { sight, .. } => Some(sight.clone()),
            _ => None,
        };
        if let Look::From {
            sight,
            delay_s,
            by_delay,
            ..
        } = look
        {
            let nadir = sight.ground_at(self.view.nadir_m().into());
            let off = nadir.map_or_else(Vector2::zeros, |p| p.by_pose * by_delay);
            self.course.take_delay(delay_s, off.norm());
        }
    }

    /// Takes the pose error that all detections share out of them and out of the view. How far off the tracks themselves may be
    /// is then what the best pose lately left, and what each frame since has added: a pose that grows old moves no track.
    pub fn register(&mut self, detections: &mut [Detection], dt: f64) {
        let Some(sight) = &self.view.sight else {
            return;
        };
        if self.tracker.tracks.iter().all(|t| !t.confirmed) {
            self.course.restart();
        }
        let pull = match self.pose_age_s < FRESH_S {
            true => self.course.pull(dt),
            false => {
                self.course.lose(dt);
                Pull::default()
            }
        };
        let Some(found) = register(&self.tracker.tracks, detections, sight.cov(), pull.position) else {
            return;
        };
        for track in &mut self.tracker.tracks {
            if let Some(point) = sight.ground_at(track.filter.position().into()) {
                let off = point.by_pose * found.error;
                track.filter.shift(off * pull.position, off * pull.velocity);
            }
        }
        let drifted = self.track_frame_cov.map(|cov| cov + found.cov);
        let nadir = sight.ground_at(self.view.nadir_m().into());
        let of = |cov: &Matrix6<f64>| nadir.as_ref().map_or(0.0, |p| p.pose_cov(cov).trace());
        let cov = match drifted {
            Some(drifted) if of(&drifted) < of(sight.cov()) => drifted,
            _ => *sight.cov(),
        };
        self.track_frame_cov = Some(cov);
        let by_pose = nadir.as_ref().map_or_else(Matrix2x6::zeros, |p| p.by_pose);
        self.pose_error = Some(self.course.take(&found, &by_pose, pull, dt));
        self.view.sight = Some(sight.corrected(&(-found.error * (1.0 - pull.position)), cov));
    }

    /// Takes the time of a frame.
    pub fn saw_time(&mut self, now: Timestamp) {
        self.time = Some(self.time.map_or(now, |t| t.max(now)));
    }

    /// Active users whose beam was seen a moment ago, or just before the sensor went blind, and where it is is in view still.
    pub fn visible_users(&self) -> usize {
        let within_s = VISIBLE_S + self.sensor.blind_s(self.now);
        let track = |a: &ActiveClaim| self.tracker.get(a.before.track?);
        let place = |a: &ActiveClaim| track(a).map_or(a.position, |track| track.filter.position());
        let active = self.claims.iter().filter(|a| !a.ended);
        active
            .filter(|a| is_near_view(&self.view, place(a), 0.0))
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
        let systematic = Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance(p));
        systematic + self.bias_cov(p, UNMODELLED * SHOWN_S / (SHOWN_S + self.wander.seen_s()))
    }

    /// Takes what this frame's beams and claims say of the pose error that lasts and of how it changes, `dt` seconds after the last
    /// frame.
    pub fn update_bias(&mut self, dt: f64, period_s: f64) {
        if let Some(sight) = &self.view.sight {
            let residuals = residuals(&self.claims, &self.tracker, &self.view, self.bias.error());
            let is_fresh = self.pose_age_s < FRESH_S;
            let prior = (is_fresh || !self.bias.has_prior()).then(|| sight.cov());
            self.bias.update(&residuals, &sight.axes(), prior, dt, period_s);
            let shared = self.bias.shared_offset(&residuals).filter(|_| is_fresh);
            self.wander.update(shared, &self.course.cov(), dt, period_s);
        }
    }

    /// How far the lasting pose error displaces a beam at `p`, m; nowhere for a fixed platform.
    pub fn bias_at(&self, p: Vector2<f64>) -> Vector2<f64> {
        self.view.displaced(p, self.bias.error()) - p
    }

    /// How far all pose error that is known displaces a beam at `p`, m.
    pub fn displacement_at(&self, p: Vector2<f64>) -> Vector2<f64> {
        self.bias_at(p) + self.pose.displacement().at(p)
    }

    /// A track's place in the world, m: without the lasting pose error where the platform moves.
    pub fn position(&self, track: &Track) -> Vector2<f64> {
        self.view.undisplaced(track.filter.position(), self.bias.error())
    }

    /// What the pose makes of a place's covariance, m²: what lasts, what users share, and a share that is `unmodelled`; zero for a fixed
    /// platform.
    fn bias_cov(&self, p: Vector2<f64>, unmodelled: f64) -> Matrix2<f64> {
        let Some(sight) = &self.view.sight else {
            return Matrix2::zeros();
        };
        let by_pose = self.view.by_pose(p);
        let cov = self.bias.cov() + self.course.cov() + sight.cov() * unmodelled;
        by_pose * cov * by_pose.transpose() + Matrix2::identity() * self.wander.wandered()
    }

    /// Covariance of a track's position in the world, m²: its own and our pose's.
    pub fn position_cov(&self, track: &Track) -> Matrix2<f64> {
        track.filter.position_cov() + self.bias_cov(track.filter.position(), 0.0)
    }

    /// Associates known lights with the tracks that are no user's.
    pub fn associate_lights(&mut self) {
        if !self.lights.is_empty() {
            let displacement = self.pose.displacement();
            self.lights.associate(
                &self.tracker,
                &mut self.association,
                &self.alerts,
                displacement,
                self.now,
            );
        }
    }

    /// Approves a place or the emitter of an open alert.
    pub fn approve(&mut self, request: Request) -> Result<KnownLight, LightError> {
        self.lights.approve(request, &self.alerts, self.pose.displacement())
    }

    /// Whether a beam that nobody claims since `since` is a known light that went out; then it is associated with that.
    pub fn displace_light(&mut self, track: u64, since: Timestamp) -> bool {
        let is_light = self.lights.displace(track, since, self.now, self.config.cool_down_s);
        if is_light {
            self.association.assign_light(track);
        }
        is_light
    }

    /// Where a track is on the ground, our own pose error taken out, m.
    pub fn world(&self, track: &Track) -> [f64; 2] {
        self.unmoved(track.filter.position())
    }

    /// A place that the sensor shows, our own pose error taken out, m.
    pub fn unmoved(&self, seen: Vector2<f64>) -> [f64; 2] {
        (self.view.undisplaced(seen, self.bias.error()) - self.pose.displacement().at(seen)).into()
    }

    /// Standard deviation of where a track is, what is systematic included, m.
    pub fn position_error_m(&self, track: &Track) -> f64 {
        let here = track.filter.position();
        largest_eigenvalue(&(track.filter.position_cov() + self.systematic_cov(here))).sqrt()
    }

    /// σ of a spot on the ground, m.
    pub fn spot_m(&self) -> f64 {
        spot_m(&self.view)
    }

    /// Distance within which two beams disturb each other, m.
    pub fn overlap_m(&self) -> f64 {
        OVERLAP * self.spot_m()
    }

    /// How far from its own place the beam of `track` may be taken for, m.
    pub fn confusion_m(&self, track: &Track) -> f64 {
        ambiguity::confusion_m(track, &self.tracker, &self.association, self.overlap_m())
    }

    /// Whether another user than that of claim `i` claims to be at `p`.
    pub fn is_anothers_place(&self, i: usize, p: Vector2<f64>) -> bool {
        let is_there = |c: &ActiveClaim| (p - c.position).norm() <= c.reach_m(self.tolerated_distance_m(c.position));
        let others = self.claims.iter().enumerate().filter(|(j, _)| *j != i);
        others
            .filter(|(_, c)| self.crowding.is_evidence(c))
            .any(|(_, c)| is_there(c))
    }
}
