//! `user_unseen`: a user who is claimed, active and in view, and whose beam is not there.

use jiff::Timestamp;
use serde_json::json;

use crate::monitor::alert::{AlertKind, Severity};
use crate::monitor::evidence::claimed;
use crate::monitor::finding::{Cause, Content, Finding};
use crate::monitor::frame_context::FrameContext;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::stats::error_budget::TestFamily;
use crate::monitor::track::user_track::UserTrack;
use crate::monitor::track::user_tracks::COINCIDENCE_S;
use crate::time::seconds;

/// Users never seen at all who have an alert each; more of them within a cool-down share one, since they have one cause. More bury
/// other alerts under a flood of invented users, fewer deny a new user's absence an alert of its own.
const MAX_NEVER_SEEN: usize = 10;
/// Names of them that the common alert lists.
const MAX_NAMES: usize = 20;

const COMMON: Cause = Cause::System(AlertKind::UserUnseen);

/// Users of the newest frame who share the alert of those never seen.
#[derive(Debug, Default)]
pub struct Memory {
    never_seen: Vec<String>,
}

impl Memory {
    pub fn never_seen(&self) -> &[String] {
        &self.never_seen
    }
}

/// `undecided` is since when each beam that is neither claimed nor alerted has been there: a user who went as it came may be answering
/// from elsewhere, which is one alert and not two.
pub fn evaluate(frame: &FrameContext, memory: &mut Memory, undecided: &[Timestamp]) -> Vec<Finding> {
    let threshold = frame.budget.threshold(TestFamily::Unseen, frame.claims.len() as f64);
    let open = frame.alerts.users_with(AlertKind::UserUnseen);
    let is_common_open = frame.alerts.is_open(&COMMON);
    let mut findings = Vec::new();
    let mut never_seen = NeverSeen::default();
    let mut raised: Vec<&str> = Vec::new();
    for claim in &frame.claims {
        let user = claim.claim.user.as_str();
        let is_open = open.contains(user);
        let Some((known, gone_s)) = absence(frame, claim, threshold, is_open, undecided) else {
            if is_open {
                findings.push(Finding::Absent(Cause::User(AlertKind::UserUnseen, user.to_owned())));
            }
            continue;
        };
        if known.last_seen.is_none() && !is_open {
            let with_alert = never_seen.with_alert.get_or_insert_with(|| {
                let lately = frame.alerts.users_lately_with(AlertKind::UserUnseen, frame.now);
                lately.union(&raised.iter().copied().collect()).count()
            });
            if *with_alert >= MAX_NEVER_SEEN || is_common_open {
                never_seen.names.push(user.to_owned());
                never_seen.longest_s = never_seen.longest_s.max(gone_s);
                continue;
            }
            *with_alert += 1;
        }
        raised.push(user);
        let evidence = json!({
            "unseen_s": gone_s,
            "last_seen": known.last_seen,
            "log_likelihood_ratio": known.absence,
            "threshold": threshold,
        });
        let content = Content::new(Severity::of_duration(gone_s), evidence).with_claim(claimed(claim));
        findings.push(Finding::present(
            Cause::User(AlertKind::UserUnseen, user.to_owned()),
            content,
        ));
    }
    findings.extend(never_seen.finding(is_common_open));
    memory.never_seen = never_seen.names;
    findings
}

/// The user's track and for how long it has been gone, if they are unseen.
fn absence<'a>(
    frame: &'a FrameContext,
    claim: &ActiveClaim,
    threshold: f64,
    is_open: bool,
    undecided: &[Timestamp],
) -> Option<(&'a UserTrack, f64)> {
    let user = frame.users.get(&claim.claim.user)?;
    let gone_s = user.unseen_since.map_or(0.0, |t| seconds(t, frame.now));
    let was_claimed_since = user
        .unseen_since
        .is_some_and(|t| claim.claim.time > t || user.last_seen.is_none());
    let is_unseen = claim.expected
        && user.absence >= threshold
        && gone_s >= frame.config.decision_s
        && was_claimed_since
        && frame.is_settled()
        && !may_be_elsewhere(frame, user, gone_s, undecided);
    let goes_on = is_open && claim.expected && user.absence > 0.0;
    (is_unseen || goes_on).then_some((user, gone_s))
}

/// Whether a beam that came as the user went is still undecided. New beams without end put the verdict off by no more than a
/// coincidence lasts.
fn may_be_elsewhere(frame: &FrameContext, user: &UserTrack, gone_s: f64, undecided: &[Timestamp]) -> bool {
    let Some(gone) = user.unseen_since else {
        return false;
    };
    gone_s < frame.config.decision_s + COINCIDENCE_S
        && undecided
            .iter()
            .any(|since| seconds(gone, *since).abs() <= COINCIDENCE_S)
}

/// Users who are claimed and were never seen, too many for an alert each: who floods the log with invented users must not bury the
/// alerts of others. A user who was ever seen always has their own.
#[derive(Debug, Default)]
struct NeverSeen {
    names: Vec<String>,
    longest_s: f64,
    /// Users with an alert of their own, lately. Counted only where it matters.
    with_alert: Option<usize>,
}

