//! `unclaimed_emitter` within a user's spot: a second beam too near to the user's to be a detection of its own.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use nalgebra::Vector2;
use serde_json::json;

use crate::claims::seconds;
use crate::estimate::Flags;
use crate::monitor::alert::{Alert, AlertKind, SHARED_SPOT, Severity};
use crate::monitor::evidence::power_against_reported;
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::stats::co_location::{CoLocationEvidence, CoLocationTest, OtherBeams};
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::gaussian::largest_eigenvalue;
use crate::monitor::stats::jitter::SecondDifference;
use crate::monitor::stats::robust::median_high;
use crate::monitor::stats::second_moment::CommonMode;
use crate::monitor::stats::step_change::{CandidateSteps, TRIED};
use crate::monitor::track::tracker::Track;

/// Users besides the one at hand from which their median is taken for what all beams share.
const MIN_OTHERS: usize = 2;
/// Share of the threshold from which a beam's present is no longer added to its past: smaller starves the past of an unsteady
/// beam, larger lets a second beam become a habit. Not measured.
const SUSPECT_SHARE: f64 = 0.2;
/// Resolutions within which one beam's light disturbs another's, and where it is lost may have become part of it. Not measured.
const BESIDE_RESOLUTIONS: f64 = 3.0;

/// What is remembered of each user's spot.
#[derive(Debug, Default)]
pub struct Memory(BTreeMap<String, Spot>);

#[derive(Debug, Default)]
struct Spot {
    test: CoLocationTest,
    /// Since when there is evidence of a second beam: the present is not added to the past.
    suspected_since: Option<Timestamp>,
    /// When an emitter that had its own alert was last beside the beam.
    accompanied_at: Option<Timestamp>,
}

/// A user's beam that stands alone in this frame, with all the light of its spot.
struct Watched {
    /// Index of the claim.
    claim: usize,
    track: Track,
}

impl Memory {
    /// The user's usual energy, J, once their beam has a past.
    pub fn usual_energy_j(&self, user: &str) -> Option<f64> {
        let (mean, _) = self.0.get(user)?.test.brightness.past()?;
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
            self.0.entry(user.to_owned()).or_default().test = CoLocationTest::remembered(mean, std);
        }
    }

    pub fn retain(&mut self, is_kept: impl Fn(&str) -> bool) {
        self.0.retain(|user, _| is_kept(user));
    }

    /// Takes the frame's light and positions, less what all beams have in common.
    fn update(&mut self, frame: &FrameContext, watched: &[Watched]) {
        let users: BTreeSet<&str> = watched.iter().map(|w| w.user(frame)).collect();
        for (user, spot) in &mut self.0 {
            if !users.contains(user.as_str()) {
                spot.test.jitter.interrupt();
            }
        }
        let jumps: Vec<Option<SecondDifference>> = watched
            .iter()
            .map(|w| {
                let detection = &w.track.detection;
                let jitter = &mut self.spot(w.user(frame)).test.jitter;
                jitter.second_difference(w.track.last_hit, detection.position, detection.cov)
            })
            .collect();
        let steps: Vec<CandidateSteps> = watched
            .iter()
            .map(|w| {
                let detection = &w.track.detection;
                let variance = largest_eigenvalue(&detection.cov);
                let steps = &mut self.spot(w.user(frame)).test.steps;
                steps.candidates(w.track.last_hit, detection.position, variance)
            })
            .collect();
        let common_jump = common(jumps.iter().flatten().map(|jump| jump.by));
        let common_steps =
            std::array::from_fn::<_, { TRIED }, _>(|k| common(steps.iter().filter_map(|s| Some(s[k]?.aside))));
        for ((w, jump), steps) in watched.iter().zip(jumps).zip(steps) {
            let spot = self.spot(w.user(frame));
            let learn = spot.suspected_since.is_none();
            if let Some(ln_energy) = ln_energy(&w.track) {
                spot.test
                    .push_light(w.track.last_hit, ln_energy, &w.track.detection.moments, learn);
            }
            if let Some(jump) = jump {
                spot.test.push_jitter(jump.less(common_jump), learn);
            }
            spot.test.steps.push(&steps, &common_steps, learn);
        }
    }

    fn spot(&mut self, user: &str) -> &mut Spot {
        if !self.0.contains_key(user) {
            self.0.insert(user.to_owned(), Spot::default());
        }
        self.0.get_mut(user).expect("inserted if it was absent")
    }

    /// What the watched beams besides `user`'s show.
    fn others(&self, user: &str, frame: &FrameContext, watched: &[Watched]) -> OtherBeams {
        let tests: Vec<(bool, &CoLocationTest)> = watched
            .iter()
            .filter_map(|w| Some((w.user(frame) != user, &self.0.get(w.user(frame))?.test)))
            .collect();
        let others = || tests.iter().filter(|(is_other, _)| *is_other).map(|(_, test)| test);
        let enough = |values: Vec<f64>| match values.len() >= MIN_OTHERS {
            true => median_high(values.into_iter()),
            false => None,
        };
        OtherBeams {
            second_moment: CommonMode::of(others().map(|test| &test.second_moment)),
            rise: enough(others().filter_map(|test| test.brightness.recent_rise()).collect()),
            jitter: enough(others().filter_map(|test| test.jitter.recent_mean()).collect()),
            scatter: tests.iter().map(|(_, test)| test.brightness.scatter()).sum(),
        }
    }

    /// Whether enough frames have been seen to say that the user's spot holds no second beam.
    fn has_verdict(&self, user: &str) -> bool {
        self.0.get(user).is_some_and(|spot| spot.test.has_verdict())
    }
}

