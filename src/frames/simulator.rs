//! The simulator as a source: gives frames at the scene's rate on the wall clock and skips those that it cannot make in time.

use std::time::{Duration, Instant};

use jiff::Timestamp;

use super::{Arrivals, Config, Error, FrameSource, Next};
use crate::metric;
use crate::optics::Camera;
use crate::scene::{Fate, Plan, Scene};

/// Most skipped frames whose claims are still delivered, for a machine that was suspended.
const MOST_CAUGHT_UP: u64 = 10_000;
/// Without a frame for this long (two intervals of a slower scene) the source reports an unusable frame, and again after as long.
const SILENCE: Duration = Duration::from_secs(1);

/// Frames of a scene. Frame k is exposed at start + k/rate. A frame that is late by a whole interval is skipped; one that the
/// scene drops never arrives, and its claims come with the next. One that the scene repeats has its own number and time and the
/// pixels of the last delivered frame.
pub struct Simulator {
    plan: Plan,
    began: Instant,
    next: u64,
    /// Claims and poses of frames that did not arrive.
    waiting: Arrivals,
    /// The frame after the last one that arrived or was reported missing.
    unreported: u64,
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
            waiting: Arrivals::default(),
            unreported: 0,
        })
    }

    fn due(&self, k: u64) -> Duration {
        Duration::try_from_secs_f64(k as f64 / self.plan.rate_hz()).unwrap_or(Duration::MAX)
    }

    /// Frame `index` was lost: a gap in the numbers, as with a device.
    fn lost(&mut self, index: u64) -> Next {
        metrics::counter!(metric::SOURCE_FRAMES_LOST).increment(1);
        let silent = self.due(self.next - self.unreported);
        if silent < SILENCE.max(self.due(2)) {
            return Next::Nothing;
        }
        self.unreported = self.next;
        Next::Unusable {
            index,
            time: self.plan.time(index),
            reason: format!("no frame for {:.0} s", silent.as_secs_f64()),
            arrivals: std::mem::take(&mut self.waiting),
        }
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
        for k in passed_over {
            self.waiting.append(Arrivals {
                claims: self.plan.claims(k),
                poses: self.plan.poses(k),
            });
        }
        self.next = index + 1;
        let made = self.plan.frame(index);
        self.waiting.append(Arrivals {
            claims: made.claims,
            poses: made.poses,
        });
        if made.fate == Fate::Dropped {
            return self.lost(index);
        }
        self.unreported = self.next;
        Next::Frame(made.frame, std::mem::take(&mut self.waiting))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claim::Claim;
    use crate::scene::FrameLoss;

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
            Next::Frame(frame, arrivals) => (frame, arrivals.claims),
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

    /// Events of the scene's first `count` frames, each asked for when it is due.
    fn arrivals(frame_loss: FrameLoss, count: u64) -> (Plan, Vec<Next>) {
        let mut scene = Scene::builtin();
        scene.rate_hz = 1.0;
        scene.effects.frame_loss = Some(frame_loss);
        let mut source = Simulator {
            plan: Plan::compile(&scene, 3).unwrap(),
            began: Instant::now(),
            next: 0,
            waiting: Arrivals::default(),
            unreported: 0,
        };
        let mut came = Vec::new();
        for k in 0..count {
            // Half an interval, 0.5 s, after frame k was due: tolerance for a busy host.
            source.began = Instant::now()
                .checked_sub(source.due(k) + source.due(1) / 2)
                .expect("a clock that started earlier");
            came.push(source.next(Duration::ZERO));
        }
        (source.plan, came)
    }

    #[test]
    fn dropped_frames_leave_a_gap_repeated_ones_come_again_and_no_claim_is_lost() {
        let loss = FrameLoss {
            dropped: 0.3,
            repeated: 0.3,
        };
        let (plan, came) = arrivals(loss, 60);
        let fate = |k| plan.frame(k).fate;
        for wanted in [Fate::Delivered, Fate::Dropped, Fate::Repeated] {
            assert!((0..60).filter(|k| fate(*k) == wanted).count() > 5, "{wanted:?}");
        }
        let mut last: Option<crate::frame::Frame> = None;
        let mut received = Vec::new();
        let mut until = 0;
        for next in came {
            let (frame, claims) = match next {
                Next::Frame(frame, arrivals) => (frame, arrivals.claims),
                Next::Unusable { index, arrivals, .. } => {
                    assert_eq!(fate(index), Fate::Dropped);
                    received.extend(arrivals.claims);
                    until = index;
                    continue;
                }
                Next::Nothing => continue,
                Next::End => panic!("a simulator has no end"),
            };
            assert_ne!(fate(frame.index), Fate::Dropped);
            assert!(frame.pixels.iter().all(|p| p.is_finite()));
            assert_eq!(frame.time, plan.time(frame.index));
            if let Some(last) = &last {
                assert!(frame.index > last.index);
                let between = last.index + 1..frame.index;
                let is_repeated = fate(frame.index) == Fate::Repeated;
                if between.clone().all(|k| fate(k) != Fate::Delivered) {
                    assert_eq!(frame.digest() == last.digest(), is_repeated, "frame {}", frame.index);
                }
            }
            received.extend(claims);
            until = frame.index;
            last = Some(frame);
        }
        let all: Vec<Claim> = (0..=until).flat_map(|k| plan.claims(k)).collect();
        assert_eq!(received, all);
    }

    #[test]
    fn missing_frames_are_reported() {
        let loss = FrameLoss {
            dropped: 1.0 - 1e-12,
            repeated: 0.0,
        };
        let (_, came) = arrivals(loss, 7);
        let reported: Vec<u64> = came
            .iter()
            .filter_map(|next| match next {
                Next::Unusable { index, reason, .. } => {
                    assert_eq!(reason, "no frame for 2 s");
                    Some(*index)
                }
                other => {
                    assert!(matches!(other, Next::Nothing), "{other:?}");
                    None
                }
            })
            .collect();
        // Two intervals of one second.
        assert_eq!(reported, [1, 3, 5]);
    }

    #[test]
    fn frames_come_at_the_scene_s_rate_whatever_the_config_says() {
        let config = Config {
            rate_hz: Some(25.0),
            ..Config::default()
        };
        let scene = Scene::builtin();
        assert_ne!(scene.rate_hz, 25.0);
        assert_eq!(config.frame_rate_hz().unwrap(), scene.rate_hz);
        assert!(Simulator::open(&config, &scene.optics.camera().unwrap()).is_ok());
        assert_eq!(config.unused(["rate_hz", "scene"].into_iter()), ["rate_hz"]);
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
