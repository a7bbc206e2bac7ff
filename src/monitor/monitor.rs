//! The stages of a frame, in order. Nothing is decided here: rules read a frame and return findings, and the life cycle alone
//! raises and clears alerts.

use jiff::Timestamp;
use nalgebra::{Vector2, Vector6};

use super::alert::{Acknowledgement, Alert, AlertEvent, AlertKind, Withdrawal};
use super::ambiguity::mark_unresolvable;
use super::beyond_view::leave_out_halos;
use super::config::{Config, Source};
use super::finding::{Cause, Finding};
use super::frame_context::FrameContext;
use super::input::claim_state::{Scope, active_claims, has_claim};
use super::input::clock_offset::ClockOffset;
use super::input::crowding::Crowding;
use super::input::overload::Overload;
use super::pose::witness::witnesses;
use super::report::{Observation, Report};
use super::rules::{co_located, inputs, known_light, mismatch, pose, unclaimed, unseen, zone};
use super::summary;
use super::track::association::{Association, associate};
use super::track::beam_track::Track;
use super::track::detection::Detection;
use super::track::eligibility::Eligibility;
use crate::claims::{Beam, Store};
use crate::estimate::Estimate;
use crate::optics::Camera;
use crate::time::seconds;

/// How far back a time may lie before the clock counts as set back, s: frames and failures are stamped apart. Smaller restarts
/// the monitor for stamps that are out of order, larger lets a clock that was set back stop verdicts for that long.
const SET_BACK_S: f64 = 2.0;
/// Claim period assumed until claims show one, s.
const ASSUMED_PERIOD_S: f64 = 1.0;

/// The monitor: frames' estimates and claims in, positions and alert events out.
pub struct Monitor {
    pub(super) frame: FrameContext,
    pub(super) memory: Memory,
    /// Index of the newest frame.
    index: u64,
}

/// What each rule, and the estimate of the log's clock, keeps for itself.
#[derive(Default)]
pub(super) struct Memory {
    clock: ClockOffset,
    pub(super) unclaimed: unclaimed::Memory,
    mismatch: mismatch::Memory,
    unseen: unseen::Memory,
    pub(super) co_located: co_located::Memory,
    known_light: known_light::Memory,
}

