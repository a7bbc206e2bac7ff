//! `unclaimed_emitter` within a user's spot: a second beam too near to the user's to be a detection of its own.

use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::json;

use crate::monitor::alert::{Alert, AlertKind, SHARED_SPOT, Severity};
use crate::monitor::by_user::ByUser;
use crate::monitor::evidence::power_against_reported;
use crate::monitor::finding::{Cause, Content, Finding, is_renamed};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::rules::watched_spot::{Owner, WatchedSpot, watched_spots};
use crate::monitor::stats::co_location::{CoLocationEvidence, CoLocationTest, OtherBeams};
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::monitor::stats::jitter::SecondDifference;
use crate::monitor::stats::robust::{common_displacement, median_high};
use crate::monitor::stats::second_moment::CommonMode;
use crate::monitor::stats::step_change::{CandidateSteps, TRIED};
use crate::monitor::track::beam_track::Track;
use crate::time::seconds;

/// Users besides the one at hand from which their median is taken for what all beams share. With one, a single other beam would
/// decide; more leave small groups without a common mode.
const MIN_OTHERS: usize = 2;
/// Share of the threshold from which a beam's present is no longer added to its past: smaller starves the past of an unsteady
/// beam, larger lets a second beam become a habit. Not measured.
pub const SUSPECT_SHARE: f64 = 0.2;
/// Resolutions within which one beam's light disturbs another's, and where it is lost may have become part of it. Not measured.
const BESIDE_RESOLUTIONS: f64 = 3.0;

/// What is remembered of each spot.
#[derive(Debug, Default)]
pub struct Memory {
    users: ByUser<Spot>,
    /// Of known lights, by id.
    lights: ByUser<Spot>,
}

#[derive(Debug, Default)]
pub struct Spot {
    test: CoLocationTest,
    /// Since when there is evidence of a second beam: the present is not added to the past.
    suspected_since: Option<Timestamp>,
}

impl Memory {
    fn get(&self, owner: Owner) -> Option<&Spot> {
        match owner {
            Owner::User(user) => self.users.get(user),
            Owner::Light(id) => self.lights.get(id),
        }
    }

    fn entry(&mut self, owner: Owner) -> &mut Spot {
        match owner {
            Owner::User(user) => self.users.entry(user),
            Owner::Light(id) => self.lights.entry(id),
        }
    }

    /// Forgets users who no longer matter.
    pub fn retain(&mut self, matters: impl Fn(&str) -> bool) {
        self.users.retain(matters);
    }

    /// Forgets the known lights that are none any more.
    pub fn retain_lights(&mut self, is_known: impl Fn(&str) -> bool) {
        self.lights.retain(is_known);
    }

    /// A known light of which the mean and standard deviation of its ln energy are known from before a restart.
    pub fn remember_light(&mut self, id: &str, mean: f64, std: f64) {
        self.lights.entry(id).test = CoLocationTest::remembered(mean, std);
    }

    /// The user's usual energy, J, once their beam has a past.
    pub fn usual_energy_j(&self, user: &str) -> Option<f64> {
        let (mean, _) = self.users.get(user)?.test.brightness.past()?;
        Some(mean.exp())
    }

    /// Takes up a spot's past from the alert that was open before a restart.
    pub fn restore(&mut self, alert: &Alert) {
        let (AlertKind::UnclaimedEmitter, None, Some(user)) =
            (alert.kind, &alert.user, alert.evidence[SHARED_SPOT].as_str())
        else {
            return;
        };
        let past = &alert.evidence["energy_over_the_past"];
        if let (Some(mean), Some(std)) = (past["past_ln_j"].as_f64(), past["past_ln_std"].as_f64()) {
            self.users.entry(user).test = CoLocationTest::remembered(mean, std);
        }
    }

    /// Takes the frame's light and positions, less what all beams have in common.
    fn update(&mut self, frame: &FrameContext, watched: &[WatchedSpot]) {
        let users = self.users.iter_mut().map(|(user, spot)| (Owner::User(user), spot));
        let lights = self.lights.iter_mut().map(|(id, spot)| (Owner::Light(id), spot));
        for (_, spot) in users.chain(lights).filter(|(owner, _)| find(watched, *owner).is_none()) {
            spot.test.jitter.interrupt();
        }
        let displacements: Vec<(Option<SecondDifference>, CandidateSteps)> = watched
            .iter()
            .map(|w| {
                let (time, detection) = (w.track.last_hit, &w.detection);
                let test = &mut self.entry(w.owner).test;
                let variance = largest_eigenvalue(&detection.cov);
                (
                    test.jitter.second_difference(time, detection.position, detection.cov),
                    test.steps.candidates(time, detection.position, variance),
                )
            })
            .collect();
        let common_jump = common_displacement(
            MIN_OTHERS,
            displacements.iter().filter_map(|(jump, _)| Some(jump.as_ref()?.by)),
        );
        let common_steps: [_; TRIED] = std::array::from_fn(|k| {
            common_displacement(
                MIN_OTHERS,
                displacements.iter().filter_map(|(_, steps)| Some(steps[k]?.aside)),
            )
        });
        for (w, (jump, steps)) in watched.iter().zip(displacements) {
            let spot = self.entry(w.owner);
            let learn = spot.suspected_since.is_none();
            if let Some(light) = w.light(frame) {
                spot.test.second_moment.push(&w.detection.moments, learn);
                spot.test.brightness.push(w.track.last_hit, light, learn);
            }
            if let Some(jump) = jump {
                spot.test.jitter.push(jump, common_jump, learn);
            }
            spot.test.steps.push(&steps, &common_steps, learn);
        }
    }

