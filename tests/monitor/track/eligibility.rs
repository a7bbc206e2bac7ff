//! Beams that come to a claim, and claims that come to a beam.

use oapwatch::monitor::AlertKind::*;

use crate::hostile::forged;
use crate::stories::{Actor, Story, crowd, tell};

/// One invented name, claimed at a place for a while: who is nobody's and then walks there is not the one who was claimed.
#[test]
fn a_beam_that_walks_onto_a_claim_stays_nobodys() {
    let mut actors = crowd();
    actors.push(Actor::intruder(|t| {
        (t >= 10.0).then(|| [(0.8 * (t - 10.0)).min(20.0) + 20.0, 10.0])
    }));
    let mut story = Story::new(23, actors);
    story.seconds = 60.0;
    for s in 5..60 {
        story.forged.push((f64::from(s), forged("!", f64::from(s), 40.0, 10.0)));
    }
    let told = tell(&story);
    let raised = told.raised();
    assert!(
        raised
            .iter()
            .any(|(kind, _, t)| *kind == UnclaimedEmitter && *t <= 11.0),
        "{raised:?}"
    );
    let cleared = told
        .events
        .iter()
        .filter(|e| e.alert.kind == UnclaimedEmitter && e.alert.cleared_at.is_some());
    assert_eq!(cleared.count(), 0);
}

/// What was claimed too late, or wrongly, and then comes to the beam clears the alert as ever.
#[test]
fn a_claim_that_comes_to_the_beam_clears_its_alert() {
    let mut actors = crowd();
    let place = |t: f64| (t >= 10.0).then_some([20.0, 10.0]);
    let claimed = |t: f64| (t >= 5.0).then_some(if t < 20.0 { [60.0, 10.0] } else { [20.0, 10.0] });
    actors.push(Actor::new("late", |_| [20.0, 10.0]).beam(place).claim(claimed));
    let mut story = Story::new(24, actors);
    story.seconds = 40.0;
    let told = tell(&story);
    let open = told.events.iter().rev().find(|e| e.alert.kind == UnclaimedEmitter);
    assert!(open.is_some_and(|e| e.alert.cleared_at.is_some()), "{}", told.ndjson());
    let last = told.reports.last().expect("reports");
    assert!(
        last.emitters.iter().any(|e| e.user.as_deref() == Some("late")),
        "{last:?}"
    );
}
