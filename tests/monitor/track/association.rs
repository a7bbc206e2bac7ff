//! Users who meet, and part.

use crate::stories::{Actor, Expect, Story, tell};

#[test]
fn crossing_users_raise_nothing() {
    for seed in 0..20 {
        let speed = 0.7 + 0.1 * seed as f64;
        let offset = 0.15 * seed as f64;
        let actors = vec![
            Actor::new("a", move |t| [-15.0 * speed + speed * t, 0.0]),
            Actor::new("b", move |t| [15.0 * speed - speed * t, offset]),
            Actor::new("c", |_| [60.0, 60.0]),
        ];
        tell(&Story::new(seed, actors)).expect(&[]);
    }
}

#[test]
fn users_walking_together_raise_nothing() {
    let actors = vec![
        Actor::new("a", |t| [t, 0.0]),
        Actor::new("b", |t| [t + 1.0 + (0.3 * t).sin(), 0.3]),
        Actor::new("c", |_| [60.0, 60.0]),
    ];
    tell(&Story::new(2, actors)).expect(&[]);
}