    /// What the watched beams of the same kind besides the owner's show: lamps are steadier than users.
    fn others(&self, owner: Owner, watched: &[WatchedSpot]) -> OtherBeams {
        let is_like = |w: &&WatchedSpot| matches!(w.owner, Owner::User(_)) == matches!(owner, Owner::User(_));
        let alike = watched.iter().filter(is_like);
        let tests: Vec<_> = alike
            .filter_map(|w| Some((w.owner, &self.get(w.owner)?.test)))
            .collect();
        let others: Vec<_> = tests
            .iter()
            .filter(|(other, _)| *other != owner)
            .map(|(_, test)| *test)
            .collect();
        let enough = |values: Vec<f64>| match values.len() >= MIN_OTHERS {
            true => median_high(values.into_iter()),
            false => None,
        };
        OtherBeams {
            second_moment: CommonMode::of(others.iter().map(|test| &test.second_moment)),
            rise: enough(others.iter().filter_map(|test| test.brightness.recent_rise()).collect()),
            jitter: enough(others.iter().filter_map(|test| test.jitter.recent_mean()).collect()),
            scatter: tests.iter().map(|(_, test)| test.brightness.scatter()).sum(),
        }
    }

    /// Evidence of a second beam in the spot of a known light, which [`evaluate`] has taken the frame of.
    pub fn of_light(
        &mut self,
        frame: &FrameContext,
        spot: &WatchedSpot,
        watched: &[WatchedSpot],
        threshold: f64,
    ) -> CoLocationEvidence {
        let others = self.others(spot.owner, watched);
        let remembered = self.entry(spot.owner);
        if is_beside_unclaimed(frame, spot.track, &[]) {
            remembered.test.restart();
        }
        let evidence = remembered.test.evaluate(frame.config.tolerated_brightening, &others);
        // Whether it lasts is the known light's own question; here it ends what the spot learns.
        remembered.is_present(&evidence, threshold, false, frame);
        evidence
    }
}

/// Tests every user's beam that stands alone. A spot that cannot be tested in this frame keeps its alert; one whose beam is gone
/// does not.
pub fn evaluate(frame: &FrameContext, memory: &mut Memory) -> Vec<Finding> {
    let threshold = frame.budget.threshold(TestFamily::CoLocated, frame.claims.len() as f64);
    let watched = watched_spots(frame);
    memory.update(frame, &watched);
    let mut findings = Vec::new();
    for w in &watched {
        let Owner::User(user) = w.owner else {
            continue;
        };
        let cause = Cause::CoLocated(user.to_owned());
        let others = memory.others(w.owner, &watched);
        let is_open = frame.alerts.is_open(&cause);
        let spot = memory.entry(w.owner);
        if is_beside_unclaimed(frame, w.track, &findings) {
            spot.test.restart();
        }
        let evidence = spot.test.evaluate(frame.config.tolerated_brightening, &others);
        if !spot.is_present(&evidence, threshold, is_open, frame) {
            continue;
        }
        let mut raised_at = frame.alerts.raised_at(&cause);
        if !is_open && let Some(from) = alert_merged_into(frame, w.track, &findings) {
            raised_at = frame.alerts.raised_at(&from);
            let to = cause.clone();
            findings.push(Finding::Renamed { from, to });
        }
        let lasted_s = seconds(raised_at.unwrap_or(frame.now), frame.now);
        let past = spot.test.brightness.past();
        let content = content(
            frame,
            w,
            user,
            &evidence,
            past,
            threshold,
            Severity::of_duration(lasted_s),
        );
        findings.push(Finding::present(cause, content));
    }
    for (cause, _) in frame.alerts.open() {
        let Cause::CoLocated(user) = cause else {
            continue;
        };
        let is_present = findings.iter().any(|finding| finding.cause() == cause);
        let is_watched = find(&watched, Owner::User(user)).is_some();
        let is_tested = is_watched && memory.users.get(user).is_some_and(|spot| spot.test.has_verdict());
        if !is_present && (is_tested || !has_beam(frame, user)) {
            findings.push(Finding::Absent(cause.clone()));
        }
    }
    findings
}

