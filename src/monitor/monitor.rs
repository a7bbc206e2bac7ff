//! The stages of a frame, in order. Nothing is decided here: rules read a frame and return findings, and the life cycle alone
//! raises and clears alerts.

use jiff::Timestamp;
use nalgebra::Vector2;

use super::alert::{Acknowledgement, Alert, AlertEvent, AlertKind, Withdrawal};
use super::alert_lifecycle::AlertLifecycle;
use super::ambiguity::mark_unresolvable;
use super::config::{Config, Source};
use super::finding::{Cause, Finding};
use super::frame_context::{FrameContext, Overload};
use super::input::claim_state::{ActiveClaim, Scope, active_claims, has_claim};
use super::input::claim_timing::ClaimTiming;
use super::input::clock_offset::ClockOffset;
use super::input::crowding::Crowding;
use super::input::sensor_health::SensorHealth;
use super::pose::consensus::PoseConsensus;
use super::pose::witness::witnesses;
use super::report::{Observation, Report};
use super::rules::{co_located, inputs, mismatch, pose, unclaimed, unseen};
use super::stats::error_budget::ErrorBudget;
use super::summary;
use super::track::association::{Association, Limits, UserTracks, associate};
use super::track::detection::Detection;
use super::track::eligibility::Eligibility;
use super::track::tracker::{Track, Tracker};
use crate::claims::{Beam, Store, seconds};
use crate::estimate::Estimate;
use crate::optics::Camera;

/// How far back a time may lie before the clock counts as set back, s: frames and failures are stamped apart.
const SET_BACK_S: f64 = 2.0;
/// Largest score of a track in thresholds: beyond it more hits do not outweigh later misses. Not measured.
const MAX_SCORE: f64 = 1.5;
/// Time since a user was last seen, beside any blindness, within which they count as visible, s.
const VISIBLE_S: f64 = 2.0;
/// Claim period assumed until claims show one, s.
const ASSUMED_PERIOD_S: f64 = 1.0;

/// The monitor: frames' estimates and claims in, positions and alert events out.
pub struct Monitor {
    state: State,
    memory: Memory,
    alerts: AlertLifecycle,
    /// Index of the newest frame.
    frame: u64,
}

/// What all rules read: the settings, and what frames and claims have shown.
struct State {
    config: Config,
    camera: Camera,
    budget: ErrorBudget,
    /// Standard deviation of claims that state none, m.
    default_sigma_m: f64,
    time: Option<Timestamp>,
    sensor: SensorHealth,
    timing: ClaimTiming,
    tracker: Tracker,
    pose: PoseConsensus,
    users: UserTracks,
}

/// What each rule, and the estimate of the log's clock, keeps for itself.
#[derive(Default)]
struct Memory {
    clock: ClockOffset,
    unclaimed: unclaimed::Memory,
    mismatch: mismatch::Memory,
    unseen: unseen::Memory,
    co_located: co_located::Memory,
}

/// A frame's claims and their tracks.
struct Associated {
    now: Timestamp,
    claims: Vec<ActiveClaim>,
    association: Association,
    claims_quiet_s: Option<(f64, f64)>,
    overload: Overload,
    crowding: Crowding,
    clock_offset_s: f64,
}

