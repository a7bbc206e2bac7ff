//! The monitor: one frame after another through the steps that lead to verdicts, one file a step.

use std::collections::BTreeMap;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::claims::{Beam, ClaimState, Standing, Store, seconds};
use crate::monitor::alert::{Acknowledgement, Alert, AlertEvent, AlertKind, Withdrawal};
use crate::monitor::alert_lifecycle::{AlertLifecycle, Cause, Finding};
use crate::monitor::config::{Config, Source};
use crate::monitor::input::claim_state::{ActiveClaim, CLAIM_LIFE_S, Reach, User};
use crate::monitor::input::crowding::Crowding;
use crate::monitor::input::sensor_health::SensorHealth;
use crate::monitor::pose::consensus::PoseConsensus;
use crate::monitor::report::{Observation, Report};
use crate::monitor::stats::co_location::CoLocationTest;
use crate::monitor::stats::error_budget::{ErrorBudget, TestFamily};
use crate::monitor::track::detection::Detection;
use crate::monitor::track::tracker::{Track, Tracker};
use crate::optics::Camera;

/// A clock that shows less than this earlier than before has not been set back: frames and failures are stamped apart.
const SET_BACK_S: f64 = 2.0;
/// Systematic error of the positions that does not average out, m.
pub(super) const SYSTEMATIC_M: f64 = 0.05;
/// A beam and an absence that began within this of each other have one cause, s.
pub(super) const COINCIDENCE_S: f64 = 1.5;
/// Users that have been seen, from which on only such ones tell of our pose.
const KNOWN_WITNESSES: usize = 3;
/// An alert that lasts this long is critical, s.
pub(super) const ESCALATE_S: f64 = 10.0;

/// The monitor: frames' estimates and claims in, positions and alert events out.
pub struct Monitor {
    pub(super) config: Config,
    pub(super) camera: Camera,
    pub(super) budget: ErrorBudget,
    pub(super) default_sigma_m: f64,
    pub(super) tracks: Tracker,
    pub(super) users: BTreeMap<String, User>,
    pub(super) sensor: SensorHealth,
    pub(super) alerts: AlertLifecycle,
    pub(super) pose: PoseConsensus,
    pub(super) first: Option<Timestamp>,
    pub(super) first_claim: Option<Timestamp>,
    pub(super) first_usable: Option<Timestamp>,
    /// Typical seconds between a user's claims, and from a claim's own time to its arrival.
    pub(super) period_s: Option<f64>,
    pub(super) delay_s: f64,
    /// Seconds by which the log's clock is ahead of ours.
    pub(super) ahead_s: f64,
    pub(super) time: Option<Timestamp>,
    pub(super) frame: u64,
    /// Since when each track has had no claim, by track.
    pub(super) unassociated_since: BTreeMap<u64, Timestamp>,
    pub(super) level_unclaimed: f64,
    /// Names without beams in the frame.
    pub(super) crowding: Crowding,
    /// Users of the frame who share the alert of those never seen.
    pub(super) never_seen: Vec<String>,
}

