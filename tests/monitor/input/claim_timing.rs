//! Claims that come late, or at other paces.

use crate::stories::{Expect, Story, crowd, tell};

#[test]
fn late_claims_raise_nothing() {
    for delay in [0.3, 0.8, 2.0] {
        let mut story = Story::new(10, crowd());
        story.delivery = Box::new(move |t| Some(t + delay * (1.0 + (7.0 * t).sin()) / 2.0));
        tell(&story).expect(&[]);
    }
}

#[test]
fn claims_without_sigma_and_at_other_paces_raise_nothing() {
    for period in [0.1, 0.5, 2.0, 5.0] {
        let mut actors = crowd();
        for actor in &mut actors {
            actor.period_s = period;
            actor.phase_s *= period;
            actor.states_sigma = false;
        }
        let mut story = Story::new(11, actors);
        story.seconds = 60.0;
        tell(&story).expect(&[]);
    }
}
