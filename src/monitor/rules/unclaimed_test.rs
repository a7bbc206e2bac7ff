//! Beams that nobody claims, that go, come again and swap names with others.

use super::*;
use crate::monitor::fixture::{Scene, absent, present};
use crate::monitor::track::association::Association;

const USER: [f64; 2] = [0.0, 0.0];

/// One user, and the findings of each frame that shows these beams.
struct Watch {
    scene: Scene,
    memory: Memory,
}

impl Watch {
    fn new() -> Self {
        Self {
            scene: Scene::of_users(&[USER]),
            memory: Memory::default(),
        }
    }

    fn show(&mut self, places: &[[f64; 2]]) -> Vec<Finding> {
        self.scene.show(places);
        self.memory.update(self.scene.context());
        let findings = evaluate(self.scene.context(), &mut self.memory);
        self.scene.apply(findings.clone());
        findings
    }

    /// A stranger at (x, 0) until the first finding; gives the frames before it.
    fn intrude(&mut self, x: f64) -> usize {
        (0..100)
            .take_while(|_| present(&self.show(&[USER, [x, 0.0]])).is_empty())
            .count()
    }
}

#[test]
fn a_beam_without_a_claim_is_alerted_after_the_wait_for_claims() {
    let mut watch = Watch::new();
    assert!(watch.show(&[USER]).is_empty());
    // 0.65 s after its first frame.
    assert_eq!(watch.intrude(40.0), 7);
    let alert = watch.scene.alerts.open().next().unwrap().1;
    assert_eq!((alert.x_m.unwrap().round(), alert.severity), (40.0, Severity::Warning));
    assert_eq!(alert.evidence["nearest_user"]["user"], "u-0");
    (0..100).for_each(|_| drop(watch.show(&[USER, [40.0, 0.0]])));
    assert_eq!(watch.scene.alerts.open().next().unwrap().1.severity, Severity::Critical);
}

#[test]
fn a_beam_that_blinks_is_alerted_once_it_has_shone_as_long() {
    let mut watch = Watch::new();
    // Half a second of every 2.2.
    let shone = |k: usize| k % 22 < 5;
    let first = (0..100).find(|&k| {
        let beams = [USER, [40.0, 0.0]];
        !present(&watch.show(if shone(k) { &beams } else { &beams[..1] })).is_empty()
    });
    assert_eq!(first, Some(25));
    let alert = watch.scene.alerts.open().next().unwrap().1;
    assert_eq!(alert.evidence["shone_before_s"], 0.4);
}

#[test]
fn before_claims_have_settled_nobody_is_a_stranger() {
    let mut watch = Watch::new();
    watch.scene.timing = Default::default();
    assert_eq!(watch.intrude(40.0), 100);
}

#[test]
fn a_beam_that_is_gone_is_absent_and_one_that_is_merged_is_not() {
    let mut watch = Watch::new();
    watch.intrude(2.5);
    let stranger = Cause::Track(2);
    // Into the user's spot: seen, and without a claim.
    assert!(watch.show(&[USER]).is_empty());
    assert_eq!(watch.scene.tracker.get(2).unwrap().merged_into, Some(1));
    let mut watch = Watch::new();
    watch.intrude(40.0);
    assert_eq!(absent(&watch.show(&[USER])), [&stranger]);
}

#[test]
fn who_comes_on_again_nearby_is_the_same_cause() {
    for (x, is_renamed) in [(47.0, true), (55.0, false)] {
        let mut watch = Watch::new();
        watch.intrude(40.0);
        let raised = watch.scene.alerts.open().count();
        // The alert is held open for a second; the new beam is due before.
        let renamed = (0..9).any(|_| {
            let findings = watch.show(&[USER, [x, 0.0]]);
            matches!(findings[..], [Finding::Renamed { .. }, Finding::Present(..), ..])
        });
        assert_eq!((renamed, raised), (is_renamed, 1), "{x}");
    }
}

#[test]
fn where_two_beams_swap_names_the_alert_follows_the_one_without_a_claim() {
    let mut watch = Watch::new();
    watch.intrude(3.0);
    watch.scene.association = Association::none(1);
    watch.scene.association.assign(0, 2);
    watch.memory.update(watch.scene.context());
    let findings = evaluate(watch.scene.context(), &mut watch.memory);
    let [Finding::Renamed { from, to }] = &findings[..] else {
        panic!("{findings:?}");
    };
    assert_eq!((from, to), (&Cause::Track(2), &Cause::Track(1)));
}

#[test]
fn a_due_beam_is_offered_to_users_who_vanished_before_it_is_alerted() {
    let mut watch = Watch::new();
    let since = watch.scene.now + jiff::SignedDuration::from_millis(100);
    for k in 0..8 {
        watch.scene.show(&[USER, [40.0, 0.0]]);
        watch.memory.update(watch.scene.context());
        let due = watch.memory.due(watch.scene.context());
        assert_eq!(due, if k < 7 { vec![] } else { vec![(2, since)] });
    }
    assert_eq!(watch.memory.undecided(&watch.scene.alerts), [since]);
    watch.memory.remove(2);
    assert!(evaluate(watch.scene.context(), &mut watch.memory).is_empty());
    assert!(watch.memory.undecided(&watch.scene.alerts).is_empty());
}
