//! Whole runs: honest users raise nothing, and the same input gives the same bytes.

use oapwatch::monitor::PositionStatus;

use crate::SEEDS;
use crate::stories::{Actor, Expect, Story, crowd, tell};

#[test]
fn an_honest_crowd_raises_nothing_and_is_verified() {
    for seed in SEEDS {
        let told = tell(&Story::new(seed, crowd()));
        told.expect(&[]);
        let last = told.reports.last().unwrap();
        assert_eq!(last.emitters.len(), 6);
        assert!(
            last.emitters.iter().all(|e| e.status == PositionStatus::Verified),
            "{last:?}"
        );
    }
}

#[test]
fn the_same_story_gives_the_same_bytes() {
    let story = || {
        let mut actors = crowd();
        actors.push(Actor::intruder(|t| (t >= 10.0).then_some([20.0, 10.0])));
        actors[3] = Actor::new("u-3", |_| [-80.0, 50.0]).beam(|t| (t < 10.0).then_some([-80.0, 50.0]));
        Story::new(12, actors)
    };
    let (one, other) = (tell(&story()).ndjson(), tell(&story()).ndjson());
    assert!(!one.is_empty());
    assert_eq!(one, other);
}
