//! The estimator `sequence` from outside: walks with fading, newcomers, people who leave, turn or stop, and a clock that jumps.

use jiff::{SignedDuration, Timestamp};
use ndarray::Array2;
use oapwatch::estimate::{Config, Estimate, Estimator, Rules, build};
use oapwatch::frame::Frame;
use oapwatch::optics::{self, Camera, add_spot};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::frames::{estimator, frame};

const MEAN_ENERGY_J: f64 = 7e-3;
const RATE_HZ: f64 = 10.0;

/// Where somebody is at a time, s; nowhere while dark.
type Walk = fn(f64) -> Option<[f64; 2]>;

/// Frames of people who walk and whose beams fade independently: exponentially distributed energies.
struct Scene {
    camera: Camera,
    walks: Vec<Walk>,
    rng: ChaCha8Rng,
    next: u64,
    /// Of the next frame, and from it to the one after.
    time_s: f64,
    step_s: f64,
}

impl Scene {
    fn new(sigma_m: f64, walks: &[Walk]) -> Self {
        let config = optics::Config {
            spot_sigma_m: Some(sigma_m),
            pixels: [32; 2],
            noise_std_j: 1e-6,
            ..Default::default()
        };
        Self {
            camera: config.camera().expect("a camera"),
            walks: walks.to_vec(),
            rng: ChaCha8Rng::seed_from_u64(5),
            next: 0,
            time_s: 0.0,
            step_s: 1.0 / RATE_HZ,
        }
    }

    fn estimator(&self) -> Box<dyn Estimator> {
        estimator(Some("sequence"), &self.camera)
    }

    /// Those who shine at the newest frame.
    fn truth(&self) -> Vec<[f64; 2]> {
        let last_s = self.time_s - self.step_s;
        self.walks.iter().filter_map(|walk| walk(last_s)).collect()
    }

    fn frame(&mut self) -> Frame {
        let time_s = self.time_s;
        let noise = Normal::new(0.0, self.camera.noise_std_j).expect("noise is positive and finite");
        let mut pixels = Array2::from_shape_simple_fn(self.camera.shape(), || noise.sample(&mut self.rng));
        let buffer = pixels.as_slice_mut().expect("a fresh array is contiguous");
        for at in self.walks.iter().filter_map(|walk| walk(time_s)) {
            let energy_j = -MEAN_ENERGY_J * (1.0 - self.rng.random::<f64>()).ln();
            add_spot(&self.camera, self.camera.to_sensor(at), energy_j, buffer);
        }
        self.next += 1;
        self.time_s += self.step_s;
        Frame {
            index: self.next - 1,
            time: Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(time_s),
            ..frame(pixels)
        }
    }

    /// The answer to the last of so many frames.
    fn run(&mut self, estimator: &mut dyn Estimator, frames: usize) -> Estimate {
        let answers = (0..frames).map(|_| estimator.estimate(&self.frame()).expect("a usable frame"));
        answers.last().expect("a frame")
    }
}

/// Distance of each true position to the nearest emitter, m.
fn misses(truth: &[[f64; 2]], found: &Estimate) -> Vec<f64> {
    let nearest = |p: &[f64; 2]| {
        let all = found.emitters.iter().map(|e| (p[0] - e.x_m).hypot(p[1] - e.y_m));
        all.fold(f64::INFINITY, f64::min)
    };
    truth.iter().map(nearest).collect()
}

#[test]
fn frames_together_separate_what_no_frame_can() {
    // σ is 33 m on the ground: a pair 12 m apart is one spot, and a frame's bound on it is many metres.
    let walks: [Walk; 3] = [
        |t| Some([-20.0 + 0.8 * t, 10.0]),
        |t| Some([-8.0 + 0.5 * t, 10.0 - 0.4 * t]),
        |_| Some([60.0, -50.0]),
    ];
    let mut scene = Scene::new(4e-3, &walks);
    let mut together = scene.estimator();
    let found = scene.run(&mut *together, 60);
    assert_eq!(found.emitters.len(), 3, "{:?}", found.emitters);
    for (truth, miss) in scene.truth().iter().zip(misses(&scene.truth(), &found)) {
        assert!(miss < 2.0, "{truth:?} is missed by {miss} m");
    }
    let velocity = found.emitters.iter().map(|e| e.velocity.expect("it is followed"));
    let fastest = velocity.map(|v| v.vx_m_s.hypot(v.vy_m_s)).fold(0.0, f64::max);
    assert!((0.4..1.4).contains(&fastest), "{fastest} m/s");
}