/// Tests every user's beam that stands alone. A spot that cannot be tested in this frame keeps its alert; one whose beam is gone
/// does not.
pub fn evaluate(frame: &FrameContext, memory: &mut Memory) -> Vec<Finding> {
    let threshold = frame.budget.threshold(TestFamily::CoLocated, frame.claims.len() as f64);
    let watched: Vec<Watched> = (0..frame.claims.len()).filter_map(|i| watched(frame, i)).collect();
    memory.update(frame, &watched);
    let mut findings = Vec::new();
    let mut present: BTreeSet<&str> = BTreeSet::new();
    let mut moved: BTreeSet<Cause> = BTreeSet::new();
    for w in &watched {
        let user = w.user(frame);
        let cause = Cause::CoLocated(user.to_owned());
        let others = memory.others(user, frame, &watched);
        let is_accompanied = is_beside_unclaimed(frame, &w.track, &moved);
        let is_open = frame.alerts.is_open(&cause);
        let spot = memory.spot(user);
        if is_accompanied {
            spot.accompanied_at = Some(frame.now);
        }
        let evidence = spot.test.evaluate(frame.config.tolerated_brightening, &others);
        if !spot.is_present(&evidence, threshold, is_open, frame) {
            continue;
        }
        present.insert(user);
        let mut raised_at = frame.alerts.raised_at(&cause);
        if !is_open && let Some(old) = alert_merged_into(frame, &w.track, &moved) {
            raised_at = frame.alerts.raised_at(&old);
            findings.push(Finding::Renamed {
                from: old.clone(),
                to: cause.clone(),
            });
            moved.insert(old);
        }
        let lasted_s = seconds(raised_at.unwrap_or(frame.now), frame.now);
        let past = spot.test.brightness.past();
        let content = content(frame, w, &evidence, past, threshold, Severity::of_duration(lasted_s));
        findings.push(Finding::present(cause, content));
    }
    let is_watched: BTreeSet<&str> = watched.iter().map(|w| w.user(frame)).collect();
    let is_undecided = |user: &str| {
        let claim = frame.claims.iter().position(|a| a.claim.user == user);
        let is_associated = claim.is_some_and(|i| frame.association.track_id(i).is_some());
        is_associated && !(is_watched.contains(user) && memory.has_verdict(user))
    };
    let over = frame.alerts.open().filter_map(|(cause, _)| match cause {
        Cause::CoLocated(user) if !present.contains(user.as_str()) && !is_undecided(user) => Some(cause),
        _ => None,
    });
    findings.extend(over.cloned().map(Finding::Absent));
    findings
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
        let now = frame.now;
        let claim_wait_s = frame.claim_wait_s();
        let is_suspect = evidence.neg_log_p() > SUSPECT_SHARE * threshold;
        let began = match evidence.step.neg_log_p > SUSPECT_SHARE * threshold {
            true => evidence.step.since.unwrap_or(now),
            false => now,
        };
        self.suspected_since = is_suspect.then(|| self.suspected_since.unwrap_or(now).min(began));
        let Some(suspected) = self.suspected_since else {
            return false;
        };
        if is_open {
            return true;
        }
        // A second beam may be a user's whose claim has yet to come.
        let is_due = evidence.neg_log_p() > threshold && seconds(suspected, now) >= claim_wait_s;
        // One detection that goes astray does not part a user and a stranger who has an alert.
        let is_explained = self.accompanied_at.is_some_and(|t| seconds(t, now) < claim_wait_s);
        is_due && !is_explained
    }
}

