//! The monitor alone, on synthetic estimates.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::measured::{Measured, Raised, exceptions};
use crate::monitor::AlertKind::{self, PositionMismatch, UnclaimedEmitter};
use crate::study::stories::{Actor, Story, crowd, honest, tell_with};

/// Share of attacks that must be alerted in time.
const GOAL: f64 = 0.999;
/// Seconds of a story of honest users.
const HONEST_S: f64 = 100.0;

/// Every story is told; what each raised.
fn told(stories: u64, seed: u64, story: impl Fn(u64) -> Story + Sync) -> Vec<(u64, Raised)> {
    let seeds = (seed..seed + stories).into_par_iter();
    seeds.map(|k| (k, tell_with(&story(k), false).raised())).collect()
}

/// Honest stories of 100 s raise nothing.
pub fn honest_users(stories: u64, seed: u64) -> Measured {
    let mut raised = told(stories, seed, |k| honest(k, HONEST_S));
    raised.retain(|(_, raised)| !raised.is_empty());
    Measured {
        text: format!(
            "{} honest frames: {} stories with alerts\n{}",
            stories * 1000,
            raised.len(),
            exceptions(&raised)
        ),
        holds: raised.is_empty(),
    }
}

/// An intruder anywhere in view at 5 s, standing or walking, is alerted within a second.
pub fn intruders(stories: u64, seed: u64) -> Measured {
    power(
        told(stories, seed, intrusion),
        UnclaimedEmitter,
        [5.0, 6.0],
        "intruders alerted within 1 s",
    )
}

/// A user who steps to 2 m beyond the tolerated distance is alerted within a second.
pub fn beyond(stories: u64, seed: u64) -> Measured {
    power(
        told(stories, seed, step_out),
        PositionMismatch,
        [5.0, 6.05],
        "users 2 m beyond alerted within 1 s",
    )
}

/// A drift of 0.1 m/s is alerted before it is 1 m beyond the tolerated distance.
pub fn drifts(stories: u64, seed: u64) -> Measured {
    power(
        told(stories, seed, drift),
        PositionMismatch,
        [55.0, 65.0],
        "drifts alerted before 1 m beyond",
    )
}

/// In how many stories `kind` is raised within these times, s, and nothing else.
fn power(mut stories: Vec<(u64, Raised)>, kind: AlertKind, [from, to]: [f64; 2], what: &str) -> Measured {
    let all = stories.len();
    let is_as_wished =
        |raised: &Raised| raised.len() == 1 && raised[0].0 == kind && raised[0].2 >= from && raised[0].2 <= to + 1e-9;
    stories.retain(|(_, raised)| !is_as_wished(raised));
    let good = all - stories.len();
    let share = good as f64 / all as f64;
    Measured {
        text: format!(
            "{good} of {all} {what}, nothing else raised: {share:.5}\n{}",
            exceptions(&stories)
        ),
        holds: share >= GOAL,
    }
}

fn intrusion(seed: u64) -> Story {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x1477);
    let place = [rng.random_range(-124.0..124.0), rng.random_range(-124.0..124.0f64)];
    let v = [rng.random_range(-1.5..1.5), rng.random_range(-1.5..1.5)];
    let mut actors = crowd();
    actors.push(Actor::intruder(move |t| {
        let s = t - 5.0;
        // Walks towards the middle's side, so that it stays in view.
        let step = [
            -place[0].signum() * f64::abs(v[0]) * s,
            -place[1].signum() * f64::abs(v[1]) * s,
        ];
        (s >= 0.0).then_some([place[0] + step[0], place[1] + step[1]])
    }));
    let mut story = Story::new(seed, actors);
    story.seconds = 8.0;
    story
}

/// Claims at 10 Hz of 0.3 m; the step is at 5.05 s.
fn step_out(seed: u64) -> Story {
    let mut actors = crowd();
    let angle = seed as f64;
    actors[2] = Actor::new("u-2", |_| [60.0, -50.0]).beam(move |t| {
        let d = if t < 5.05 { 0.0 } else { 7.0 };
        Some([60.0 + d * angle.cos(), -50.0 + d * angle.sin()])
    });
    actors[2].period_s = 0.1;
    let mut story = Story::new(seed, actors);
    story.seconds = 8.0;
    story
}

/// Claims at 1 Hz of 0.1 m; the tolerated distance is passed at 55 s.
fn drift(seed: u64) -> Story {
    let mut actors = crowd();
    let angle = seed as f64;
    actors[2] = Actor::new("u-2", |_| [60.0, -50.0]).beam(move |t| {
        let d = 0.1 * (t - 5.0).max(0.0);
        Some([60.0 + d * angle.cos(), -50.0 + d * angle.sin()])
    });
    actors[2].sigma_m = 0.1;
    let mut story = Story::new(seed, actors);
    story.seconds = 70.0;
    story
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_story_that_is_not_as_wished_counts_against_the_power() {
        let alert = |t: f64| (UnclaimedEmitter, None, t);
        let mut stories: Vec<(u64, Raised)> = (0..999).map(|k| (k, vec![alert(5.5)])).collect();
        let late = |t: f64| (999, vec![alert(t)]);
        stories.push(late(6.1));
        let measured = power(stories.clone(), UnclaimedEmitter, [5.0, 6.0], "alerted");
        assert!(
            measured.holds
                && measured
                    .text
                    .starts_with("999 of 1000 alerted, nothing else raised: 0.99900\nstory 999")
        );
        stories[0].1.push(alert(7.0));
        assert!(!power(stories, UnclaimedEmitter, [5.0, 6.0], "alerted").holds);
    }
}
