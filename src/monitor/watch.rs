use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};
use serde_json::{Value, json};

use super::book::{Book, Cause, Finding};
use super::motion::mahalanobis2;
use super::pose::Pose;
use super::residuals::surprise;
use super::sight::Sight;
use super::thresholds::Thresholds;
use super::tracks::{Detection, Track, Tracks};
use super::users::{Asserted, CLAIM_LIFE_S, User};
use super::{
    Alert, AlertEvent, AlertKind, Config, Observation, PositionStatus, Report, Severity, Source, TrackedPosition,
};
use crate::assign::assign;
use crate::claims::{Store, seconds};
use crate::estimate::Flags;
use crate::optics::Camera;

/// Squared Mahalanobis distance within which a beam can answer a claim.
const ANSWER_GATE: f64 = 25.0;
/// What an assignment must gain before a claim is answered by another beam than before.
const INCUMBENCY: f64 = 4.0;
/// Frames in a row that must show a beam outside before a single claim's evidence stands.
const OUTSIDE_FRAMES: u32 = 3;
/// A beam and an absence that began within this of each other have one cause, s.
const COINCIDENCE_S: f64 = 1.5;
/// ln likelihood ratio from which a user counts as vanished: three frames in a row.
const VANISHED: f64 = 6.9;
/// Share of the time to decide that a beam waits for its claim; the rest is for frames that miss it.
const PATIENCE: f64 = 0.85;
/// At the start of a run every user's claim has come after this many claim periods.
const FIRST_CLAIMS: f64 = 1.3;
/// Without a second claim of anyone by then there is none to wait for, s.
const NO_CLAIMS_S: f64 = 12.0;
/// Claims that take longer to come in than this are not waited for, s.
const LONGEST_DELAY_S: f64 = 3.0;
/// Systematic error of the positions that does not average out, m.
const SYSTEMATIC_M: f64 = 0.05;
/// An alert that lasts this long is critical, s.
const ESCALATE_S: f64 = 10.0;

/// The monitor: frames' estimates and claims in, positions and alert events out.
pub struct Monitor {
    config: Config,
    camera: Camera,
    thresholds: Thresholds,
    default_sigma_m: f64,
    tracks: Tracks,
    users: BTreeMap<String, User>,
    sight: Sight,
    book: Book,
    pose: Pose,
    first: Option<Timestamp>,
    first_claim: Option<Timestamp>,
    /// Typical seconds between a user's claims, and from a claim's own time to its arrival.
    period_s: Option<f64>,
    delay_s: f64,
    time: Option<Timestamp>,
    frame: u64,
    /// Since when each track has had no claim, by track.
    alone: BTreeMap<u64, Timestamp>,
    level_unclaimed: f64,
}