fn find<'a>(watched: &'a [WatchedSpot], owner: Owner) -> Option<&'a WatchedSpot<'a>> {
    let found = watched.binary_search_by(|w| w.owner.cmp(&owner));
    found.ok().map(|k| &watched[k])
}

/// Whether a track is associated with the user's claim.
fn has_beam(frame: &FrameContext, user: &str) -> bool {
    let claim = frame.claims.iter().position(|a| a.claim.user == user);
    claim.is_some_and(|i| frame.association.track_id(i).is_some())
}

impl Spot {
    /// Whether there is a second beam: the evidence is above the threshold and has lasted for as long as a claim may take to come,
    /// or the alert `is_open` and there is still some evidence.
    fn is_present(
        &mut self,
        evidence: &CoLocationEvidence,
        threshold: f64,
        is_open: bool,
        frame: &FrameContext,
    ) -> bool {
        let (now, claim_wait_s) = (frame.now, frame.claim_wait_s());
        let is_suspect = evidence.neg_log_p() > SUSPECT_SHARE * threshold;
        let began = match evidence.step.neg_log_p > SUSPECT_SHARE * threshold {
            true => evidence.step.since.unwrap_or(now),
            false => now,
        };
        self.suspected_since = is_suspect.then(|| self.suspected_since.unwrap_or(now).min(began));
        let Some(suspected) = self.suspected_since else {
            return false;
        };
        // A second beam may be a user's whose claim has yet to come.
        let is_due = evidence.neg_log_p() > threshold && seconds(suspected, now) >= claim_wait_s;
        is_open || is_due
    }
}

/// Whether an emitter that has an alert, not renamed by `findings`, stands so near that its light explains what is odd about this beam.
fn is_beside_unclaimed(frame: &FrameContext, track: &Track, findings: &[Finding]) -> bool {
    let here = track.filter.position();
    let reach = BESIDE_RESOLUTIONS * track.detection.resolution_m;
    frame.alerts.open().any(|(cause, _)| match cause {
        Cause::Track(id) if !is_renamed(findings, cause) => frame
            .tracker
            .get(*id)
            .is_some_and(|t| t.is_seen() && (t.filter.position() - here).norm() < reach),
        _ => false,
    })
}

/// The alert, not renamed by `findings`, of an emitter that can no longer be resolved from this beam: the same cause.
fn alert_merged_into(frame: &FrameContext, track: &Track, findings: &[Finding]) -> Option<Cause> {
    let here = track.filter.position();
    let reach = BESIDE_RESOLUTIONS * track.detection.resolution_m;
    frame.alerts.open().find_map(|(cause, alert)| {
        let Cause::Track(id) = cause else {
            return None;
        };
        let away = (Vector2::new(alert.x_m?, alert.y_m?) - here).norm();
        let is_lost = frame.tracker.get(*id).is_none_or(|t| !t.hit);
        (is_lost && away < reach && !is_renamed(findings, cause)).then(|| cause.clone())
    })
}

fn content(
    frame: &FrameContext,
    w: &WatchedSpot,
    user: &str,
    evidence: &CoLocationEvidence,
    past: Option<(f64, f64)>,
    threshold: f64,
    severity: Severity,
) -> Content {
    let (track, detection) = (w.track, &w.detection);
    let evidence = json!({
        "track": track.id,
        SHARED_SPOT: user,
        "resolution_m": detection.resolution_m,
        "energy_j": detection.energy_j,
        "energy_over_the_past": {
            "ratio": evidence.energy.ratio,
            "surprise": evidence.energy.neg_log_p,
            "past_ln_j": past.map(|p| p.0),
            "past_ln_std": past.map(|p| p.1),
        },
        "power_against_reported": w.claim.and_then(|i| power_against_reported(frame, i)),
        "unrest_over_the_expected": { "ratio": evidence.jitter.ratio, "surprise": evidence.jitter.neg_log_p },
        "step_aside": {
            "length_m": evidence.step.length_m,
            "surprise": evidence.step.neg_log_p,
            "since": evidence.step.since,
            "energy_surprise": evidence.energy_since.neg_log_p,
            "unrest_surprise": evidence.jitter_since.neg_log_p,
        },
        "width_over_the_expected": { "moment_in_sigma2": evidence.width.trace, "surprise": evidence.width.neg_log_p },
        "surprise": evidence.neg_log_p(),
        "threshold": threshold,
        "flags": detection.flags,
    });
    Content::new(severity, evidence).at(frame.place(track), frame.position_cov(track))
}

#[cfg(test)]
#[path = "co_located_test.rs"]
mod tests;