#[test]
fn who_comes_is_seen_at_once_and_who_goes_is_gone_within_a_second() {
    let walks: [Walk; 3] = [
        |t| Some([-60.0 + t, 20.0]),
        |t| (t >= 2.0).then_some([50.0, 50.0]),
        |t| (t < 4.0).then_some([20.0, -70.0]),
    ];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    assert_eq!(scene.run(&mut *together, 20).emitters.len(), 2);
    assert_eq!(scene.run(&mut *together, 1).emitters.len(), 3);
    assert_eq!(scene.run(&mut *together, 19).emitters.len(), 3);
    let found = scene.run(&mut *together, 10);
    assert_eq!(found.emitters.len(), 2);
    assert!(misses(&scene.truth(), &found).iter().all(|m| *m < 0.1));
}

#[test]
fn who_turns_round_or_stops_is_followed() {
    let walks: [Walk; 2] = [
        |t| Some([20.0 - (t - 3.0).abs(), 20.0]),
        |t| Some([-50.0 + 1.4 * t.min(3.0), -20.0]),
    ];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    scene.run(&mut *together, 30);
    for _ in 0..30 {
        let found = scene.run(&mut *together, 1);
        assert_eq!(found.emitters.len(), 2);
        let misses = misses(&scene.truth(), &found);
        assert!(misses.iter().all(|m| *m < 0.3), "{misses:?} at frame {}", scene.next);
    }
}

#[test]
fn noise_is_no_newcomer_that_stays() {
    let walks: [Walk; 4] = [
        |t| Some([-60.0 + t, 20.0]),
        |t| Some([50.0, 50.0 - t]),
        |_| Some([20.0, -70.0]),
        |t| Some([-70.0 - t, -60.0]),
    ];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    let counts: Vec<usize> = (0..200).map(|_| scene.run(&mut *together, 1).emitters.len()).collect();
    let wrong = counts.iter().filter(|n| **n != 4).count();
    assert!(wrong <= 2, "{counts:?}");
}

#[test]
fn a_clock_that_jumps_ends_the_memory() {
    let walks: [Walk; 1] = [|t| Some([t, 0.0])];
    let mut scene = Scene::new(1e-3, &walks);
    let mut used = scene.estimator();
    scene.run(&mut *used, 10);
    let mut late = scene.frame();
    late.time = Timestamp::UNIX_EPOCH - SignedDuration::from_secs(5);
    let place = |e: &Estimate| e.emitters.iter().map(|e| [e.x_m, e.y_m]).collect::<Vec<_>>();
    let found = place(&used.estimate(&late).expect("a usable frame"));
    let mut new = scene.estimator();
    assert_eq!(found, place(&new.estimate(&late).expect("a usable frame")));
}

#[test]
fn who_bends_their_way_is_one_emitter() {
    // A circle of 15 m at 1.1 m/s, and a corner.
    let walks: [Walk; 2] = [
        |t| Some([-40.0 + 15.0 * (0.075 * t).cos(), 40.0 + 15.0 * (0.075 * t).sin()]),
        |t| {
            Some(if t < 20.0 {
                [60.0, -60.0 + 1.4 * t]
            } else {
                [60.0 - 1.4 * (t - 20.0), -32.0]
            })
        },
    ];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    let mut extra = 0;
    for _ in 0..400 {
        extra += together
            .estimate(&scene.frame())
            .expect("a usable frame")
            .emitters
            .len()
            .saturating_sub(2);
    }
    // A bend may pass for a newcomer for some frames, but not for good.
    assert!(extra <= 12, "{extra} emitters too many in 400 frames");
}

#[test]
fn nobody_is_born_of_the_noise_of_many_frames() {
    let mut scene = Scene::new(1e-3, &[]);
    let mut together = scene.estimator();
    let counts = (0..1500).map(|_| {
        together
            .estimate(&scene.frame())
            .expect("a usable frame")
            .emitters
            .len()
    });
    let frames = counts.filter(|count| *count > 0).count();
    // What a lone frame takes for an emitter, one in a thousand, is dropped within some twenty.
    assert!(frames <= 75, "{frames} of 1500 dark frames hold somebody");
}

#[test]
fn two_who_cross_are_two_again() {
    let walks: [Walk; 2] = [|t| Some([-20.0 + t, 0.0]), |t| Some([20.0 - t, 1.5])];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    let counts: Vec<usize> = (0..400).map(|_| scene.run(&mut *together, 1).emitters.len()).collect();
    let wrong = counts.iter().filter(|n| **n != 2).count();
    assert!(wrong <= 4, "{wrong} of 400 frames: {counts:?}");
    let found = scene.run(&mut *together, 1);
    let misses = misses(&scene.truth(), &found);
    assert!(misses.iter().all(|m| *m < 0.1), "{misses:?}");
}

