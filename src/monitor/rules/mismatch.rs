//! `position_mismatch`: a user's beam is farther from the claim than is tolerated.

use serde_json::json;

use crate::monitor::alert::{Alert, AlertKind, Severity};
use crate::monitor::by_user::ByUser;
use crate::monitor::evidence::{claimed, power_against_reported};
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::stats::claim_consistency::{ClaimConsistency, WINDOWS};
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::stats::gaussian::neg_log_p_outside;
use crate::monitor::track::beam_track::Track;

/// Frames in a row that must show a beam outside before a single claim's evidence stands. More delay the alert of a jump, fewer let
/// one odd frame raise it.
const OUTSIDE_FRAMES: u32 = 3;
/// Claims in a row that must agree before a mismatch ends. With one, a claim in error would end it; more hold the alert of a user
/// who is back.
const AGREEING_CLAIMS: usize = 2;
/// Distance in units of the tolerated one from which a mismatch is critical. Larger delays the escalation, smaller escalates
/// borderline cases. Not tuned.
const CRITICAL_RATIO: f64 = 2.0;

/// What is remembered of each user.
pub type Memory = ByUser<User>;

#[derive(Debug, Default)]
pub struct User {
    consistency: ClaimConsistency,
    /// Frames in a row with the beam outside what is tolerated.
    outside: u32,
    is_mismatched: bool,
    /// A beam elsewhere took the user's place when they vanished.
    is_displaced: bool,
}

impl Memory {
    pub fn is_mismatched(&self, user: &str) -> bool {
        self.get(user).is_some_and(|u| u.is_mismatched)
    }

    /// Takes up a mismatch from before a restart.
    pub fn restore(&mut self, alert: &Alert) {
        if let (AlertKind::PositionMismatch, Some(user)) = (alert.kind, &alert.user) {
            let known = self.entry(user);
            known.is_mismatched = true;
            known.is_displaced = alert.evidence["answered_from_elsewhere"].as_bool().unwrap_or(false);
        }
    }

    /// The user's beam has been found elsewhere.
    pub fn displace(&mut self, user: &str) {
        self.entry(user).is_displaced = true;
    }

    /// Residuals so far were taken by another clock.
    pub fn forget_residuals(&mut self) {
        for (_, user) in self.iter_mut().filter(|(_, u)| !u.is_mismatched) {
            user.consistency.forget();
        }
    }

    /// Adds the residuals of new claims, and counts the frames that show a beam outside.
    pub fn update(&mut self, frame: &FrameContext) {
        let gate = frame.budget.threshold(TestFamily::Mismatch, frame.claims.len() as f64);
        let clock_uncertainty_s = frame.clock_uncertainty_s();
        let is_settled = frame.is_settled();
        for (i, claim) in frame.claims.iter().enumerate() {
            let Some(track) = frame.track(i) else {
                if let Some(user) = self.get_mut(&claim.claim.user) {
                    user.outside = 0;
                }
                continue;
            };
            let user = self.entry(&claim.claim.user);
            let is_provisional = frame.users.get(&claim.claim.user).is_some_and(|u| u.is_provisional);
            if claim.ended || is_provisional {
                continue;
            }
            let confusion_m = frame.confusion_m(track);
            // Where the beam was when the claim was made, less the claim.
            let then = track
                .at(claim.made)
                .map(|then| then - claim.claimed - frame.displacement_at(claim.claimed));
            if user.consistency.newest().is_none_or(|t| t < claim.claim.time) {
                let is_clear = track.confirmed && track.merged_into.is_none() && confusion_m == 0.0;
                match then {
                    Some(then) if is_clear && is_settled => {
                        let beam = track.filter.position_cov();
                        user.consistency.push(claim.claim.time, then, beam, claim.cov);
                    }
                    _ if track.confirmed => user.consistency.skip(claim.claim.time),
                    _ => {}
                }
            }
            let cov = track.filter.position_cov() + claim.cov + frame.systematic_cov(claim.position);
            let here = track.filter.position();
            // Where nobody else claims to be, it is nobody else's beam.
            let is_a_guess = confusion_m > 0.0 && frame.is_anothers_place(i, here);
            let reach = frame.tolerated_distance_m(claim.position)
                + if is_a_guess { confusion_m } else { 0.0 }
                + clock_uncertainty_s * track.filter.velocity().norm();
            let is_beyond = |offset, reach| neg_log_p_outside(offset, &cov, reach) > gate;
            // A beam that was where it was claimed to be has shown itself how far its user has gone since.
            let is_outside = track.hit
                && track.confirmed
                && is_beyond(here - claim.position, reach + claim.slack_m)
                && then.is_none_or(|then| is_beyond(then, reach));
            user.outside = if is_outside { user.outside + 1 } else { 0 };
        }
    }
}

