//! The monitor: one frame after another through the steps that lead to verdicts, one file a step.

mod answers;
mod chance;
mod crowd;
pub(super) mod habits;
mod inputs;
mod power;
mod spots;
mod summary;
mod unclaimed;
mod users;

use std::collections::BTreeMap;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::blend::Blend;
use super::book::{Book, Cause, Finding};
use super::detection::Detection;
use super::pose::Pose;
use super::sight::Sight;
use super::thresholds::{Family, Thresholds};
use super::tracks::{Track, Tracks};
use super::users::{Asserted, CLAIM_LIFE_S, Reach, User};
use super::{Alert, AlertEvent, AlertKind, Config, Observation, Report, Source};
use crate::claims::{Beam, ClaimState, Standing, Store, seconds};
use crate::optics::Camera;

/// A clock that shows less than this earlier than before has not been set back: frames and failures are stamped apart.
const SET_BACK_S: f64 = 2.0;
/// Systematic error of the positions that does not average out, m.
const SYSTEMATIC_M: f64 = 0.05;
/// A beam and an absence that began within this of each other have one cause, s.
const COINCIDENCE_S: f64 = 1.5;
/// Users that have been seen, from which on only such ones tell of our pose.
const KNOWN_WITNESSES: usize = 3;
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
    first_usable: Option<Timestamp>,
    /// Typical seconds between a user's claims, and from a claim's own time to its arrival.
    period_s: Option<f64>,
    delay_s: f64,
    /// Seconds by which the log's clock is ahead of ours.
    ahead_s: f64,
    time: Option<Timestamp>,
    frame: u64,
    /// Since when each track has had no claim, by track.
    alone: BTreeMap<u64, Timestamp>,
    level_unclaimed: f64,
    /// Users of the frame who share the alert of those never seen.
    strangers: Vec<String>,
}

impl Monitor {
    pub fn new(config: &Config, claims: &crate::claims::Config, camera: &Camera, source: Source) -> Self {
        let thresholds = Thresholds::new(config, source.rate_hz);
        let level_unclaimed = thresholds.level(Family::Unclaimed, 1.0);
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
            first_usable: None,
            period_s: None,
            delay_s: 0.0,
            ahead_s: 0.0,
            time: None,
            frame: 0,
            alone: BTreeMap::new(),
            level_unclaimed,
            strangers: Vec::new(),
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
        self.mind_the_clock(now, claims);
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
        let crowding = self.crowding(&asserted, claims, now);
        self.learn_habits(&asserted, &crowding, claims, now);
        self.book.catch_up(self.has_caught_up(now));
        self.learn_clock();
        if let Some(estimate) = self.sight.judge(&seen, lit) {
            self.first_usable.get_or_insert(now);
            let detections = Detection::of(estimate, &self.camera);
            self.tracks.step(now, &detections, dt);
            self.find_pose(&mut asserted, dt);
            let mut answers = self.answer(&asserted, &crowding, claims);
            self.note_hidden(&mut asserted, &answers);
            self.weigh(&asserted, &answers, now);
            self.note_alone(&answers, now);
            self.decide_unclaimed(&asserted, &mut answers, now);
            self.decide_users(&asserted, &answers, now);
            self.decide_spots(&asserted, &answers, &crowding, now);
            self.note_answered(&asserted, &answers, &crowding, claims, now);
        }
        self.watch_inputs(&asserted, claims, now);
        self.report(&asserted, seen.frame, now)
    }