impl Watched {
    fn user<'a>(&self, frame: &FrameContext<'a>) -> &'a str {
        &frame.claims[self.claim].claim.user
    }
}

/// The beam of claim `i`, if it is detected, confirmed and nobody else's may be in its spot.
fn watched(frame: &FrameContext, i: usize) -> Option<Watched> {
    let track = frame.track(i)?;
    (track.hit && track.confirmed && !is_shared(frame, i, track)).then(|| Watched {
        claim: i,
        track: with_whole_spot(frame, track),
    })
}

/// `track` with all the light of its spot that is associated with nobody else's claim.
fn with_whole_spot(frame: &FrameContext, track: &Track) -> Track {
    let detection = &track.detection;
    let others = frame.tracker.tracks.iter().filter(|t| {
        let near = &t.detection;
        let reach = detection.resolution_m + 2.0 * largest_eigenvalue(&near.cov).sqrt().min(detection.resolution_m);
        let is_near = (near.position - detection.position).norm() < reach;
        t.hit && t.id != track.id && is_near && !frame.association.contains(t.id)
    });
    track.with_detection(detection.united(others.map(|t| &t.detection), frame.camera))
}

/// Whether another user's beam may be in this spot, by tracks or by claims.
fn is_shared(frame: &FrameContext, i: usize, track: &Track) -> bool {
    let (here, reach) = (track.filter.position(), track.detection.resolution_m);
    frame.confusion_m(track) > 0.0
        || (0..frame.claims.len())
            .filter(|&j| j != i && frame.association.track_id(j).is_none())
            .filter(|&j| frame.crowding.is_evidence(&frame.claims[j]))
            .any(|j| {
                let a = &frame.claims[j];
                let away = (a.position - here).norm() - a.slack_m - 2.0 * a.variance.sqrt();
                away < reach + frame.config.tolerated_distance_m || (a.is_unresolvable && away < frame.overlap_m())
            })
}

/// ln of the spot's energy, where the frame shows all of its light.
fn ln_energy(track: &Track) -> Option<f64> {
    let incomplete = Flags::SATURATED | Flags::MASKED | Flags::NEAR_EDGE | Flags::OUT_OF_TIME;
    let detection = &track.detection;
    (detection.energy_j > 0.0 && !detection.flags.intersects(incomplete)).then(|| detection.energy_j.ln())
}

/// Whether an emitter that has an alert (not `moved`) stands so near that its light explains what is odd about this beam.
fn is_beside_unclaimed(frame: &FrameContext, track: &Track, moved: &BTreeSet<Cause>) -> bool {
    let here = track.filter.position();
    let reach = BESIDE_RESOLUTIONS * track.detection.resolution_m;
    frame.alerts.open().any(|(cause, _)| match cause {
        Cause::Track(id) if !moved.contains(cause) => frame
            .tracker
            .get(*id)
            .is_some_and(|t| t.is_seen() && (t.filter.position() - here).norm() < reach),
        _ => false,
    })
}

/// The alert (not `moved`) of an emitter that can no longer be resolved from this beam: the same cause.
fn alert_merged_into(frame: &FrameContext, track: &Track, moved: &BTreeSet<Cause>) -> Option<Cause> {
    let here = track.filter.position();
    let reach = BESIDE_RESOLUTIONS * track.detection.resolution_m;
    frame.alerts.open().find_map(|(cause, alert)| {
        let Cause::Track(id) = cause else {
            return None;
        };
        let away = (Vector2::new(alert.x_m?, alert.y_m?) - here).norm();
        let is_lost = frame.tracker.get(*id).is_none_or(|t| !t.hit);
        (is_lost && away < reach && !moved.contains(cause)).then(|| cause.clone())
    })
}