impl Monitor {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        let budget = ErrorBudget::new(config, source.rate_hz);
        Self {
            state: State {
                config: config.clone(),
                camera: camera.clone(),
                budget,
                default_sigma_m: claims.default_sigma_m,
                time: None,
                sensor: SensorHealth::default(),
                timing: ClaimTiming::default(),
                tracker: Tracker::new(MAX_SCORE * unclaimed::threshold(&budget)),
                pose: PoseConsensus::default(),
                users: UserTracks::default(),
            },
            memory: Memory::default(),
            alerts: AlertLifecycle::new(source.kind, source.file, config.cool_down_s),
            frame: 0,
        }
    }

    /// Goes on with other settings; tracks, alerts and what has been learned stay.
    pub fn reconfigure(&mut self, config: &Config, claims: &crate::claims::Config) {
        let state = &mut self.state;
        state.budget = state.budget.reconfigured(config);
        state.config = config.clone();
        state.default_sigma_m = claims.default_sigma_m;
        state
            .tracker
            .set_max_score(MAX_SCORE * unclaimed::threshold(&state.budget));
        self.alerts.set_cool_down(config.cool_down_s);
    }

    /// Names the recording that holds the frames from now on, for the alerts that they raise.
    pub fn recorded_in(&mut self, file: Option<&std::path::Path>) {
        self.alerts.recorded_in(file);
    }

    /// Takes one frame. Claims due by its time stand first.
    pub fn step(&mut self, seen: Observation, store: &mut Store) -> Report {
        let now = seen.time;
        self.begin(now, store);
        let dt = self.state.time.map_or(0.0, |t| seconds(t, now)).max(0.0);
        self.state.saw_time(now);
        self.frame = seen.frame;
        let mut at = self.claims(now, store);
        let elsewhere = at.overload.left_out as f64 + store.dropped_lately(now) as f64;
        at.crowding = Crowding::of_claims(&at.claims, elsewhere, &self.state.camera);
        let visible_users = self.state.visible_users(&at);
        self.learn_inputs(&mut at);
        if let Some(estimate) = self.state.sensor.usable_estimate(&seen, visible_users) {
            self.state.timing.saw_frame(now);
            self.track(estimate, &mut at, store, dt);
            self.remember(&at);
            self.associate_displaced(&mut at);
            self.evaluate_beams(&at);
            at.note_answered(store);
        }
        self.evaluate_inputs(&at);
        self.report(&at)
    }

    /// A frame that the source itself could not deliver whole.
    pub fn unusable(&mut self, frame: u64, time: Timestamp, reason: &str, store: &mut Store) -> Report {
        self.begin(time, store);
        self.state.saw_time(time);
        self.frame = frame;
        self.state.sensor.unusable(time, reason);
        let at = self.claims(time, store);
        self.evaluate_inputs(&at);
        self.report(&at)
    }

    /// Time passes without a frame.
    pub fn tick(&mut self, now: Timestamp, store: &mut Store) -> Vec<AlertEvent> {
        self.restart_if_set_back(now, store);
        if self.state.time.is_some_and(|t| now <= t) {
            return Vec::new();
        }
        self.begin(now, store);
        self.state.sensor.no_frame(now);
        let at = self.claims(now, store);
        self.evaluate_inputs(&at);
        self.alerts.take_events()
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
            self.memory.mismatch.restore(&alert);
            self.memory.co_located.restore(&alert);
            self.alerts.restore(alert, || self.state.tracker.reserve());
        }
    }

    /// Lets claims that are due by `now` stand.
    fn begin(&mut self, now: Timestamp, store: &mut Store) {
        self.restart_if_set_back(now, store);
        store.advance(now);
        self.state.timing.begin(now);
    }

    /// After the clock was set back, what is anchored in times that have not come yet would keep everything waiting for them: all
    /// is learned anew, and the alerts that are open go on as over a restart.
    fn restart_if_set_back(&mut self, now: Timestamp, store: &mut Store) {
        if !self.state.time.is_some_and(|t| seconds(now, t) > SET_BACK_S) {
            return;
        }
        store.set_back(now);
        self.state.forget();
        self.memory = Memory::default();
        let open = self.alerts.start_again();
        self.restore(open);
    }

    /// The claims that bear on a frame at `now`, not associated with any track yet.
    fn claims(&self, now: Timestamp, store: &mut Store) -> Associated {
        let clock_offset_s = self.memory.clock.offset_s();
        let scope = Scope {
            config: &self.state.config,
            camera: &self.state.camera,
            default_sigma_m: self.state.default_sigma_m,
            clock_offset_s,
        };
        let State { tracker, users, .. } = &self.state;
        let beam = |track: &Track| Beam {
            position: track.filter.position().into(),
            is_answered: !self.memory.unclaimed.is_unclaimed(track.id),
        };
        let beams: Vec<Beam> = tracker.tracks.iter().map(beam).collect();
        let user = |user: &str| users.get(user).copied();
        let claims = active_claims(store, now, scope, &beams, user, |track| tracker.get(track).is_some());
        Associated {
            now,
            overload: Overload {
                squeezed: store.squeezed(now),
                left_out: store.left_out(),
                users: store.len(),
                max_users: store.max_users(),
            },
            crowding: Crowding::default(),
            association: Association::none(claims.len()),
            claims,
            claims_quiet_s: store.quiet_s(now),
            clock_offset_s,
        }
    }

    /// Learns the log's rhythm and clock.
    fn learn_inputs(&mut self, at: &mut Associated) {
        let State { config, timing, .. } = &mut self.state;
        timing.update(&at.claims, &at.crowding, at.claims_quiet_s.is_some(), at.now);
        self.alerts.catch_up(timing.has_caught_up(at.now, config.decision_s));
        if self.memory.clock.follow(config.tolerated_clock_offset_s) {
            self.memory.mismatch.forget_residuals();
        }
        at.clock_offset_s = self.memory.clock.offset_s();
    }

    /// Detections to tracks, our pose, and which track is associated with which claim.
    fn track(&mut self, estimate: &Estimate, at: &mut Associated, store: &Store, dt: f64) {
        let State {
            config,
            camera,
            time,
            timing,
            tracker,
            pose,
            ..
        } = &mut self.state;
        tracker.step(at.now, &Detection::of(estimate, camera), dt);
        let hit = tracker.tracks.iter().filter(|t| t.hit);
        let beams: Vec<Vector2<f64>> = hit.map(|t| t.filter.position()).collect();
        let witnesses = witnesses(&at.claims, tracker);
        let period_s = timing.period_s();
        pose.update(&beams, &witnesses, dt, period_s.unwrap_or(ASSUMED_PERIOD_S));
        let displacement = pose.displacement();
        for claim in &mut at.claims {
            claim.position += displacement.at(claim.position);
        }
        let limits = Limits {
            tolerated_m: config.tolerated_distance_m,
            claims_stale_s: config.claims_stale_s,
            period_s,
            is_log_stale: self.alerts.is_open(&Cause::System(AlertKind::ClaimsStale)),
        };
        let eligibility = Eligibility {
            now: *time,
            crowding: at.crowding,
            alerts: &self.alerts,
            store,
            decision_s: config.decision_s,
            tolerated_m: config.tolerated_distance_m,
        };
        at.association = associate(&at.claims, tracker, &limits, &eligibility);
        mark_unresolvable(&mut at.claims, &at.association, tracker, camera, |user| {
            self.memory.co_located.usual_energy_j(user)
        });
    }

    /// Adds the frame's evidence to what is remembered of each user and track, and forgets users who no longer matter: those
    /// without a claim and without an open alert.
    fn remember(&mut self, at: &Associated) {
        let Self {
            state, memory, alerts, ..
        } = self;
        state.users.update(&at.claims, &at.association, at.now);
        let frame = state.context(at, alerts);
        memory.clock.update(&frame, |user| memory.mismatch.is_mismatched(user));
        memory.mismatch.update(&frame);
        memory.unclaimed.update(&state.tracker, &at.association, at.now);
        let matters = |user: &str| has_claim(&at.claims, user) || alerts.concerns(user);
        state.users.retain(matters);
        memory.clock.retain(matters);
        memory.mismatch.retain(matters);
        memory.co_located.retain(matters);
    }

    /// A beam that is about to be alerted is associated with the user whose beam vanished as it came, if there is one.
    fn associate_displaced(&mut self, at: &mut Associated) {
        let Self {
            state, memory, alerts, ..
        } = self;
        for (track, since) in memory.unclaimed.due(&state.context(at, alerts)) {
            let is_alerted = |user: &str| alerts.is_open(&Cause::User(AlertKind::UserUnseen, user.to_owned()));
            let displaced = state.users.displaced(since, &at.claims, &at.association, is_alerted);
            if let Some(i) = displaced {
                let user = &at.claims[i].claim.user;
                at.association.assign(i, track);
                state.users.relocate(user, track);
                memory.mismatch.displace(user);
                memory.unclaimed.remove(track);
            }
        }
    }

    /// The rules over beams and users. Findings about beams are applied before the rules over users run: whether a beam is decided
    /// matters for a user who went as it came.
    fn evaluate_beams(&mut self, at: &Associated) {
        let Self {
            state, memory, alerts, ..
        } = self;
        let findings = unclaimed::evaluate(&state.context(at, alerts), &mut memory.unclaimed);
        alerts.apply(findings, at.now, self.frame);
        let undecided = memory.unclaimed.undecided(alerts);
        let frame = state.context(at, alerts);
        let mut findings = mismatch::evaluate(&frame, &mut memory.mismatch);
        findings.extend(unseen::evaluate(&frame, &mut memory.unseen, &undecided));
        alerts.apply(by_user(findings), at.now, self.frame);
        alerts.absent_without_claim(|user| has_claim(&at.claims, user), at.now);
        let findings = co_located::evaluate(&state.context(at, alerts), &mut memory.co_located);
        alerts.apply(findings, at.now, self.frame);
    }

    /// The rules over what the monitor is given.
    fn evaluate_inputs(&mut self, at: &Associated) {
        let frame = self.state.context(at, &self.alerts);
        let findings = [
            inputs::sensor_lost(&frame),
            pose::evaluate(&frame),
            inputs::claims_flooded(&frame),
            inputs::claims_stale(&frame),
        ]
        .concat();
        self.alerts.apply(findings, at.now, self.frame);
    }

    fn report(&mut self, at: &Associated) -> Report {
        let events = self.alerts.take_events();
        let frame = self.state.context(at, &self.alerts);
        summary::report(&frame, self.frame, self.memory.unseen.never_seen(), events)
    }
}