/// Tests every user's claims against their beam, over windows of claims and frame by frame.
pub fn evaluate(frame: &FrameContext, memory: &mut Memory) -> Vec<Finding> {
    let tests = (frame.claims.len() * WINDOWS.len()) as f64;
    let period_s = frame.timing.period_s().unwrap_or(0.0);
    let threshold = frame.budget.threshold_every(period_s, TestFamily::Mismatch, tests);
    let open = frame.alerts.users_with(AlertKind::PositionMismatch);
    let mut findings = Vec::new();
    for i in 0..frame.claims.len() {
        let user = frame.claims[i].claim.user.as_str();
        let content = memory
            .get_mut(user)
            .and_then(|known| known.mismatch(frame, i, threshold));
        if content.is_some() || open.contains(user) {
            let cause = Cause::User(AlertKind::PositionMismatch, user.to_owned());
            findings.push(Finding::of(cause, content));
        }
    }
    findings
}

impl User {
    /// Decides on claim `i`, this user's.
    fn mismatch(&mut self, frame: &FrameContext, i: usize, threshold: f64) -> Option<Content> {
        let claim = &frame.claims[i];
        let track = frame.track(i);
        let tolerated = frame.tolerated_distance_m(claim.position);
        if self.is_mismatched && self.outside == 0 && self.consistency.agree(AGREEING_CLAIMS, tolerated) {
            // What showed this mismatch is over and must not show another one.
            self.consistency.forget();
            self.is_mismatched = false;
            self.is_displaced = false;
        }
        let unsure = track.map_or(0.0, |t| frame.clock_uncertainty_s() * t.filter.velocity().norm());
        let excess = self
            .consistency
            .excess(tolerated + unsure, &frame.systematic_cov(claim.position));
        self.is_mismatched |= frame.is_settled() && (self.outside >= OUTSIDE_FRAMES || excess.neg_log_p > threshold);
        let track = track.filter(|_| self.is_mismatched)?;
        let distance = (track.filter.position() - claim.position).norm();
        let severity = if self.is_displaced || distance > CRITICAL_RATIO * tolerated {
            Severity::Critical
        } else {
            Severity::Warning
        };
        let evidence = json!({
            "track": track.id,
            "distance_m": distance,
            "tolerated_distance_m": tolerated,
            "surprise": excess.neg_log_p,
            "threshold": threshold,
            "claims_in_window": excess.window,
            "mean_distance_m": excess.distance_m,
            "frames_outside": self.outside,
            "clock_offset_s": frame.clock_offset_s,
            "answered_from_elsewhere": self.is_displaced,
            "may_be_of": may_be_of(frame, i, track),
            "power_against_reported": power_against_reported(frame, i),
        });
        let content = Content::new(severity, evidence).at(frame.place(track), frame.position_cov(track));
        Some(content.with_claim(claimed(claim)))
    }
}