fn content(
    frame: &FrameContext,
    w: &Watched,
    evidence: &CoLocationEvidence,
    past: Option<(f64, f64)>,
    threshold: f64,
    severity: Severity,
) -> Content {
    let track = &w.track;
    let evidence = json!({
        "track": track.id,
        SHARED_SPOT: w.user(frame),
        "resolution_m": track.detection.resolution_m,
        "energy_j": track.detection.energy_j,
        "energy_over_the_past": {
            "ratio": evidence.energy_ratio,
            "surprise": evidence.energy_neg_log_p,
            "past_ln_j": past.map(|p| p.0),
            "past_ln_std": past.map(|p| p.1),
        },
        "power_against_reported": power_against_reported(frame, w.claim),
        "unrest_over_the_expected": { "ratio": evidence.jitter_ratio, "surprise": evidence.jitter_neg_log_p },
        "step_aside": {
            "length_m": evidence.step.length_m,
            "surprise": evidence.step.neg_log_p,
            "since": evidence.step.since,
            "energy_surprise": evidence.energy_neg_log_p_since,
            "unrest_surprise": evidence.jitter_neg_log_p_since,
        },
        "width_over_the_expected": { "moment_in_sigma2": evidence.widening, "surprise": evidence.width_neg_log_p },
        "surprise": evidence.neg_log_p(),
        "threshold": threshold,
        "flags": track.detection.flags,
    });
    Content::new(severity, evidence).at(track.filter.position(), track.filter.position_cov())
}