impl NeverSeen {
    fn finding(&self, is_open: bool) -> Option<Finding> {
        if self.names.is_empty() {
            return is_open.then_some(Finding::Absent(COMMON));
        }
        let evidence = json!({
            "users_never_seen": self.names.len(),
            "users": &self.names[..self.names.len().min(MAX_NAMES)],
            "unseen_s": self.longest_s,
        });
        let content = Content::new(Severity::of_duration(self.longest_s), evidence);
        Some(Finding::present(COMMON, content))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::monitor::fixture::{Scene, absent, present};

    fn unseen(user: usize) -> Cause {
        Cause::User(AlertKind::UserUnseen, format!("u-{user}"))
    }

    /// A frame 0.1 s later, with claims of its time and beams at these places.
    fn show(scene: &mut Scene, memory: &mut Memory, places: &[[f64; 2]], undecided: &[Timestamp]) -> Vec<Finding> {
        scene.show(places);
        for claim in &mut scene.frame.claims {
            claim.claim.time = scene.frame.now;
        }
        let findings = evaluate(scene.context(), memory, undecided);
        scene.apply(findings.clone());
        findings
    }

    #[test]
    fn a_user_whose_beam_is_gone_for_a_second_is_unseen() {
        let mut scene = Scene::of_users(&[[0.0, 0.0], [50.0, 0.0]]);
        let mut memory = Memory::default();
        for _ in 0..10 {
            assert!(show(&mut scene, &mut memory, &[[50.0, 0.0]], &[]).is_empty());
        }
        // The eleventh frame without the beam is a second after the first.
        let findings = show(&mut scene, &mut memory, &[[50.0, 0.0]], &[]);
        assert_eq!(present(&findings), [&unseen(0)]);
        assert_eq!(
            absent(&show(&mut scene, &mut memory, &[[0.0, 0.0], [50.0, 0.0]], &[])),
            [&unseen(0)]
        );
    }

    #[test]
    fn a_last_claim_older_than_the_last_beam_says_nothing() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        for _ in 0..30 {
            scene.show(&[]);
            assert!(evaluate(scene.context(), &mut Memory::default(), &[]).is_empty());
        }
    }

    #[test]
    fn a_beam_that_came_as_the_user_went_is_waited_for_and_not_for_ever() {
        let mut scene = Scene::of_users(&[[0.0, 0.0]]);
        let mut memory = Memory::default();
        let undecided = [scene.now];
        let frames = (0..100)
            .take_while(|_| show(&mut scene, &mut memory, &[], &undecided).is_empty())
            .count();
        // decision_s and the longest coincidence: 2.5 s.
        assert_eq!(frames, 25);
    }

    #[test]
    fn of_many_who_were_never_seen_ten_have_an_alert_and_the_rest_share_one() {
        let mut scene = Scene::of_users(&[]);
        let places: Vec<[f64; 2]> = (0..12).map(|k| [-60.0 + 10.0 * f64::from(k), 0.0]).collect();
        scene.claims = Scene::of_users(&places).frame.claims;
        scene.claims.sort_by(|a, b| a.claim.user.cmp(&b.claim.user));
        let mut memory = Memory::default();
        let mut findings = Vec::new();
        (0..11).for_each(|_| findings = show(&mut scene, &mut memory, &[], &[]));
        assert_eq!(present(&findings).len(), 11);
        assert_eq!(present(&findings)[10], &COMMON);
        assert_eq!(memory.never_seen(), ["u-8", "u-9"]);
        let (_, alert) = scene.alerts.open().find(|(cause, _)| **cause == COMMON).unwrap();
        assert_eq!(alert.evidence["users_never_seen"], 2);
        // Whoever joins them while it is open shares it, even when the ten are gone.
        scene.claims.drain(..10);
        let findings = show(&mut scene, &mut memory, &[], &[]);
        assert_eq!(present(&findings), [&COMMON]);
        scene.claims.clear();
        assert_eq!(absent(&show(&mut scene, &mut memory, &[], &[])), [&COMMON]);
    }

    #[test]
    fn a_user_who_was_seen_has_an_alert_however_many_were_not() {
        let mut scene = Scene::of_users(&[[0.0, 80.0]]);
        let mut others = Scene::of_users(&[[0.0, 0.0]; 12]).frame.claims;
        for (k, claim) in others.iter_mut().enumerate() {
            claim.claim.user = format!("a-{k:02}");
        }
        scene.claims.extend(others);
        scene.claims.sort_by(|a, b| a.claim.user.cmp(&b.claim.user));
        let mut memory = Memory::default();
        let mut findings = Vec::new();
        (0..11).for_each(|_| findings = show(&mut scene, &mut memory, &[], &[]));
        assert!(present(&findings).contains(&&unseen(0)));
        assert_eq!(memory.never_seen().len(), 2);
    }
}
