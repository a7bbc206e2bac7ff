//! Lenses whose spots differ from the PSF, as frame after frame shows them.

use oapwatch::estimate::{Config, Emitter, Estimate, Estimator, Rules, build};
use oapwatch::optics::Camera;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::frames::{estimator, frame, places};
use crate::lens::{FIVE, SIGMA_M, camera, moffat, render_density};

fn with_rules(rules: Rules, camera: &Camera) -> Box<dyn Estimator> {
    let config = Config {
        rules,
        ..Default::default()
    };
    build(&config, camera).unwrap()
}

/// A round spot, and its reflection of 2 % beside it.
fn ghost(x: f64, y: f64) -> f64 {
    let spot = |x: f64, y: f64| (-0.5 * (x * x + y * y) / (SIGMA_M * SIGMA_M)).exp();
    spot(x, y) + 0.02 * spot(x - 4.3e-3, y + 2.9e-3)
}

/// A round spot that astigmatism of 45° has made 40 % longer than wide.
fn elongated(x: f64, y: f64) -> f64 {
    let [a, b] = [x + y, x - y].map(|d| d / (2f64.sqrt() * SIGMA_M));
    (-0.5 * ((a / 1.19).powi(2) + (b / 0.85).powi(2))).exp()
}

#[test]
fn spots_apart_teach_the_widths_of_those_that_overlap() {
    let camera = camera();
    let mut rng = ChaCha8Rng::seed_from_u64(30);
    let draw = |spots: &[([f64; 2], f64)], rng: &mut ChaCha8Rng| frame(render_density(&camera, &elongated, spots, rng));
    let mut experienced = estimator(None, &camera);
    let apart = draw(&FIVE.map(|at| (at, 1000.0)), &mut rng);
    assert_eq!(experienced.estimate(&apart).unwrap().emitters.len(), 5);
    let (mut alone, mut told, frames) = (0, 0, 6);
    for _ in 0..frames {
        let pairs = [FIVE[0], FIVE[1], FIVE[3]].map(|at| {
            let (sin, cos) = rng.random_range(0.0..std::f64::consts::PI).sin_cos();
            [-1e-3, 1e-3].map(|d| (([at[0] + d * cos, at[1] + d * sin]), 1000.0))
        });
        let frame = draw(pairs.as_flattened(), &mut rng);
        let is_right = |estimate: Estimate| u32::from(estimate.emitters.len() == 6);
        alone += is_right(estimator(None, &camera).estimate(&frame).unwrap());
        told += is_right(experienced.estimate(&frame).unwrap());
    }
    assert!(told == frames && alone < frames / 2, "{told} and {alone} of {frames}");
}

#[test]
fn frames_of_many_spots_teach_the_lens_that_a_frame_of_two_hides() {
    let camera = camera();
    let mut rng = ChaCha8Rng::seed_from_u64(27);
    let mut draw = |places: &[[f64; 2]]| {
        let spots: Vec<_> = places.iter().map(|at| (*at, 300.0)).collect();
        frame(render_density(&camera, &ghost, &spots, &mut rng))
    };
    let (many, two) = (draw(&FIVE), draw(&FIVE[..2]));
    let alone = estimator(None, &camera).estimate(&two).unwrap();
    assert_eq!(alone.emitters.len(), 4, "two spots and their ghosts may be four users");
    let mut experienced = estimator(None, &camera);
    assert_eq!(experienced.estimate(&many).unwrap().emitters.len(), 5);
    let estimate = experienced.estimate(&two).unwrap();
    assert_eq!(estimate.emitters.len(), 2, "{:?}", places(&estimate));
    assert!(estimate.spot_error > 0.0);
}

#[test]
fn a_lens_that_most_frames_do_not_show_hides_no_user() {
    let camera = camera();
    let mut rng = ChaCha8Rng::seed_from_u64(28);
    let mut ml = estimator(None, &camera);
    let lens = frame(render_density(&camera, &ghost, &FIVE.map(|at| (at, 300.0)), &mut rng));
    assert!(ml.estimate(&lens).unwrap().spot_error > 0.0);
    let mut spots: Vec<_> = FIVE.map(|at| (at, 300.0)).into();
    spots.push((FIVE[2].map(|v| v + 3e-3), 5.0));
    let stranger = frame(render_density(&camera, &gaussian, &spots, &mut rng));
    ml.estimate(&stranger).unwrap();
    let estimate = ml.estimate(&stranger).unwrap();
    assert_eq!(estimate.emitters.len(), 6, "{:?}", places(&estimate));
    assert_eq!(estimate.spot_error, 0.0);
}

