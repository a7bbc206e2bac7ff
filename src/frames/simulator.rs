//! The built-in simulator as a source: keeps a device's pace on the clock on the wall and drops what it cannot
//! make in time.

use std::time::{Duration, Instant};

use jiff::Timestamp;

use super::{Config, Error, FrameSource, Next};
use crate::claim::Claim;
use crate::optics::Camera;
use crate::scene::{Plan, Scene};

/// Frames whose claims are still handed on when many were passed over at once (a suspended machine).
const MOST_CAUGHT_UP: u64 = 10_000;

/// Frames of a scene. Frame k is exposed at start + k/rate; one that is late by a whole interval is passed over,
/// and its claims come with the next.
pub struct Simulator {
    plan: Plan,
    began: Instant,
    next: u64,
}

impl Simulator {
    pub fn open(config: &Config, camera: &Camera) -> Result<Self, Error> {
        let scene = match &config.scene {
            Some(path) => Scene::load(path)?,
            None => Scene::builtin(),
        };
        let plan = Plan::compile(&scene, config.seed)?;
        let (found, expected) = (plan.camera().shape(), camera.shape());
        if found != expected {
            return Err(Error::SceneShape {
                expected_x: expected.1,
                expected_y: expected.0,
                found_x: found.1,
                found_y: found.0,
            });
        }
        Ok(Self {
            plan: plan.starting_at(config.start.unwrap_or_else(Timestamp::now)),
            began: Instant::now(),
            next: 0,
        })
    }

    fn due(&self, k: u64) -> Duration {
        Duration::try_from_secs_f64(k as f64 / self.plan.rate_hz()).unwrap_or(Duration::MAX)
    }
}

impl FrameSource for Simulator {
    fn next(&mut self, patience: Duration) -> Next {
        let elapsed = self.began.elapsed();
        let left = self.due(self.next).saturating_sub(elapsed);
        if left > patience {
            std::thread::sleep(patience);
            return Next::Nothing;
        }
        std::thread::sleep(left);
        let latest = (self.began.elapsed().as_secs_f64() * self.plan.rate_hz()) as u64;
        let index = latest.max(self.next);
        let passed_over = self.next.max(index.saturating_sub(MOST_CAUGHT_UP))..index;
        let mut claims: Vec<Claim> = passed_over.flat_map(|k| self.plan.claims(k)).collect();
        self.next = index + 1;
        let made = self.plan.frame(index);
        claims.extend(made.claims);
        Next::Frame(made.frame, claims)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn simulator() -> Simulator {
        let camera = Scene::builtin().optics.camera().unwrap();
        let config = Config {
            start: Some("2026-11-21T08:00:00Z".parse().unwrap()),
            ..Config::default()
        };
        Simulator::open(&config, &camera).unwrap()
    }

    fn frame(next: Next) -> (crate::frame::Frame, Vec<Claim>) {
        match next {
            Next::Frame(frame, claims) => (frame, claims),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn frames_come_at_the_scene_s_rate_and_not_before() {
        let mut source = simulator();
        assert_eq!(frame(source.next(Duration::ZERO)).0.index, 0);
        assert!(matches!(source.next(Duration::ZERO), Next::Nothing));
        let (second, _) = frame(source.next(Duration::from_secs(60)));
        assert!(source.began.elapsed() >= source.due(second.index));
        assert_eq!(second.time, source.plan.time(second.index));
    }

    #[test]
    fn a_late_reader_gets_the_latest_frame_and_no_backlog_but_every_claim() {
        let mut source = simulator();
        let skipped = 50;
        source.began = Instant::now()
            .checked_sub(source.due(skipped))
            .expect("a clock that started earlier");
        let (late, claims) = frame(source.next(Duration::ZERO));
        assert!(late.index >= skipped);
        let all: Vec<Claim> = (0..=late.index).flat_map(|k| source.plan.claims(k)).collect();
        assert!(!all.is_empty());
        assert_eq!(claims, all);
    }

    #[test]
    fn a_scene_of_another_array_is_refused() {
        let mut camera = Scene::builtin().optics.camera().unwrap();
        camera.x.n += 1;
        assert!(matches!(
            Simulator::open(&Config::default(), &camera),
            Err(Error::SceneShape { .. })
        ));
    }
}