impl Monitor {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        let budget = ErrorBudget::new(config, source.rate_hz);
        let level_unclaimed = budget.level(TestFamily::Unclaimed, 1.0);
        Self {
            camera: camera.clone(),
            default_sigma_m: claims.default_sigma_m,
            tracks: Tracker::new(1.5 * level_unclaimed),
            users: BTreeMap::new(),
            sensor: SensorHealth::default(),
            alerts: AlertLifecycle::new(source.kind, source.file, config.cool_down_s),
            pose: PoseConsensus::default(),
            first: None,
            first_claim: None,
            first_usable: None,
            period_s: None,
            delay_s: 0.0,
            ahead_s: 0.0,
            time: None,
            frame: 0,
            unassociated_since: BTreeMap::new(),
            level_unclaimed,
            crowding: Crowding::default(),
            never_seen: Vec::new(),
            budget,
            config: config.clone(),
        }
    }

    /// Names the recording that holds the frames from now on, for the alerts that they raise.
    pub fn recorded_in(&mut self, file: Option<&std::path::Path>) {
        self.alerts.recorded_in(file);
    }

    /// Takes one frame. Claims due by its time stand first.
    pub fn step(&mut self, seen: Observation, claims: &mut Store) -> Report {
        let now = seen.time;
        self.restart_if_set_back(now, claims);
        claims.advance(now);
        self.frame = seen.frame;
        self.first.get_or_insert(now);
        let dt = self.time.map_or(0.0, |t| seconds(t, now)).max(0.0);
        self.time = Some(self.time.map_or(now, |t| t.max(now)));
        let mut active = self.assert(claims, now);
        let lit = active
            .iter()
            .filter(|a| !a.ended)
            .filter_map(|a| a.last_answered)
            .filter(|t| seconds(*t, now) < 2.0 + self.sensor.blind_s(now))
            .count();
        self.crowding = self.crowding_of(&active, claims, now);
        self.learn_timing(&active, claims, now);
        self.alerts.catch_up(self.has_caught_up(now));
        self.learn_clock();
        if let Some(estimate) = self.sensor.judge(&seen, lit) {
            self.first_usable.get_or_insert(now);
            let detections = Detection::of(estimate, &self.camera);
            self.tracks.step(now, &detections, dt);
            self.find_pose(&mut active, dt);
            let mut association = self.answer(&active, claims);
            self.mark_unresolvable(&mut active, &association);
            self.weigh(&active, &association, now);
            self.note_unassociated(&association, now);
            self.decide_unclaimed(&active, &mut association, now);
            self.decide_users(&active, &association, now);
            self.decide_co_located(&active, &association, now);
            self.note_answered(&active, &association, claims, now);
        }
        self.watch_inputs(&active, claims, now);
        self.report(&active, seen.frame, now)
    }

    /// A frame that the source itself could not deliver whole.
    pub fn unusable(&mut self, frame: u64, time: Timestamp, reason: &str, claims: &mut Store) -> Report {
        self.restart_if_set_back(time, claims);
        claims.advance(time);
        self.frame = frame;
        self.first.get_or_insert(time);
        self.time = Some(self.time.map_or(time, |t| t.max(time)));
        self.sensor.unusable(time, reason);
        let active = self.assert(claims, time);
        self.watch_inputs(&active, claims, time);
        self.report(&active, frame, time)
    }

    /// Time passes without a frame.
    pub fn tick(&mut self, now: Timestamp, claims: &mut Store) -> Vec<AlertEvent> {
        self.restart_if_set_back(now, claims);
        if self.time.is_some_and(|t| now <= t) {
            return Vec::new();
        }
        claims.advance(now);
        self.first.get_or_insert(now);
        self.sensor.nothing(now);
        let active = self.assert(claims, now);
        self.watch_inputs(&active, claims, now);
        self.alerts.take_events()
    }

    /// Where the clock was set back, what is anchored in times that have not come yet would keep everything waiting for them.
    /// The monitor starts again, and the alerts that stand go on as over a restart.
    fn restart_if_set_back(&mut self, now: Timestamp, claims: &mut Store) {
        if !self.time.is_some_and(|t| seconds(now, t) > SET_BACK_S) {
            return;
        }
        claims.set_back(now);
        self.tracks.forget();
        self.users.clear();
        self.sensor = SensorHealth::default();
        self.pose = PoseConsensus::default();
        (self.first, self.first_claim, self.first_usable) = (None, None, None);
        (self.period_s, self.delay_s, self.ahead_s) = (None, 0.0, 0.0);
        self.time = None;
        self.unassociated_since.clear();
        self.never_seen.clear();
        let open = self.alerts.start_again();
        self.restore(open);
    }

    /// An operator has taken note. `None` when no open alert has this id, or it is acknowledged already and the new
    /// acknowledgement has no note.
    pub fn acknowledge(&mut self, id: &str, acknowledgement: Acknowledgement) -> Option<AlertEvent> {
        self.alerts.acknowledge(id, acknowledgement)
    }

    /// An operator has undone an acknowledgement. `None` when no acknowledged alert has this id.
    pub fn unacknowledge(&mut self, id: &str, withdrawal: Withdrawal) -> Option<AlertEvent> {
        self.alerts.unacknowledge(id, withdrawal)
    }

    /// Takes over the alerts that were open when the last run ended: they go on, or clear when their cause is gone.
    pub fn restore(&mut self, open: Vec<Alert>) {
        for alert in open {
            let shared = alert.evidence["shares_the_spot_of"].as_str();
            let cause = match (alert.kind, &alert.user) {
                (AlertKind::UnclaimedEmitter, None) if shared.is_some() => {
                    let name = shared.unwrap_or_default().to_owned();
                    let past = &alert.evidence["energy_over_the_past"];
                    if let (Some(mean), Some(std)) = (past["past_ln_j"].as_f64(), past["past_ln_std"].as_f64()) {
                        self.users.entry(name.clone()).or_default().co_location =
                            CoLocationTest::remembering(mean, std);
                    }
                    Cause::Spot(name)
                }
                (kind, Some(user)) => {
                    if kind == AlertKind::PositionMismatch {
                        let displaced = alert.evidence["answered_from_elsewhere"].as_bool().unwrap_or(false);
                        let known = self.users.entry(user.clone()).or_default();
                        (known.mismatched, known.displaced) = (true, displaced);
                    }
                    Cause::User(kind, user.clone())
                }
                (AlertKind::UnclaimedEmitter, None) => Cause::Track(alert.kind, self.tracks.reserve()),
                (kind, None) => Cause::Whole(kind),
            };
            self.alerts.restore(cause, alert);
        }
    }

    /// The claims that bear on a frame at `now`, by name.
    fn assert(&self, claims: &mut Store, now: Timestamp) -> Vec<ActiveClaim> {
        let tolerated = self.config.tolerated_distance_m;
        let reach = |s: &Standing| Reach::of(s, now, self.default_sigma_m, tolerated, self.ahead_s);
        let beams: Vec<Beam> = self.tracks.all.iter().map(|t| self.beam(t)).collect();
        claims.choose(&beams, |s| self.is_in_reach(s, &reach(s)));
        let mut active: Vec<ActiveClaim> = claims
            .chosen()
            .filter_map(|s| {
                let (user, reach) = (self.users.get(&s.claim.user), reach(&s));
                let bears = self.is_held(&s, user) || self.is_in_reach(&s, &reach);
                bears.then(|| ActiveClaim::new(&s, reach, user))
            })
            .collect();
        for a in &mut active {
            a.expected = !a.ended && self.must_be_seen(a);
        }
        for name in self.alerts.open().filter_map(|(cause, _)| cause.names()) {
            if let Ok(i) = active.binary_search_by(|a| a.claim.user.as_str().cmp(name)) {
                active[i].has_alert = true;
            }
        }
        active
    }

    fn beam(&self, track: &Track) -> Beam {
        let p = track.motion.position();
        Beam {
            position: [p.x, p.y],
            is_answered: !self.unassociated_since.contains_key(&track.id),
        }
    }

    /// The beam that answered the user's claim is still followed.
    fn is_held(&self, standing: &Standing, user: Option<&User>) -> bool {
        let tracked = user.and_then(|u| u.track);
        standing.claim.state == ClaimState::Active && tracked.is_some_and(|id| self.tracks.get(id).is_some())
    }

    fn is_in_reach(&self, standing: &Standing, reach: &Reach) -> bool {
        let claim = standing.claim;
        if claim.state == ClaimState::Ended {
            return reach.age_s <= self.config.ended_grace_s;
        }
        let reach_m = self.config.tolerated_distance_m + reach.slack_m + 5.0 * reach.variance.sqrt();
        let place = Vector2::new(claim.x_m, claim.y_m);
        reach.age_s <= CLAIM_LIFE_S && self.is_near_view(place, reach_m + self.spot_m() * 3.0)
    }

    /// Whether even a user as far off as is tolerated would show at least part of a spot.
    fn must_be_seen(&self, a: &ActiveClaim) -> bool {
        let off = self.config.tolerated_distance_m + a.slack_m + 3.0 * a.variance.sqrt();
        self.is_near_view(a.position, (self.spot_m() - off).min(0.0))
    }

    /// Covariance of what all residuals of a user at `p` share: our own pose and what is systematic in the positions.
    pub(super) fn floor(&self, p: Vector2<f64>) -> Matrix2<f64> {
        Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance(p))
    }

    /// Learns our own pose error from the frame and moves the claims by it.
    fn find_pose(&mut self, active: &mut [ActiveClaim], dt: f64) {
        let beams: Vec<Vector2<f64>> = self
            .tracks
            .all
            .iter()
            .filter(|t| t.hit)
            .map(|t| t.motion.position())
            .collect();
        // Claims that no beam ever answered say nothing of our pose, unless there are no others.
        let (known, invented): (Vec<&ActiveClaim>, Vec<&ActiveClaim>) =
            active.iter().filter(|a| a.expected).partition(|a| a.was_seen());
        let heard = if known.len() >= KNOWN_WITNESSES {
            known
        } else {
            [known, invented].concat()
        };
        let moved = |a: &ActiveClaim| {
            let track = self.tracks.get(a.before?)?;
            Some(track.motion.position() - track.at(a.made)?)
        };
        let witnesses: Vec<_> = heard.into_iter().map(|a| a.witness(moved(a))).collect();
        self.pose.update(&beams, &witnesses, dt, self.period_s.unwrap_or(1.0));
        let displacement = self.pose.displacement();
        for a in active {
            a.position += displacement.at(a.position);
        }
    }

    pub(super) fn spot_m(&self) -> f64 {
        self.camera.spot_sigma_m * self.camera.ground_scale()
    }

    fn is_near_view(&self, p: Vector2<f64>, margin_m: f64) -> bool {
        let [x, y] = self.camera.to_sensor([p.x, p.y]);
        let margin = margin_m / self.camera.ground_scale();
        x.abs() <= self.camera.x.half_width() + margin && y.abs() <= self.camera.y.half_width() + margin
    }

    pub(super) fn at_track(&self, mut finding: Finding, track: &Track) -> Finding {
        let (p, c) = (track.motion.position(), track.motion.position_cov());
        finding.x_m = Some(p.x);
        finding.y_m = Some(p.y);
        finding.cov_m2 = Some([[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]]);
        finding
    }
}