/// The numbers of emitters of the later half of so many frames through `spot`, in turns.
fn later_numbers(rules: Rules, spot: &dyn Fn(f64, f64) -> f64, spots: &[([f64; 2], f64)]) -> Vec<usize> {
    let camera = camera();
    let mut ml = with_rules(rules, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(31);
    let mut count = |_| {
        let frame = frame(render_density(&camera, &spot, spots, &mut rng));
        ml.estimate(&frame).unwrap().emitters.len()
    };
    (0..200).map(&mut count).skip(100).collect()
}

#[test]
fn a_width_that_is_off_by_a_percent_makes_no_pairs() {
    let wider = |x: f64, y: f64| gaussian(x / 1.01, y / 1.01);
    for users in [&FIVE[2..3], &FIVE] {
        let spots: Vec<_> = users.iter().map(|at| (*at, 140.0)).collect();
        let wrong = |rules: Rules| {
            let numbers = later_numbers(rules, &wider, &spots);
            numbers.iter().filter(|n| **n != users.len()).count()
        };
        let without = Rules {
            width_for_pairs: false,
            stack_misfits: false,
            ..Rules::without("learn_width").unwrap()
        };
        let (with, without) = (wrong(Rules::default()), wrong(without));
        assert!(with <= 2 && without > 20, "{with} and {without} of 100");
    }
}

#[test]
fn axes_that_differ_by_two_percent_make_no_pairs() {
    let elliptical = |x: f64, y: f64| gaussian(x / 1.02, y);
    let spots = FIVE.map(|at| (at, 140.0));
    let wrong = |rules: Rules| {
        let numbers = later_numbers(rules, &elliptical, &spots);
        numbers.iter().filter(|n| **n != 5).count()
    };
    let without = Rules {
        stack_misfits: false,
        ..Rules::without("width_for_pairs").unwrap()
    };
    let (with, without) = (wrong(Rules::default()), wrong(without));
    assert!(with <= 5 && without > 20, "{with} and {without} of 100");
}

#[test]
fn a_beam_beside_one_user_is_no_width() {
    let mut spots: Vec<_> = FIVE.map(|at| (at, 140.0)).into();
    spots.push(([FIVE[2][0] + 0.9e-3, FIVE[2][1] + 0.3e-3], 40.0));
    let numbers = later_numbers(Rules::default(), &gaussian, &spots);
    assert!(numbers.iter().filter(|n| **n == 6).count() >= 98, "{numbers:?}");
}

#[test]
fn a_beam_beside_the_only_user_is_no_width() {
    let spots = [(FIVE[2], 140.0), ([FIVE[2][0] + 0.9e-3, FIVE[2][1] + 0.3e-3], 40.0)];
    let seen = |rules: Rules| {
        let numbers = later_numbers(rules, &gaussian, &spots);
        numbers.iter().filter(|n| **n == 2).count()
    };
    let (with, without) = (seen(Rules::default()), seen(Rules::without("learn_width").unwrap()));
    assert!(with >= 98 && with >= without, "{with} and {without} of 100");
}

#[test]
fn what_is_too_faint_for_a_frame_is_the_lens_s_where_all_frames_show_it() {
    let mut spots: Vec<_> = FIVE.map(|at| (at, 40.0)).into();
    let right = |numbers: &[usize]| numbers.iter().filter(|n| **n == 5).count();
    let without = Rules::without("stack_misfits").unwrap();
    let alone = right(&later_numbers(without, &ghost, &spots));
    let together = right(&later_numbers(Rules::default(), &ghost, &spots));
    assert!(alone < 90 && together == 100, "{alone} and {together} of 100");
    spots.push(([FIVE[2][0] + 4.3e-3, FIVE[2][1] - 2.9e-3], 4.0));
    let with_stranger = later_numbers(Rules::default(), &gaussian, &spots);
    assert!(
        with_stranger.iter().all(|n| *n >= 6),
        "a stranger beside one user is none of the lens's"
    );
}

fn gaussian(x: f64, y: f64) -> f64 {
    (-0.5 * (x * x + y * y) / (SIGMA_M * SIGMA_M)).exp()
}

/// Of eight frames of three pairs 2 σ apart through a halo, after a first one: how many have six emitters, and how many of 48 spots have an emitter
/// whose ellipse holds them.
fn pairs_through_a_halo(rules: Rules) -> (usize, usize) {
    let camera = camera();
    let mut ml = with_rules(rules, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(32);
    let (mut right, mut held) = (0, 0);
    for index in 0..9 {
        let pairs = [FIVE[0], FIVE[1], FIVE[3]].map(|at| {
            let (sin, cos) = rng.random_range(0.0..std::f64::consts::PI).sin_cos();
            [-SIGMA_M, SIGMA_M].map(|d| (([at[0] + d * cos, at[1] + d * sin]), 300.0))
        });
        let spots = pairs.as_flattened();
        let frame = frame(render_density(&camera, &moffat(SIGMA_M), spots, &mut rng));
        let estimate = ml.estimate(&frame).unwrap();
        if index == 0 {
            continue;
        }
        right += usize::from(estimate.emitters.len() == 6);
        let is_held = |place: [f64; 2]| {
            estimate.emitters.iter().any(|e| {
                let [dx, dy] = [e.x_m - place[0], e.y_m - place[1]];
                let [[a, b], [_, c]] = e.cov_m2;
                (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b) < 5.99
            })
        };
        held += spots.iter().filter(|(at, _)| is_held(camera.to_ground(*at))).count();
    }
    (right, held)
}

#[test]
fn a_halo_is_learned_from_pairs_that_overlap() {
    let (right, held) = pairs_through_a_halo(Rules::default());
    assert!(right == 8 && held >= 42, "{right} of 8 frames, {held} of 48 spots");
    let (_, held) = pairs_through_a_halo(Rules::without("learn_spots").unwrap());
    assert!(held < 24, "{held} of 48 spots");
}

#[test]
fn a_spot_that_was_learned_is_learned_anew_after_the_lens_was_focused() {
    let camera = camera();
    let mut ml = estimator(None, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(33);
    let spots = FIVE.map(|at| (at, 300.0));
    let mut shown = |spot: &dyn Fn(f64, f64) -> f64| {
        let estimate = ml
            .estimate(&frame(render_density(&camera, spot, &spots, &mut rng)))
            .unwrap();
        assert_eq!(estimate.emitters.len(), 5, "{:?}", places(&estimate));
        (estimate.spot_error, estimate.reduced_chi2)
    };
    for _ in 0..20 {
        shown(&moffat(SIGMA_M));
    }
    let focused: Vec<_> = (0..20).map(|_| shown(&gaussian)).collect();
    let (error, chi2) = focused[19];
    assert!(error < 2e-3 && (0.7..1.1).contains(&chi2), "{focused:?}");
}

/// Of eight frames of five users through a halo, after so many without: how many show a stranger, of this share of their light, 3 σ beside one of
/// them.
fn strangers_beside_a_user(rules: Rules, before: usize, share: f64) -> usize {
    let camera = camera();
    let mut ml = with_rules(rules, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(34);
    let stranger = [FIVE[2][0] + 3.0 * SIGMA_M, FIVE[2][1]];
    let users = FIVE.map(|at| (at, 300.0));
    let with_stranger = [&users[..], &[(stranger, 300.0 * share)]].concat();
    let mut emitters = |spots: &[([f64; 2], f64)]| {
        let frame = frame(render_density(&camera, &moffat(SIGMA_M), spots, &mut rng));
        ml.estimate(&frame).unwrap().emitters
    };
    for _ in 0..before {
        assert_eq!(emitters(&users).len(), 5);
    }
    let is_near = |e: &Emitter| (e.sensor_m[0] - stranger[0]).hypot(e.sensor_m[1] - stranger[1]) < SIGMA_M;
    let is_seen = |emitters: Vec<Emitter>| emitters.len() == 6 && emitters.iter().any(is_near);
    (0..8).filter(|_| is_seen(emitters(&with_stranger))).count()
}

#[test]
fn a_learned_halo_hides_fewer_strangers() {
    let learned = strangers_beside_a_user(Rules::default(), 4, 0.03);
    let assumed = strangers_beside_a_user(Rules::without("learn_spots").unwrap(), 4, 0.03);
    assert!(learned == 8 && assumed == 0, "{learned} and {assumed} of 8 frames");
}

#[test]
fn a_stranger_who_was_there_first_does_not_keep_a_halo_from_being_learned() {
    assert!(strangers_beside_a_user(Rules::default(), 0, 0.1) >= 7);
}

#[test]
fn spots_that_grow_to_discs_are_no_crowds() {
    for (energy, edge, grown) in [(100.0, 0.07, 1.3), (70.0, 0.24, 1.4)] {
        let camera = camera();
        let mut ml = estimator(None, &camera);
        let mut rng = ChaCha8Rng::seed_from_u64(35);
        let mut number = |size: f64| {
            let disc = |x: f64, y: f64| 1.0 / (1.0 + ((x.hypot(y) / SIGMA_M - 1.6 * size) / edge).exp());
            let spots = FIVE.map(|at| (at.map(|x| x + rng.random_range(-1e-3..1e-3)), energy));
            let frame = frame(render_density(&camera, &disc, &spots, &mut rng));
            ml.estimate(&frame).unwrap().emitters.len()
        };
        let numbers: Vec<_> = (0..24).map(|k| number(if k < 16 { 1.0 } else { grown })).collect();
        assert!(numbers.iter().all(|n| *n == 5), "edge {edge}: {numbers:?}");
    }
}

#[test]
fn a_crowd_is_no_spot() {
    let camera = camera();
    let mut ml = estimator(None, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(36);
    for _ in 0..8 {
        let crowds = [FIVE[0], FIVE[1], FIVE[3]].map(|at| {
            let turn = rng.random_range(0.0..2.0 * std::f64::consts::PI);
            [0.0, 2.1, 4.2].map(|angle: f64| {
                let (sin, cos) = (angle + turn).sin_cos();
                (
                    [at[0] + 1.3 * SIGMA_M * cos, at[1] + 1.3 * SIGMA_M * sin],
                    rng.random_range(200.0..400.0),
                )
            })
        });
        let frame = frame(render_density(&camera, &gaussian, crowds.as_flattened(), &mut rng));
        assert_eq!(ml.estimate(&frame).unwrap().emitters.len(), 9);
    }
}