/// Users whose beam the track may be as well: theirs and this one may have been taken for each other, and they claim to be where the user of
/// claim `i` does.
fn may_be_of<'a>(frame: &'a FrameContext, i: usize, track: &Track) -> Vec<&'a str> {
    let here = frame.claims[i].position;
    let is_there = |other: &ActiveClaim| {
        let away_m = (other.position - here).norm();
        away_m <= other.reach_m(frame.tolerated_distance_m(here))
    };
    let others = frame.claims.iter().enumerate().filter(|(j, _)| *j != i);
    others
        .filter(|(j, other)| is_there(other) && frame.track(*j).is_some_and(|theirs| theirs.has_met(track)))
        .map(|(_, other)| other.claim.user.as_str())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::Flags;
    use crate::monitor::fixture::{Scene, absent, present};
    use crate::monitor::track::detection::Detection;
    use crate::monitor::track::detection::fixture::detection;

    /// One user whose beam is at the origin.
    struct Watch {
        scene: Scene,
        memory: Memory,
    }

    impl Watch {
        /// Their first claim has been taken, and is true.
        fn new() -> Self {
            let mut watch = Self {
                scene: Scene::of_users(&[[0.0, 0.0]]),
                memory: Memory::default(),
            };
            assert!(watch.show().is_empty());
            watch
        }

        /// A frame.
        fn show(&mut self) -> Vec<Finding> {
            self.scene.show(&[[0.0, 0.0]]);
            self.memory.update(self.scene.context());
            let findings = evaluate(self.scene.context(), &mut self.memory);
            self.scene.apply(findings.clone());
            findings
        }

        /// From now on the claim so far, which is older than the beam, puts the user x m from it.
        fn move_claim(&mut self, x: f64) {
            let claim = &mut self.scene.claims[0];
            claim.position.x = x;
            claim.made = jiff::Timestamp::UNIX_EPOCH - jiff::SignedDuration::from_secs(1);
        }

        /// A frame with a new claim, x m from the beam.
        fn claim(&mut self, x: f64) -> Vec<Finding> {
            self.scene.claim(0, x, 0.0);
            self.show()
        }
    }

    #[test]
    fn a_beam_outside_for_three_frames_is_a_mismatch() {
        let mut watch = Watch::new();
        watch.move_claim(9.0);
        assert!(watch.show().is_empty());
        assert!(watch.show().is_empty());
        let findings = watch.show();
        assert_eq!(
            present(&findings),
            [&Cause::User(AlertKind::PositionMismatch, "u-0".into())]
        );
        let alert = watch.scene.alerts.open().next().unwrap().1;
        assert_eq!(alert.severity, Severity::Warning);
        assert_eq!(alert.evidence["frames_outside"], 3);
        assert!((alert.evidence["distance_m"].as_f64().unwrap() - 9.0).abs() < 1e-9);
        assert!(watch.memory.is_mismatched("u-0"));
    }

    #[test]
    fn a_beam_that_was_where_it_was_claimed_to_be_may_go_anywhere() {
        let mut watch = Watch::new();
        watch.claim(0.0);
        watch.scene.claims[0].position.x = 30.0;
        assert!((0..10).all(|_| watch.show().is_empty()));
    }

    #[test]
    fn a_mismatch_goes_on_after_its_user_s_end_while_the_beam_does() {
        let mut watch = Watch::new();
        assert_eq!(present(&watch.claim(9.0)).len(), 1);
        watch.scene.claims[0].ended = true;
        assert_eq!(present(&watch.show()).len(), 1);
    }

    #[test]
    fn a_beam_within_what_is_tolerated_or_outside_now_and_then_is_none() {
        let mut watch = Watch::new();
        watch.move_claim(4.9);
        assert!((0..10).all(|_| watch.show().is_empty()));
        for k in 0..10 {
            watch.move_claim(if k % 3 == 0 { 0.0 } else { 9.0 });
            assert!(watch.show().is_empty());
        }
    }

    /// Two beams whose fit is in doubt, the user of the second 18 m from their claim, and a third who is missed.
    #[test]
    fn a_doubtful_beam_is_excused_only_where_another_user_claims_to_be() {
        for (third_m, is_excused) in [(20.0, true), (60.0, false)] {
            let mut scene = Scene::of_users(&[[0.0, 0.0], [18.0, 0.0], [third_m, 0.0]]);
            let mut memory = Memory::default();
            scene.claim(1, 0.0, 0.0);
            let mut found = Vec::new();
            for _ in 0..OUTSIDE_FRAMES {
                let doubtful = [0.0, 18.0].map(|x| Detection {
                    flags: Flags::UNRESOLVED,
                    ..detection(x, 0.0)
                });
                scene.detect(&doubtful);
                memory.update(scene.context());
                found = evaluate(scene.context(), &mut memory);
            }
            let of_second = Cause::User(AlertKind::PositionMismatch, "u-1".into());
            assert_eq!(present(&found).contains(&&of_second), !is_excused, "{third_m}");
        }
    }

    #[test]
    fn a_claim_far_off_is_a_mismatch_at_once() {
        let mut watch = Watch::new();
        assert_eq!(present(&watch.claim(9.0)).len(), 1);
        let alert = watch.scene.alerts.open().next().unwrap().1;
        assert_eq!(
            (&alert.evidence["claims_in_window"], &alert.evidence["frames_outside"]),
            (&json!(1), &json!(1))
        );
    }

    #[test]
    fn twice_the_tolerated_distance_or_an_answer_from_elsewhere_is_critical() {
        for (x, displaced, severity) in [
            (9.9, false, Severity::Warning),
            (10.1, false, Severity::Critical),
            (9.9, true, Severity::Critical),
        ] {
            let mut watch = Watch::new();
            if displaced {
                watch.memory.displace("u-0");
            }
            watch.claim(x);
            let alert = watch.scene.alerts.open().next().unwrap().1;
            assert_eq!(alert.severity, severity);
            assert_eq!(alert.evidence["answered_from_elsewhere"], displaced);
        }
    }

    #[test]
    fn a_mismatch_ends_when_two_claims_agree() {
        let mut watch = Watch::new();
        watch.claim(9.0);
        assert_eq!(present(&watch.claim(0.0)).len(), 1, "one claim agrees");
        assert_eq!(present(&watch.show()).len(), 1, "the same claim again");
        assert_eq!(absent(&watch.claim(0.0)).len(), 1);
        assert!(!watch.memory.is_mismatched("u-0"));
    }

    #[test]
    fn an_ended_claim_is_compared_with_nothing() {
        let mut watch = Watch::new();
        watch.scene.claims[0].ended = true;
        assert!((0..10).all(|_| watch.claim(9.0).is_empty()));
    }

    #[test]
    fn before_everybody_has_claimed_nothing_is_decided() {
        let mut watch = Watch::new();
        watch.scene.timing = Default::default();
        assert!((0..10).all(|_| watch.claim(9.0).is_empty()));
    }

    #[test]
    fn residuals_by_another_clock_are_forgotten_unless_they_are_a_mismatch() {
        // Each alone is too little: 6.2 m with an error of 0.3 m.
        let claims_until_found = |forget_after: usize| {
            let mut watch = Watch::new();
            let mut claims = 1;
            while present(&watch.claim(6.2)).is_empty() {
                if claims == forget_after {
                    watch.memory.forget_residuals();
                }
                claims += 1;
                assert!(claims < 50, "many together are enough");
            }
            watch.memory.forget_residuals();
            assert_eq!(present(&watch.show()).len(), 1, "a mismatch is kept");
            claims
        };
        let (undisturbed, disturbed) = (claims_until_found(50), claims_until_found(3));
        assert!(undisturbed > 2 && disturbed > undisturbed, "{undisturbed} {disturbed}");
    }

    #[test]
    fn a_mismatch_outlasts_a_restart() {
        let mut watch = Watch::new();
        watch.claim(9.0);
        let alert = watch.scene.alerts.open().next().unwrap().1.clone();
        let mut restarted = Memory::default();
        restarted.restore(&alert);
        assert!(restarted.is_mismatched("u-0"));
        assert_eq!(present(&evaluate(watch.scene.context(), &mut restarted)).len(), 1);
        restarted.retain(|user| user != "u-0");
        assert!(!restarted.is_mismatched("u-0"));
    }
}