#[test]
fn when_all_fade_at_once_nobody_is_invented_and_all_come_back() {
    let walks: [Walk; 3] = [
        |t| (!(3.95..4.95).contains(&t)).then_some([-50.0 + t, 20.0]),
        |t| (!(3.95..4.95).contains(&t)).then_some([50.0, 40.0 - t]),
        |t| (!(3.95..4.95).contains(&t)).then_some([0.0, -60.0]),
    ];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    scene.run(&mut *together, 40);
    for _ in 0..10 {
        assert!(scene.run(&mut *together, 1).emitters.len() <= 3);
    }
    let found = scene.run(&mut *together, 1);
    assert_eq!(found.emitters.len(), 3);
    let found = scene.run(&mut *together, 4);
    let misses = misses(&scene.truth(), &found);
    assert!(misses.iter().all(|m| *m < 0.3), "{misses:?}");
}

#[test]
fn frames_that_are_missing_and_another_rate_change_nothing() {
    let walks: [Walk; 2] = [|t| Some([-60.0 + t, 20.0]), |t| Some([50.0, 40.0 - 0.5 * t])];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    scene.run(&mut *together, 30);
    scene.time_s += 2.5;
    for step_s in [0.1, 0.01, 0.5, 0.1] {
        scene.step_s = step_s;
        for _ in 0..40 {
            let found = scene.run(&mut *together, 1);
            assert_eq!(found.emitters.len(), 2, "at {} s", scene.time_s);
            let misses = misses(&scene.truth(), &found);
            assert!(misses.iter().all(|m| *m < 0.2), "{misses:?} at {} s", scene.time_s);
        }
    }
}

#[test]
fn a_car_that_turns_at_five_metres_per_second_squared_is_followed() {
    // 10 m/s on a circle of 20 m, from the third second on.
    let walks: [Walk; 1] = [|t| {
        let angle = 0.5 * (t - 3.0).max(0.0);
        Some([
            10.0 * t.min(3.0) - 40.0 + 20.0 * angle.sin(),
            20.0 * (1.0 - angle.cos()) - 20.0,
        ])
    }];
    let mut scene = Scene::new(1e-3, &walks);
    let mut together = scene.estimator();
    scene.run(&mut *together, 20);
    let (mut extra, mut worst) = (0, 0.0_f64);
    for _ in 0..100 {
        let found = scene.run(&mut *together, 1);
        extra += found.emitters.len() - 1;
        worst = worst.max(misses(&scene.truth(), &found)[0]);
    }
    assert!(extra <= 3 && worst < 0.6, "{extra} too many, {worst} m off");
}

#[test]
fn a_hundred_thousand_frames_leave_the_numerics_as_they_were() {
    let walks: [Walk; 2] = [
        |_| Some([-20.0, 10.0]),
        |t| Some([30.0 + 5.0 * (0.01 * t).sin(), -20.0]),
    ];
    let mut scene = Scene::new(2e-3, &walks);
    let mut together = scene.estimator();
    let mut first = None;
    for thousand in 1..=100 {
        scene.run(&mut *together, 990);
        let mut misses = Vec::new();
        // Noise that hints at a turn widens single frames' covariance.
        let mut variance = f64::INFINITY;
        for _ in 0..10 {
            let found = scene.run(&mut *together, 1);
            assert_eq!(found.emitters.len(), 2, "after {thousand},000 frames");
            for emitter in &found.emitters {
                let [[xx, xy], [yx, yy]] = emitter.cov_m2;
                assert!(xx > 0.0 && xx * yy > xy * xy && xy == yx, "{:?}", emitter.cov_m2);
            }
            let still = found.emitters.iter().find(|e| e.x_m < 0.0).expect("who stands");
            variance = variance.min(still.cov_m2[0][0] + still.cov_m2[1][1]);
            misses = self::misses(&scene.truth(), &found);
        }
        let at_first = *first.get_or_insert(variance);
        assert!(
            (0.25..4.0).contains(&(variance / at_first)),
            "{variance} m² after {at_first}"
        );
        assert!(
            misses[0].powi(2) < 16.0 * variance && misses[1] < 0.5,
            "{misses:?} with {variance} m² after {thousand},000 frames"
        );
    }
}

#[test]
fn spots_a_little_wider_than_configured_are_no_pairs() {
    let walks: [Walk; 3] = [
        |t| Some([-80.0 + t, -60.0]),
        |_| Some([10.0, 70.0]),
        |t| Some([80.0, t]),
    ];
    let wrong = |rules: Rules| {
        let mut scene = Scene::new(1.5e-3, &walks);
        let mut configured = scene.camera.clone();
        configured.spot_sigma_m *= 0.98;
        let config = Config {
            name: Some("sequence".into()),
            rules,
            ..Default::default()
        };
        let mut sequence = build(&config, &configured).expect("a known estimator");
        let numbers = (0..100).map(|_| {
            sequence
                .estimate(&scene.frame())
                .expect("a usable frame")
                .emitters
                .len()
        });
        numbers.skip(20).filter(|n| *n > walks.len()).count()
    };
    let (with, without) = (
        wrong(Rules::default()),
        wrong(Rules::without("learn_width").expect("a rule")),
    );
    assert!(with == 0 && without > 20, "{with} and {without} of 80 frames");
}