    /// A frame that the source itself could not deliver whole.
    pub fn unusable(&mut self, frame: u64, time: Timestamp, reason: &str, claims: &mut Store) -> Report {
        self.mind_the_clock(time, claims);
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
        self.mind_the_clock(now, claims);
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

    /// Where the clock was set back, what is anchored in times that have not come yet would keep everything waiting for them.
    /// The monitor starts again, and the alerts that stand go on as over a restart.
    fn mind_the_clock(&mut self, now: Timestamp, claims: &mut Store) {
        if !self.time.is_some_and(|t| seconds(now, t) > SET_BACK_S) {
            return;
        }
        claims.set_back(now);
        self.tracks.forget();
        self.users.clear();
        self.sight = Sight::default();
        self.pose = Pose::default();
        (self.first, self.first_claim, self.first_usable) = (None, None, None);
        (self.period_s, self.delay_s, self.ahead_s) = (None, 0.0, 0.0);
        self.time = None;
        self.alone.clear();
        self.strangers.clear();
        let open = self.book.start_again();
        self.restore(open);
    }

    /// An operator has taken note. `None` when no open alert has this id, or it is acknowledged already.
    pub fn acknowledge(&mut self, id: &str, _at: Timestamp) -> Option<AlertEvent> {
        self.book.acknowledge(id)
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
                        self.users.entry(name.clone()).or_default().blend = Blend::remembering(mean, std);
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
            self.book.restore(cause, alert);
        }
    }

    /// The claims that bear on a frame at `now`.
    fn assert(&self, claims: &mut Store, now: Timestamp) -> Vec<Asserted> {
        let tolerated = self.config.tolerated_distance_m;
        let reach = |s: &Standing| Reach::of(s, now, self.default_sigma_m, tolerated, self.ahead_s);
        let beams: Vec<Beam> = self.tracks.all.iter().map(|t| self.beam(t)).collect();
        claims.choose(&beams, |s| self.is_in_reach(s, &reach(s)));
        claims
            .chosen()
            .map(|s| (s, reach(&s)))
            .filter(|(s, reach)| self.is_held(s) || self.is_in_reach(s, reach))
            .map(|(s, reach)| Asserted::new(&s, reach))
            .map(|mut a| {
                a.expected = !a.ended && self.must_be_seen(&a);
                a
            })
            .collect()
    }

    fn beam(&self, track: &Track) -> Beam {
        let p = track.motion.position();
        Beam {
            position: [p.x, p.y],
            is_answered: !self.alone.contains_key(&track.id),
        }
    }

    /// The beam that answered the user's claim is still followed.
    fn is_held(&self, standing: &Standing) -> bool {
        let tracked = self.users.get(&standing.claim.user).and_then(|u| u.track);
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
    fn must_be_seen(&self, a: &Asserted) -> bool {
        let off = self.config.tolerated_distance_m + a.slack_m + 3.0 * a.variance.sqrt();
        self.is_near_view(a.position, (self.spot_m() - off).min(0.0))
    }

    /// Covariance of what all residuals of a user at `p` share: our own pose and what is systematic in the positions.
    fn floor(&self, p: Vector2<f64>) -> Matrix2<f64> {
        Matrix2::identity() * (SYSTEMATIC_M.powi(2) + self.pose.variance(p))
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
        // Claims that no beam ever answered say nothing of our pose, unless there are no others.
        let (known, invented): (Vec<&Asserted>, Vec<&Asserted>) =
            asserted.iter().filter(|a| a.expected).partition(|a| {
                let user = self.users.get(&a.claim.user);
                user.is_some_and(|u| u.last_answered.is_some())
            });
        let heard = if known.len() >= KNOWN_WITNESSES {
            known
        } else {
            [known, invented].concat()
        };
        let moved = |a: &Asserted| {
            let track = self.tracks.get(self.users.get(&a.claim.user)?.track?)?;
            Some(track.motion.position() - track.at(a.made)?)
        };
        let witnesses: Vec<_> = heard.into_iter().map(|a| a.witness(moved(a))).collect();
        self.pose.update(&beams, &witnesses, dt, self.period_s.unwrap_or(1.0));
        let displacement = self.pose.displacement();
        for a in asserted {
            a.position += displacement.at(a.position);
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

    fn at_track(&self, mut finding: Finding, track: &Track) -> Finding {
        let (p, c) = (track.motion.position(), track.motion.position_cov());
        finding.x_m = Some(p.x);
        finding.y_m = Some(p.y);
        finding.cov_m2 = Some([[c[(0, 0)], c[(0, 1)]], [c[(1, 0)], c[(1, 1)]]]);
        finding
    }
}