impl Monitor {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        Self {
            frame: FrameContext::new(config, claims, camera, source),
            memory: Memory::default(),
            index: 0,
        }
    }

    /// Goes on with other settings; tracks, alerts and what has been learned stay.
    pub fn reconfigure(&mut self, config: &Config, claims: &crate::claims::Config) {
        self.frame.reconfigure(config, claims);
    }

    /// Names the recording that holds the frames from now on, for the alerts that they raise.
    pub fn recorded_in(&mut self, file: Option<&std::path::Path>) {
        self.frame.alerts.recorded_in(file);
    }

    /// Takes one frame. Claims due by its time stand first.
    pub fn step(&mut self, seen: Observation, store: &mut Store) -> Report {
        let now = seen.time;
        self.begin(now, store);
        let dt = self.frame.time.map_or(0.0, |t| seconds(t, now)).max(0.0);
        self.frame.saw_time(now);
        self.index = seen.frame;
        self.frame.look(seen.look);
        self.frame.lights.expire(now);
        self.take_claims(now, store);
        let elsewhere = self.frame.overload.left_out as f64 + store.dropped_lately(now) as f64;
        self.frame.crowding = Crowding::of_claims(&self.frame.claims, elsewhere, &self.frame.view);
        let visible_users = self.frame.visible_users();
        self.learn_inputs();
        if let Some(estimate) = self.frame.sensor.usable_estimate(&seen, visible_users)
            && self.frame.is_placed
        {
            self.frame.timing.saw_frame(now);
            self.track(estimate, seen.energy_scale, store, dt);
            self.remember();
            self.associate_displaced();
            self.evaluate_beams();
            self.note_answered(store);
        }
        self.evaluate_inputs();
        self.report()
    }

    /// The error of the newest frame's pose that its beams share against their tracks; none where no beams show it.
    pub fn pose_error(&self) -> Option<&Vector6<f64>> {
        self.frame.pose_error.as_ref()
    }

    /// A frame that the source itself could not deliver whole.
    pub fn unusable(&mut self, frame: u64, time: Timestamp, reason: &str, store: &mut Store) -> Report {
        self.begin(time, store);
        self.frame.saw_time(time);
        self.index = frame;
        self.frame.sensor.unusable(time, reason);
        self.take_claims(time, store);
        self.evaluate_inputs();
        self.report()
    }

    /// Time passes without a frame.
    pub fn tick(&mut self, now: Timestamp, store: &mut Store) -> Vec<AlertEvent> {
        self.restart_if_set_back(now, store);
        if self.frame.time.is_some_and(|t| now <= t) {
            return Vec::new();
        }
        self.begin(now, store);
        self.frame.sensor.no_frame(now);
        self.take_claims(now, store);
        self.evaluate_inputs();
        self.frame.alerts.take_events()
    }

    /// An operator has taken note. `None` when no open alert has this id, or it is acknowledged already and the new
    /// acknowledgement has no note.
    pub fn acknowledge(&mut self, id: &str, acknowledgement: Acknowledgement) -> Option<AlertEvent> {
        self.frame.alerts.acknowledge(id, acknowledgement)
    }

    /// An operator has undone an acknowledgement. `None` when no acknowledged alert has this id.
    pub fn unacknowledge(&mut self, id: &str, withdrawal: Withdrawal) -> Option<AlertEvent> {
        self.frame.alerts.unacknowledge(id, withdrawal)
    }

    /// Takes over the alerts that were open when the last run ended: they go on, or clear when their cause is gone.
    pub fn restore(&mut self, open: Vec<Alert>) {
        for alert in open {
            self.memory.mismatch.restore(&alert);
            self.memory.co_located.restore(&alert);
            self.frame.alerts.restore(alert, || self.frame.tracker.reserve());
        }
    }

    /// Lets claims that are due by `now` stand.
    fn begin(&mut self, now: Timestamp, store: &mut Store) {
        self.restart_if_set_back(now, store);
        store.advance(now);
        self.frame.timing.begin(now);
    }

    /// After the clock was set back, what is anchored in times that have not come yet would keep everything waiting for them: all
    /// is learned anew, and the alerts that are open go on as over a restart.
    fn restart_if_set_back(&mut self, now: Timestamp, store: &mut Store) {
        if !self.frame.time.is_some_and(|t| seconds(now, t) > SET_BACK_S) {
            return;
        }
        store.set_back(now);
        self.frame.forget();
        self.memory = Memory::default();
        let open = self.frame.alerts.start_again();
        self.restore(open);
    }

    /// Takes up the claims that bear on a frame at `now`, not associated with any track yet.
    fn take_claims(&mut self, now: Timestamp, store: &mut Store) {
        let frame = &mut self.frame;
        frame.now = now;
        frame.clock_offset_s = self.memory.clock.offset_s();
        let scope = Scope {
            config: &frame.config,
            view: &frame.view,
            default_sigma_m: frame.default_sigma_m,
            clock_offset_s: frame.clock_offset_s,
        };
        let beam = |track: &Track| Beam {
            position: track.filter.position().into(),
            is_answered: !self.memory.unclaimed.is_unclaimed(track.id),
        };
        let beams: Vec<Beam> = frame.tracker.tracks.iter().map(beam).collect();
        let user = |user: &str| frame.users.get(user).copied();
        let is_followed = |track| frame.tracker.get(track).is_some();
        frame.claims = active_claims(store, now, scope, &beams, user, is_followed);
        frame.association = Association::none(frame.claims.len());
        frame.claims_quiet_s = store.quiet_s(now);
        frame.crowding = Crowding::default();
        frame.overload = Overload {
            squeezed: store.squeezed(now),
            left_out: store.left_out(),
            users: store.len(),
            max_users: store.max_users(),
        };
    }

    /// Learns the log's rhythm and clock.
    fn learn_inputs(&mut self) {
        let Self { frame, memory, .. } = self;
        let has_claims = frame.claims_quiet_s.is_some();
        frame
            .timing
            .update(&frame.claims, &frame.crowding, has_claims, frame.now);
        let has_caught_up = frame.timing.has_caught_up(frame.now, frame.config.decision_s);
        frame.alerts.catch_up(has_caught_up);
        if memory.clock.follow(frame.config.tolerated_clock_offset_s) {
            memory.mismatch.forget_residuals();
        }
        frame.clock_offset_s = memory.clock.offset_s();
    }

    /// Detections to tracks, our pose, and which track is associated with which claim.
    fn track(&mut self, estimate: &Estimate, energy_scale: f64, store: &Store, dt: f64) {
        let frame = &mut self.frame;
        let usual_energy_j = |user: &str| self.memory.co_located.usual_energy_j(user);
        let mut detections = Detection::of(estimate, energy_scale, &frame.view);
        leave_out_halos(&mut detections, &frame.claims, &frame.view, usual_energy_j);
        let elapsed = frame.tracker.predict(frame.now);
        frame.register(&mut detections, elapsed);
        frame.tracker.take(frame.now, &detections, dt);
        frame.light.update(&frame.tracker, &frame.view);
        let hit = frame.tracker.tracks.iter().filter(|t| t.hit);
        // Known lights answer no claim; three reflections beside three users would pass for a displaced camera.
        let beams = hit.map(|t| t.filter.position()).filter(|p| !frame.lights.has_at(*p));
        let beams: Vec<Vector2<f64>> = beams.collect();
        let period_s = frame.timing.period_s().unwrap_or(ASSUMED_PERIOD_S);
        frame.update_bias(elapsed, period_s);
        let mut witnesses = witnesses(&frame.claims, &frame.tracker);
        for witness in &mut witnesses {
            witness.claimed += frame.bias_at(witness.claimed);
        }
        frame.pose.update(&beams, &witnesses, elapsed, period_s);
        let displacements: Vec<_> = (frame.claims.iter().map(|c| frame.displacement_at(c.position))).collect();
        for (claim, displacement) in frame.claims.iter_mut().zip(displacements) {
            claim.position += displacement;
        }
        mark_unresolvable(
            &mut frame.claims,
            &frame.tracker,
            &frame.view,
            estimate.spot_error,
            usual_energy_j,
        );
        let of_lights = frame.lights.tracks();
        let eligibility = Eligibility {
            now: frame.time,
            config: &frame.config,
            timing: &frame.timing,
            crowding: frame.crowding,
            alerts: &frame.alerts,
            of_lights: &of_lights,
            store,
        };
        frame.association = associate(&frame.claims, &frame.tracker, &eligibility);
        frame.associate_lights();
    }

    /// Adds the frame's evidence to what is remembered of each user and track, and forgets users who no longer matter: those
    /// without a claim and without an open alert.
    fn remember(&mut self) {
        let Self { frame, memory, .. } = self;
        frame.users.update(&frame.claims, &frame.association, frame.now);
        memory.clock.update(frame, |user| memory.mismatch.is_mismatched(user));
        memory.mismatch.update(frame);
        memory.unclaimed.update(frame);
        let matters = |user: &str| has_claim(&frame.claims, user) || frame.alerts.concerns(user);
        frame.users.retain(matters);
        memory.clock.retain(matters);
        memory.mismatch.retain(matters);
        memory.co_located.retain(matters);
        memory.co_located.retain_lights(|id| frame.lights.get(id).is_some());
    }

    /// A beam that is about to be alerted is associated with the user whose beam vanished as it came, if there is one.
    fn associate_displaced(&mut self) {
        let Self { frame, memory, .. } = self;
        for (track, since) in memory.unclaimed.due(frame) {
            let is_alerted = |user: &str| {
                let cause = Cause::User(AlertKind::UserUnseen, user.to_owned());
                frame.alerts.is_open(&cause)
            };
            let displaced = frame
                .users
                .displaced([since, frame.now], &frame.claims, &frame.association, is_alerted);
            if let Some(i) = displaced {
                let user = &frame.claims[i].claim.user;
                frame.association.assign(i, track);
                frame.users.entry(user).found(track);
                memory.mismatch.displace(user);
                memory.unclaimed.remove(track);
            } else if frame.displace_light(track, since) {
                memory.unclaimed.remove(track);
            }
        }
    }

    /// The rules over beams and users. Findings about beams are applied before the rules over users run: whether a beam is decided
    /// matters for a user who went as it came.
    fn evaluate_beams(&mut self) {
        self.apply(|frame, memory| unclaimed::evaluate(frame, &mut memory.unclaimed));
        self.apply(|frame, memory| {
            let undecided = memory.unclaimed.undecided(&frame.alerts);
            let mut findings = mismatch::evaluate(frame, &mut memory.mismatch);
            findings.extend(unseen::evaluate(frame, &mut memory.unseen, &undecided));
            findings.extend(zone::evaluate(frame));
            by_user(findings)
        });
        let frame = &mut self.frame;
        let has_claim = |user: &str| has_claim(&frame.claims, user);
        frame.alerts.absent_without_claim(has_claim, frame.now);
        self.apply(|frame, memory| co_located::evaluate(frame, &mut memory.co_located));
        self.apply(|frame, memory| known_light::evaluate(frame, &mut memory.co_located, &mut memory.known_light));
        known_light::learn(&mut self.frame, &self.memory.known_light);
    }

    /// The rules over what the monitor is given.
    fn evaluate_inputs(&mut self) {
        self.apply(|frame, _| {
            [
                inputs::sensor_lost(frame),
                pose::evaluate(frame),
                pose::lost(frame),
                inputs::claims_flooded(frame),
                inputs::claims_stale(frame),
            ]
            .concat()
        });
    }

    fn apply(&mut self, rules: impl FnOnce(&FrameContext, &mut Memory) -> Vec<Finding>) {
        let mut findings = rules(&self.frame, &mut self.memory);
        for finding in &mut findings {
            if let Finding::Present(_, content) = finding {
                self.frame.mark(content);
            }
        }
        self.frame.alerts.apply(findings, self.frame.now, self.index);
    }

    /// Lets the store know whom it must not forget for others. Among many names one frame's association is no acquaintance.
    fn note_answered(&self, store: &mut Store) {
        let frame = &self.frame;
        for (i, claim) in frame.claims.iter().enumerate() {
            if frame.association.track_id(i).is_some() && frame.crowding.is_evidence(claim) {
                store.answered(&claim.claim.user, frame.now);
            }
        }
    }

    fn report(&mut self) -> Report {
        let events = self.frame.alerts.take_events();
        summary::report(&self.frame, self.index, self.memory.unseen.never_seen(), events)
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