impl Monitor {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        let thresholds = Thresholds::new(config, source.rate_hz);
        let level_unclaimed = thresholds.level(1.0);
        Self {
            camera: camera.clone(),
            default_sigma_m: claims.default_sigma_m,
            tracks: Tracks::new(1.5 * level_unclaimed),
            users: BTreeMap::new(),
            sight: Sight::default(),
            book: Book::new(source.kind, source.file, config.cool_down_s),
            pose: Pose::default(),
            first: None,
            first_claim: None,
            period_s: None,
            delay_s: 0.0,
            time: None,
            frame: 0,
            alone: BTreeMap::new(),
            level_unclaimed,
            thresholds,
            config: config.clone(),
        }
    }

    /// Names the recording that holds the frames from now on, for the alerts that they raise.
    pub fn recorded_in(&mut self, file: Option<&std::path::Path>) {
        self.book.recorded_in(file);
    }

    /// Takes one frame. Claims due by its time stand first.
    pub fn step(&mut self, seen: Observation, claims: &mut Store) -> Report {
        let now = seen.time;
        claims.advance(now);
        self.frame = seen.frame;
        self.first.get_or_insert(now);
        let dt = self.time.map_or(0.0, |t| seconds(t, now)).max(0.0);
        self.time = Some(self.time.map_or(now, |t| t.max(now)));
        let mut asserted = self.assert(claims, now);
        let lit = asserted
            .iter()
            .filter(|a| !a.ended)
            .filter_map(|a| self.users.get(&a.claim.user)?.last_answered)
            .filter(|t| seconds(*t, now) < 2.0 + self.sight.blind_s(now))
            .count();
        self.learn_habits(&asserted, claims, now);
        if let Some(estimate) = self.sight.judge(&seen, lit) {
            let detections = Detection::of(estimate, &self.camera);
            self.tracks.step(now, &detections, dt);
            self.find_pose(&mut asserted, dt);
            let answers = self.answer(&asserted);
            self.weigh(&asserted, &answers, now);
            self.decide(&asserted, answers, now);
        }
        self.watch_inputs(&asserted, claims, now);
        self.report(&asserted, seen.frame, now)
    }

    /// A frame that the source itself could not deliver whole.
    pub fn unusable(&mut self, frame: u64, time: Timestamp, reason: &str, claims: &mut Store) -> Report {
        claims.advance(time);
        self.frame = frame;
        self.first.get_or_insert(time);
        self.time = Some(self.time.map_or(time, |t| t.max(time)));
        self.sight.unusable(time, reason);
        let asserted = self.assert(claims, time);
        self.watch_inputs(&asserted, claims, time);
        self.report(&asserted, frame, time)
    }

    /// Time passes without a frame.
    pub fn tick(&mut self, now: Timestamp, claims: &mut Store) -> Vec<AlertEvent> {
        if self.time.is_some_and(|t| now <= t) {
            return Vec::new();
        }
        claims.advance(now);
        self.first.get_or_insert(now);
        self.sight.nothing(now);
        let asserted = self.assert(claims, now);
        self.watch_inputs(&asserted, claims, now);
        self.book.take_events()
    }

    /// An operator has taken note. `None` when no open alert has this id, or it is acknowledged already.
    pub fn acknowledge(&mut self, id: &str, _at: Timestamp) -> Option<AlertEvent> {
        self.book.acknowledge(id)
    }

    /// Takes over the alerts that were open when the last run ended: they go on, or clear when their cause is gone.
    pub fn restore(&mut self, open: Vec<Alert>) {
        for alert in open {
            let cause = match (alert.kind, &alert.user) {
                (kind, Some(user)) => Cause::User(kind, user.clone()),
                (AlertKind::UnclaimedEmitter, None) => Cause::Track(alert.kind, self.tracks.reserve()),
                (kind, None) => Cause::Whole(kind),
            };
            self.book.restore(cause, alert);
        }
    }

    /// The claims that bear on a frame at `now`.
    fn assert(&self, claims: &Store, now: Timestamp) -> Vec<Asserted> {
        let tolerated = self.config.tolerated_distance_m;
        claims
            .standing()
            .map(|s| Asserted::new(&s, now, self.default_sigma_m, tolerated))
            .filter(|a| self.bears(a))
            .map(|mut a| {
                a.expected = !a.ended && self.must_be_seen(&a);
                a
            })
            .collect()
    }

    fn bears(&self, a: &Asserted) -> bool {
        let tracked = self.users.get(&a.claim.user).and_then(|u| u.track);
        let held = tracked.is_some_and(|id| self.tracks.get(id).is_some());
        if a.ended {
            return a.age_s <= self.config.ended_grace_s;
        }
        let reach = self.config.tolerated_distance_m + a.slack_m + 5.0 * a.variance.sqrt();
        held || (a.age_s <= CLAIM_LIFE_S && self.is_near_view(a.position, reach + self.spot_m() * 3.0))
    }

    /// Whether even a user as far off as is tolerated would show at least part of a spot.
    fn must_be_seen(&self, a: &Asserted) -> bool {
        let off = self.config.tolerated_distance_m + a.slack_m + 3.0 * a.variance.sqrt();
        self.is_near_view(a.position, (self.spot_m() - off).min(0.0))
    }

    /// Covariance of what all of a user's residuals share: our own pose and what is systematic in the positions.
    fn floor(&self) -> Matrix2<f64> {
        Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance())
    }

    /// Learns our own pose error from the frame and moves the claims by it.
    fn find_pose(&mut self, asserted: &mut [Asserted], dt: f64) {
        let beams: Vec<Vector2<f64>> = self
            .tracks
            .all
            .iter()
            .filter(|t| t.hit)
            .map(|t| t.motion.position())
            .collect();
        let witnesses: Vec<_> = asserted.iter().filter(|a| a.expected).map(Asserted::witness).collect();
        self.pose.update(&beams, &witnesses, dt, self.period_s.unwrap_or(1.0));
        for a in asserted {
            a.position += self.pose.shift();
        }
    }

    fn spot_m(&self) -> f64 {
        self.camera.spot_sigma_m * self.camera.ground_scale()
    }

    fn is_near_view(&self, p: Vector2<f64>, margin_m: f64) -> bool {
        let [x, y] = self.camera.to_sensor([p.x, p.y]);
        let margin = margin_m / self.camera.ground_scale();
        x.abs() <= self.camera.x.half_width() + margin && y.abs() <= self.camera.y.half_width() + margin
    }

    /// Which track answers which claim: near pairs by optimal assignment, then the beam that answered before.
    fn answer(&self, asserted: &[Asserted]) -> Vec<Option<u64>> {
        let seen: Vec<&Track> = self.tracks.all.iter().filter(|t| t.hit).collect();
        let merged: Vec<&Track> = self.tracks.all.iter().filter(|t| t.merged).collect();
        let mut answers = vec![None; asserted.len()];
        // A frame that misses a user's beam must not let another beam nearby pass for it.
        let held: Vec<bool> = asserted
            .iter()
            .map(|a| {
                let before = self.users.get(&a.claim.user).and_then(|u| u.track);
                before
                    .and_then(|id| self.tracks.get(id))
                    .is_some_and(Track::is_just_missed)
            })
            .collect();
        for tracks in [&seen, &merged] {
            let open: Vec<usize> = (0..asserted.len())
                .filter(|&i| answers[i].is_none() && !held[i])
                .collect();
            let matching = assign(open.len(), tracks.len(), ANSWER_GATE + INCUMBENCY, |i, j| {
                let (a, t) = (&asserted[open[i]], tracks[j]);
                let r = t.motion.position() - a.position;
                let d2 = mahalanobis2(r, t.motion.position_cov() + a.spread(self.config.tolerated_distance_m));
                let incumbent = self.users.get(&a.claim.user).and_then(|u| u.track) == Some(t.id);
                if d2 > ANSWER_GATE {
                    f64::INFINITY
                } else if incumbent {
                    d2
                } else {
                    d2 + INCUMBENCY
                }
            });
            for (i, j) in matching.pairs {
                answers[open[i]] = Some(tracks[j].id);
            }
        }
        let mut taken: BTreeSet<u64> = answers.iter().flatten().copied().collect();
        for (a, answer) in asserted.iter().zip(&mut answers) {
            if answer.is_some() {
                continue;
            }
            let before = self.users.get(&a.claim.user).and_then(|u| u.track);
            if let Some(id) = before
                && seen.iter().any(|t| t.id == id)
                && taken.insert(id)
            {
                *answer = Some(id);
            }
        }
        answers
    }

    /// Adds the frame's and the new claims' evidence to what is known of each user.
    fn weigh(&mut self, asserted: &[Asserted], answers: &[Option<u64>], now: Timestamp) {
        let tolerated = self.config.tolerated_distance_m;
        let gate = self.thresholds.level(asserted.len() as f64);
        let floor = self.floor();
        for (a, answer) in asserted.iter().zip(answers) {
            let hidden = answer.is_none() && self.is_hidden(a);
            let user = self.users.entry(a.claim.user.clone()).or_default();
            let track = answer.and_then(|id| self.tracks.get(id));
            let Some(track) = track else {
                user.outside = 0;
                if !a.expected || hidden {
                    user.unanswered_since = None;
                    user.absence = 0.0;
                } else {
                    user.unanswered_since.get_or_insert(now);
                    // A beam in view is missed by chance in one frame of ten at the worst.
                    user.absence += (1.0f64 / 0.1).ln();
                }
                continue;
            };
            user.track = Some(track.id);
            user.unanswered_since = None;
            user.absence = 0.0;
            user.last_answered = Some(now);
            if a.ended {
                continue;
            }
            let claimed = Vector2::new(a.claim.x_m, a.claim.y_m) + self.pose.shift();
            if user.residuals.newest().is_none_or(|t| t < a.claim.time) {
                match track.at(a.claim.time) {
                    Some(then) if track.confirmed && !track.merged => {
                        let beam = track.motion.position_cov();
                        user.residuals.push(a.claim.time, then - claimed, beam, a.variance);
                    }
                    _ if track.confirmed => user.residuals.skip(a.claim.time),
                    _ => {}
                }
            }
            let cov = track.motion.position_cov() + Matrix2::identity() * a.variance + floor;
            let offset = track.motion.position() - a.position;
            let is_outside = track.hit && track.confirmed && surprise(offset, &cov, tolerated + a.slack_m) > gate;
            user.outside = if is_outside { user.outside + 1 } else { 0 };
        }
        let present: BTreeSet<&str> = asserted.iter().map(|a| a.claim.user.as_str()).collect();
        let book = &self.book;
        self.users.retain(|name, _| {
            present.contains(name.as_str())
                || [
                    AlertKind::PositionMismatch,
                    AlertKind::UserUnseen,
                    AlertKind::ClaimsStale,
                ]
                .iter()
                .any(|k| book.is_open(&Cause::User(*k, name.clone())))
        });
    }

    /// Whether the claimed place lies so near a beam of someone else that a second spot there could not be told apart.
    fn is_hidden(&self, a: &Asserted) -> bool {
        self.tracks.all.iter().filter(|t| t.hit).any(|t| {
            let reach = t.detection.resolution_m + 2.0 * a.variance.sqrt();
            (t.motion.position() - a.position).norm() < reach
        })
    }

    fn decide(&mut self, asserted: &[Asserted], mut answers: Vec<Option<u64>>, now: Timestamp) {
        let taken: BTreeSet<u64> = answers.iter().flatten().copied().collect();
        let tracks: Vec<(u64, bool)> = self.tracks.all.iter().map(|t| (t.id, t.hit)).collect();
        self.alone.retain(|id, _| tracks.iter().any(|(t, _)| t == id));
        for (id, hit) in tracks {
            if taken.contains(&id) {
                self.alone.remove(&id);
            } else if hit {
                self.alone.entry(id).or_insert(now);
            }
        }
        self.decide_unclaimed(asserted, &mut answers, now);
        self.decide_users(asserted, &answers, now);
    }

    /// The log's habits, as medians over users: no single one can slow the monitor down.
    fn learn_habits(&mut self, asserted: &[Asserted], claims: &Store, now: Timestamp) {
        if self.first_claim.is_none() && claims.quiet_s(now).is_some() {
            self.first_claim = Some(now);
        }
        if let Some(period) = median(asserted.iter().filter_map(|a| a.period_s)) {
            self.period_s = Some(period);
        }
        let delay = median(asserted.iter().map(|a| seconds(a.claim.time, a.came)));
        self.delay_s = delay.unwrap_or(0.0).clamp(0.0, LONGEST_DELAY_S);
    }

    fn claims_settled(&self, now: Timestamp) -> bool {
        let Some(first) = self.first else { return false };
        match (self.first_claim, self.period_s) {
            (Some(t), Some(period)) => seconds(t, now) >= (FIRST_CLAIMS * period + 2.0 * self.delay_s).min(NO_CLAIMS_S),
            _ => seconds(first, now) >= NO_CLAIMS_S,
        }
    }

    fn decide_unclaimed(&mut self, asserted: &[Asserted], answers: &mut [Option<u64>], now: Timestamp) {
        let settled = self.claims_settled(now);
        let patience = PATIENCE * self.config.decision_s + self.delay_s;
        let candidates: Vec<Track> = self
            .tracks
            .all
            .iter()
            .filter(|t| self.alone.contains_key(&t.id))
            .cloned()
            .collect();
        for track in &candidates {
            let cause = Cause::Track(AlertKind::UnclaimedEmitter, track.id);
            let since = self.alone[&track.id];
            let open = self.book.is_open(&cause);
            let ripe = settled
                && track.hit
                && track.confirmed
                && track.score >= self.level_unclaimed
                && seconds(since, now) >= patience;
            if !open && !ripe {
                continue;
            }
            if !open {
                if let Some(i) = self.displaced_user(asserted, answers, since) {
                    answers[i] = Some(track.id);
                    let user = self.users.entry(asserted[i].claim.user.clone()).or_default();
                    user.track = Some(track.id);
                    user.unanswered_since = None;
                    user.absence = 0.0;
                    user.displaced = true;
                    self.alone.remove(&track.id);
                    continue;
                }
                if let Some(old) = self.lost_alert_near(track) {
                    self.book.rename(&old, cause.clone());
                }
            }
            if track.hit {
                let finding = self.unclaimed(asserted, track, since, now);
                self.book.report(&cause, finding, now, self.frame);
            }
        }
        let open: Vec<(Cause, u64)> = self
            .book
            .open()
            .filter_map(|(c, _)| match c {
                Cause::Track(_, id) => Some((c.clone(), *id)),
                _ => None,
            })
            .collect();
        for (cause, id) in open {
            let still = self.tracks.get(id).is_some_and(|t| t.hit || t.merged) && self.alone.contains_key(&id);
            if !still {
                self.book.absent(&cause, now);
            }
        }
    }

    /// A user whose beam vanished as this one appeared.
    fn displaced_user(&self, asserted: &[Asserted], answers: &[Option<u64>], since: Timestamp) -> Option<usize> {
        (0..asserted.len())
            .filter(|&i| answers[i].is_none() && asserted[i].expected)
            .filter_map(|i| {
                let name = &asserted[i].claim.user;
                if self.book.is_open(&Cause::User(AlertKind::UserUnseen, name.clone())) {
                    return None;
                }
                let user = self.users.get(name)?;
                let gap = seconds(user.unanswered_since?, since).abs();
                (user.absence >= VANISHED && gap <= COINCIDENCE_S).then_some((i, gap))
            })
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(i, _)| i)
    }

    /// An open alert near here whose own track was lost, or took the place of the beam that answered a claim: the same cause.
    fn lost_alert_near(&self, track: &Track) -> Option<Cause> {
        let p = track.motion.position();
        self.book.open().find_map(|(cause, alert)| {
            let Cause::Track(AlertKind::UnclaimedEmitter, id) = cause else {
                return None;
            };
            let lost = !self.alone.contains_key(id) || self.tracks.get(*id).is_none_or(|t| !t.hit);
            let (x, y) = (alert.x_m?, alert.y_m?);
            (lost && (p - Vector2::new(x, y)).norm() < 10.0).then(|| cause.clone())
        })
    }

    /// What else tells of an eavesdropper, each with its likelihood ratio against an honest stray beam.
    fn unclaimed(&self, asserted: &[Asserted], track: &Track, since: Timestamp, now: Timestamp) -> Finding {
        let lasted = seconds(since, now);
        let here = track.motion.position();
        let nearest = asserted
            .iter()
            .filter(|a| !a.ended)
            .map(|a| (a, (a.position - here).norm()))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        let [width, height] =
            [self.camera.x.half_width(), self.camera.y.half_width()].map(|h| 2.0 * h * self.camera.ground_scale());
        let beside = nearest.map(|(a, distance)| {
            // One who wants a user's light stands within its spot; one who does not is anywhere in view.
            let spot = 3.0 * self.spot_m();
            let by_chance = (std::f64::consts::PI * spot * spot * asserted.len() as f64 / (width * height)).min(1.0);
            json!({
                "user": a.claim.user,
                "distance_m": distance,
                "likelihood_ratio": if distance <= spot { 1.0 / by_chance } else { 0.5 },
                "second_beam_for_claim": distance <= self.config.tolerated_distance_m + a.slack_m,
            })
        });
        let vanished: Vec<Value> = asserted
            .iter()
            .filter_map(|a| {
                let gone = self.users.get(&a.claim.user)?.unanswered_since?;
                let gap = seconds(gone, since).abs();
                // Absences come perhaps once an hour and user: one within the gap by chance is that rare.
                let by_chance = (2.0 * gap.max(0.1) / 3600.0).min(1.0);
                Some(json!({ "user": a.claim.user, "apart_s": gap, "likelihood_ratio": 0.5 / by_chance }))
            })
            .collect();
        let usual = median(
            self.users
                .values()
                .filter_map(|u| Some(self.tracks.get(u.track?)?.detection.energy_j)),
        );
        let energy = usual.map(|usual| {
            // ln energies of honest users scatter by about 0.3 (ten coherence times a frame); a stranger's by any factor of ten.
            let z = (track.detection.energy_j.max(1e-30) / usual.max(1e-30)).ln() / 0.3;
            let (honest, stranger) = ((-0.5 * z * z).exp() / 0.3, (-0.5 * (0.3 * z / 2.3).powi(2)).exp() / 2.3);
            json!({ "users_median_j": usual, "likelihood_ratio": (stranger / honest.max(1e-12)).min(1e9) })
        });
        let severity = if lasted >= ESCALATE_S {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let evidence = json!({
            "track": track.id,
            "seen_since": track.since,
            "unclaimed_s": lasted,
            "log_likelihood_ratio": track.score,
            "threshold": self.level_unclaimed,
            "energy_j": track.detection.energy_j,
            "energy_against_users": energy,
            "nearest_user": beside,
            "vanished_users": vanished,
            "flags": track.detection.flags,
        });
        self.at_track(Finding::new(severity, evidence), track)
    }

    fn at_track(&self, mut finding: Finding, track: &Track) -> Finding {
        let (p, c) = (track.motion.position(), track.motion.position_cov());
        finding.x_m = Some(p.x);
        finding.y_m = Some(p.y);
        finding.cov_m2 = Some([[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]]);
        finding
    }

    fn decide_users(&mut self, asserted: &[Asserted], answers: &[Option<u64>], now: Timestamp) {
        let tolerated = self.config.tolerated_distance_m;
        let floor = self.floor();
        let each = (asserted.len() * super::residuals::WINDOWS.len()) as f64;
        let level = self.thresholds.level_every(self.period_s.unwrap_or(0.0), each);
        let level_unseen = self.thresholds.level(asserted.len() as f64);
        for (a, answer) in asserted.iter().zip(answers) {
            let name = a.claim.user.clone();
            let Some(user) = self.users.get_mut(&name) else {
                continue;
            };
            let mismatch = Cause::User(AlertKind::PositionMismatch, name.clone());
            let unseen = Cause::User(AlertKind::UserUnseen, name.clone());
            let track = answer.and_then(|id| self.tracks.get(id));
            if user.mismatched && user.outside == 0 && user.residuals.agree(2, tolerated) {
                // What told of the mismatch is over and must not tell of another one.
                user.residuals.forget();
                user.mismatched = false;
                user.displaced = false;
            }
            let excess = user.residuals.excess(tolerated, &floor);
            user.mismatched |= user.outside >= OUTSIDE_FRAMES || excess.surprise > level;
            match track {
                Some(track) if !a.ended && user.mismatched => {
                    let distance = (track.motion.position() - a.position).norm();
                    let severity = if user.displaced || distance > 2.0 * tolerated {
                        Severity::Critical
                    } else {
                        Severity::Warning
                    };
                    let evidence = json!({
                        "track": track.id,
                        "distance_m": distance,
                        "tolerated_distance_m": tolerated,
                        "surprise": excess.surprise,
                        "threshold": level,
                        "claims_in_window": excess.window,
                        "mean_distance_m": excess.distance_m,
                        "frames_outside": user.outside,
                        "answered_from_elsewhere": user.displaced,
                    });
                    let mut finding = Finding::new(severity, evidence);
                    finding.claimed = claimed(a);
                    let track = track.clone();
                    let finding = self.at_track(finding, &track);
                    self.book.report(&mismatch, finding, now, self.frame);
                }
                _ => self.book.absent(&mismatch, now),
            }
            let Some(user) = self.users.get(&name) else { continue };
            let gone_s = user.unanswered_since.map_or(0.0, |t| seconds(t, now));
            let claimed_since = user
                .unanswered_since
                .is_some_and(|t| a.claim.time > t || user.last_answered.is_none());
            let is_unseen = a.expected
                && user.absence >= level_unseen
                && gone_s >= self.config.decision_s
                && claimed_since
                && self.claims_settled(now);
            let goes_on = self.book.is_open(&unseen) && a.expected && user.absence > 0.0;
            if is_unseen || goes_on {
                let severity = if gone_s >= ESCALATE_S {
                    Severity::Critical
                } else {
                    Severity::Warning
                };
                let evidence = json!({
                    "unseen_s": gone_s,
                    "last_seen": user.last_answered,
                    "log_likelihood_ratio": user.absence,
                    "threshold": level_unseen,
                });
                let mut finding = Finding::new(severity, evidence);
                finding.claimed = claimed(a);
                self.book.report(&unseen, finding, now, self.frame);
            } else {
                self.book.absent(&unseen, now);
            }
        }
        let present: BTreeSet<&str> = asserted.iter().map(|a| a.claim.user.as_str()).collect();
        let orphans: Vec<Cause> = self
            .book
            .open()
            .filter(|(c, _)| matches!(c, Cause::User(_, user) if !present.contains(user.as_str())))
            .map(|(c, _)| c.clone())
            .collect();
        for cause in orphans {
            self.book.absent(&cause, now);
        }
    }

    /// The health of what we are given: frames and claims.
    fn watch_inputs(&mut self, asserted: &[Asserted], claims: &Store, now: Timestamp) {
        let lost = Cause::Whole(AlertKind::SensorLost);
        let blind_s = self.sight.blind_s(now);
        if blind_s >= self.config.sensor_lost_s {
            let finding = Finding::new(Severity::Critical, self.sight.evidence(now));
            self.book.report(&lost, finding, now, self.frame);
        } else if blind_s == 0.0 {
            self.book.absent(&lost, now);
        }
        self.watch_pose(now);
        let stale = Cause::Whole(AlertKind::ClaimsStale);
        let period = self.period_s.unwrap_or(0.0);
        let limit = self.config.claims_stale_s.max(5.0 * period);
        match claims.quiet_s(now) {
            Some((came, made)) if came.max(made) > limit && self.expects_claims(asserted) => {
                let severity = if came.max(made) > 6.0 * limit {
                    Severity::Critical
                } else {
                    Severity::Warning
                };
                let evidence = json!({
                    "newest_came_s_ago": came,
                    "newest_made_s_ago": made,
                    "limit_s": limit,
                    "typical_period_s": period,
                });
                self.book
                    .report(&stale, Finding::new(severity, evidence), now, self.frame);
            }
            _ => self.book.absent(&stale, now),
        }
    }

    fn watch_pose(&mut self, now: Timestamp) {
        let cause = Cause::Whole(AlertKind::PoseInconsistent);
        let limit = self
            .config
            .pose_limit_m
            .unwrap_or(0.5 * self.config.tolerated_distance_m);
        let shift = self.pose.shift();
        let (agreeing, of) = self.pose.support();
        let surprise = surprise(shift, &self.floor(), limit);
        let level = self.thresholds.level(1.0);
        let is_open = self.book.is_open(&cause);
        if surprise > level || (is_open && shift.norm() > 0.9 * limit) {
            let severity = if shift.norm() > 4.0 * limit {
                Severity::Critical
            } else {
                Severity::Warning
            };
            let evidence = json!({
                "shift_m": [shift.x, shift.y],
                "limit_m": limit,
                "users_agreeing": agreeing,
                "users": of,
                "surprise": surprise,
                "threshold": level,
            });
            self.book
                .report(&cause, Finding::new(severity, evidence), now, self.frame);
        } else {
            self.book.absent(&cause, now);
        }
    }

    /// A network without users has nothing to say.
    fn expects_claims(&self, asserted: &[Asserted]) -> bool {
        asserted.iter().any(|a| !a.ended) || self.tracks.all.iter().any(|t| t.confirmed)
    }

    fn report(&mut self, asserted: &[Asserted], frame: u64, now: Timestamp) -> Report {
        let events = self.book.take_events();
        let owner = |id: u64| {
            asserted.iter().find(|a| {
                self.users
                    .get(&a.claim.user)
                    .is_some_and(|u| u.track == Some(id) && u.unanswered_since.is_none())
            })
        };
        let emitters = self
            .tracks
            .all
            .iter()
            .filter(|t| t.hit || t.merged)
            .map(|t| {
                let user = owner(t.id).map(|a| a.claim.user.clone());
                let is_open = |kind: AlertKind| match (&user, kind) {
                    (Some(user), kind) => self.book.is_open(&Cause::User(kind, user.clone())),
                    (None, kind) => self.book.is_open(&Cause::Track(kind, t.id)),
                };
                let status = match &user {
                    Some(_) if is_open(AlertKind::PositionMismatch) => PositionStatus::Mismatch,
                    Some(_) if t.confirmed => PositionStatus::Verified,
                    None if is_open(AlertKind::UnclaimedEmitter) => PositionStatus::Unclaimed,
                    _ => PositionStatus::Pending,
                };
                let (p, c) = (t.motion.position(), t.motion.position_cov());
                TrackedPosition {
                    track: t.id,
                    x_m: p.x,
                    y_m: p.y,
                    cov_m2: [[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]],
                    energy_j: t.detection.energy_j,
                    user,
                    status,
                    flags: match t.merged {
                        true => (t.detection.flags | Flags::UNRESOLVED).names(),
                        false => t.detection.flags.names(),
                    },
                }
            })
            .collect();
        let unseen = asserted
            .iter()
            .filter(|a| {
                self.book
                    .is_open(&Cause::User(AlertKind::UserUnseen, a.claim.user.clone()))
            })
            .map(|a| a.claim.user.clone())
            .collect();
        Report {
            time: now,
            frame,
            emitters,
            unseen,
            events,
            claims: asserted.iter().map(|a| a.claim.clone()).collect(),
        }
    }
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

fn claimed(a: &Asserted) -> Option<Value> {
    Some(json!({
        "x_m": a.claim.x_m,
        "y_m": a.claim.y_m,
        "sigma_m": a.claim.sigma_m,
        "time": a.claim.time,
    }))
}