/// What displacements have in common: nothing, where too few are known.
fn common(displacements: impl Iterator<Item = Vector2<f64>>) -> Vector2<f64> {
    let known: Vec<_> = displacements.collect();
    let axis = |k: usize| median_high(known.iter().map(|d| d[k])).unwrap_or(0.0);
    match known.len() > MIN_OTHERS {
        true => Vector2::new(axis(0), axis(1)),
        false => Vector2::zeros(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::fixture::{Scene, absent, present};
    use crate::monitor::track::association::Association;
    use crate::monitor::track::detection::Detection;
    use crate::monitor::track::detection::fixture::detection;

    const USERS: [[f64; 2]; 4] = [[0.0, 0.0], [80.0, 0.0], [0.0, 80.0], [-80.0, 0.0]];

    struct Watch {
        scene: Scene,
        memory: Memory,
    }

    fn cause(user: usize) -> Cause {
        Cause::CoLocated(format!("u-{user}"))
    }

    impl Watch {
        /// Four users whose ln energies are known to have been 0 ± 0.3.
        fn new() -> Self {
            let spot = || Spot {
                test: CoLocationTest::remembered(0.0, 0.3),
                ..Spot::default()
            };
            Self {
                scene: Scene::of_users(&USERS),
                memory: Memory((0..4).map(|k| (format!("u-{k}"), spot())).collect()),
            }
        }

        fn beams(energies: [f64; 4]) -> Vec<Detection> {
            let of = |([x, y], energy_j): ([f64; 2], f64)| Detection {
                energy_j,
                ..detection(x, y)
            };
            USERS.into_iter().zip(energies).map(of).collect()
        }

        fn detect(&mut self, beams: &[Detection]) -> Vec<Finding> {
            self.scene.detect(beams);
            let findings = evaluate(&self.scene.context(), &mut self.memory);
            self.scene.apply(findings.clone());
            findings
        }

        /// Frames with these energies until one has a finding, and that finding; at most a hundred.
        fn until_found(&mut self, energies: [f64; 4]) -> Option<(usize, Vec<Finding>)> {
            (0..100).find_map(|k| {
                let findings = self.detect(&Self::beams(energies));
                (!present(&findings).is_empty()).then_some((k, findings))
            })
        }
    }

    #[test]
    fn a_spot_that_becomes_three_times_as_bright_is_two_beams() {
        let mut watch = Watch::new();
        let (frame, findings) = watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
        // No sooner than ten frames, and than claims may take.
        assert!((9..20).contains(&frame), "{frame}");
        assert_eq!(present(&findings), [&cause(0)]);
        let alert = watch.scene.alerts.open().next().unwrap().1;
        assert_eq!(alert.evidence[SHARED_SPOT], "u-0");
        let ratio = alert.evidence["energy_over_the_past"]["ratio"].as_f64().unwrap();
        assert!((ratio - 3.0).abs() < 1e-9, "{ratio}");
        assert_eq!(alert.severity, Severity::Warning);
    }

    #[test]
    fn a_spot_a_third_brighter_or_all_spots_brighter_are_not() {
        assert!(Watch::new().until_found([1.34, 1.0, 1.0, 1.0]).is_none());
        assert!(Watch::new().until_found([3.0, 3.0, 3.0, 3.0]).is_none());
    }

    #[test]
    fn a_verdict_survives_a_frame_that_misses_the_beam_and_ends_with_the_beam() {
        let mut watch = Watch::new();
        watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
        let beams = Watch::beams([3.0, 1.0, 1.0, 1.0]);
        // The association of a beam that was just missed is held, but it cannot be tested: neither present nor absent.
        watch.scene.detect(&beams[1..]);
        watch.scene.association.assign(0, 1);
        assert!(evaluate(&watch.scene.context(), &mut watch.memory).is_empty());
        watch.scene.association = Association::none(4);
        assert_eq!(
            absent(&evaluate(&watch.scene.context(), &mut watch.memory)),
            [&cause(0)]
        );
    }

    #[test]
    fn it_ends_when_the_light_is_one_beams_again() {
        let mut watch = Watch::new();
        watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
        let findings: Vec<_> = (0..100).map(|_| watch.detect(&Watch::beams([1.0; 4]))).collect();
        let first_absent = findings.iter().position(|f| !absent(f).is_empty()).expect("it ends");
        // The windows still hold some of the light; 40 frames are needed for a verdict.
        assert!((20..80).contains(&first_absent), "{first_absent}");
    }

    #[test]
    fn a_stranger_with_an_alert_beside_the_user_explains_the_light() {
        let mut watch = Watch::new();
        let mut beams = Watch::beams([3.0, 1.0, 1.0, 1.0]);
        beams.push(detection(5.0, 0.0));
        watch.scene.detect(&beams);
        let stranger = watch.scene.tracker.tracks.last().unwrap().id;
        let content = Content::new(Severity::Warning, json!({})).at(Vector2::new(5.0, 0.0), Default::default());
        watch
            .scene
            .apply(vec![Finding::present(Cause::Track(stranger), content)]);
        assert!((0..40).all(|_| present(&watch.detect(&beams)).is_empty()));
        // Once it has merged into the spot, its alert goes on as that of the spot.
        beams.pop();
        let found = (0..40)
            .find_map(|_| Some(watch.detect(&beams)).filter(|f| !f.is_empty()))
            .expect("found");
        let [Finding::Renamed { from, to }, Finding::Present(..)] = &found[..] else {
            panic!("{found:?}");
        };
        assert_eq!((from, to), (&Cause::Track(stranger), &cause(0)));
    }

    #[test]
    fn a_spot_that_may_be_shared_is_not_tested() {
        let mut watch = Watch::new();
        // A second user claims to be 4 m away, and has no beam.
        watch.scene.claim(1, 4.0, 0.0);
        watch.scene.association = Association::none(4);
        watch.scene.association.assign(0, 1);
        assert!(watched(&watch.scene.context(), 0).is_none());
        watch.scene.claim(1, 40.0, 0.0);
        assert!(watched(&watch.scene.context(), 0).is_some());
    }

    #[test]
    fn the_past_outlasts_a_restart() {
        let mut watch = Watch::new();
        watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
        let mut restarted = Memory::default();
        restarted.restore(watch.scene.alerts.open().next().unwrap().1);
        let energy = restarted.usual_energy_j("u-0").unwrap();
        assert!((energy - 1.0).abs() < 1e-9, "{energy}");
        restarted.retain(|user| user != "u-0");
        assert!(restarted.usual_energy_j("u-0").is_none());
    }

    #[test]
    fn the_common_mode_needs_three() {
        let of = |xs: &[f64]| common(xs.iter().map(|x| Vector2::new(*x, 0.0))).x;
        assert_eq!((of(&[1.0, 1.0]), of(&[1.0, 5.0, 2.0])), (0.0, 2.0));
    }
}