impl State {
    fn context<'a>(&'a self, at: &'a Associated, alerts: &'a AlertLifecycle) -> FrameContext<'a> {
        FrameContext {
            now: at.now,
            config: &self.config,
            camera: &self.camera,
            budget: &self.budget,
            sensor: &self.sensor,
            timing: &self.timing,
            clock_offset_s: at.clock_offset_s,
            claims_quiet_s: at.claims_quiet_s,
            overload: at.overload,
            crowding: at.crowding,
            claims: &at.claims,
            tracker: &self.tracker,
            association: &at.association,
            users: &self.users,
            pose: &self.pose,
            alerts,
        }
    }

    /// The newest time so far.
    fn saw_time(&mut self, now: Timestamp) {
        self.time = Some(self.time.map_or(now, |t| t.max(now)));
    }

    /// Active users whose beam was seen a moment ago, or just before the sensor went blind.
    fn visible_users(&self, at: &Associated) -> usize {
        let within_s = VISIBLE_S + self.sensor.blind_s(at.now);
        let active = at.claims.iter().filter(|a| !a.ended);
        active
            .filter_map(|a| a.before.last_seen)
            .filter(|t| seconds(*t, at.now) < within_s)
            .count()
    }

    /// Forgets all but the settings.
    fn forget(&mut self) {
        self.tracker.forget();
        self.time = None;
        self.sensor = SensorHealth::default();
        self.timing = ClaimTiming::default();
        self.pose = PoseConsensus::default();
        self.users = UserTracks::default();
    }
}

impl Associated {
    /// Lets the store know whom it must not forget for others. Among many names one frame's association is no acquaintance.
    fn note_answered(&self, store: &mut Store) {
        for (i, claim) in self.claims.iter().enumerate() {
            if self.association.track_id(i).is_some() && self.crowding.is_evidence(claim) {
                store.answered(&claim.claim.user, self.now);
            }
        }
    }
}

/// Findings about one user next to each other, those about none last.
fn by_user(mut findings: Vec<Finding>) -> Vec<Finding> {
    fn key(finding: &Finding) -> (bool, Option<&str>) {
        let user = finding.cause().user();
        (user.is_none(), user)
    }
    findings.sort_by(|a, b| key(a).cmp(&key(b)));
    findings
}
