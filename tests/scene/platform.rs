//! A platform that moves: what its camera sees, and what its autopilot says.

use oapwatch::geo::Sight;
use oapwatch::pose::{Mount, Pose, rotation_between};
use oapwatch::scene::Plan;

use super::plan;

/// One bright user far from the middle, no noise.
const LONE_USER: &str =
    "rate_hz = 10.0\n[link]\nintegration_time_s = 0.1\n[[user]]\nname = \"u\"\nmotion.still = [40, -25]\n";
const MOVING: &str = "[platform]\nmount = { roll_deg = 2, pitch_deg = -3, yaw_deg = 90 }\nheading_deg = 30\nyaw_rate_deg_s = 2.0\n\
    velocity_m_s = [1.0, -0.5, 0.3]\nsway = { amplitude_deg = [4, 3], period_s = [8, 9] }\norbit = { radius_m = 5, period_s = 40 }\n";

/// The middle of the light in frame `k`, on the sensor, m.
fn middle_m(plan: &Plan, k: u64) -> [f64; 2] {
    let pixels = plan.frame(k).frame.pixels;
    let camera = plan.camera();
    let total = pixels.sum();
    let mut middle = [0.0; 2];
    for ((j, i), energy) in pixels.indexed_iter() {
        middle[0] += energy / total * camera.x.centre(i);
        middle[1] += energy / total * camera.y.centre(j);
    }
    middle
}

/// The pose that is stated for the time of frame `k`.
fn stated(plan: &Plan, k: u64) -> Pose {
    let poses = plan.poses(k);
    poses.last().expect("fifty poses a second").clone()
}

#[test]
fn a_beam_falls_where_the_pose_s_sight_has_it() {
    let plan = plan(&format!("{LONE_USER}{MOVING}"));
    let mount = Mount {
        roll_deg: 2.0,
        pitch_deg: -3.0,
        yaw_deg: 90.0,
    };
    for k in [0, 13, 77, 250] {
        let frame = plan.frame(k);
        assert!(frame.truth.emitters[0].in_view, "{k}");
        let pose = stated(&plan, k);
        assert_eq!(pose.time, frame.frame.time);
        let ground = Sight::new(&pose, &mount).ground(plan.camera(), middle_m(&plan, k));
        let [x, y] = ground.expect("the ray goes down").horizontal_m().into();
        // The middle of pixels half a spot wide is the spot's to a hundredth of a pixel, 0.04 m on the ground.
        assert!((x - 40.0).hypot(y + 25.0) < 0.05, "{k}: {x} {y}");
    }
}

#[test]
fn what_a_moving_camera_does_not_see_is_not_in_view() {
    let turned_away = format!("{LONE_USER}[platform]\nmount = {{ roll_deg = 80, pitch_deg = 0, yaw_deg = 0 }}\n");
    let plan = plan(&turned_away);
    let frame = plan.frame(0);
    assert!(!frame.truth.emitters[0].in_view);
    assert_eq!(frame.frame.pixels.sum(), 0.0);
}

#[test]
fn a_level_platform_that_rests_is_the_fixed_one() {
    let fixed = plan(LONE_USER);
    let resting = plan(&format!("{LONE_USER}[platform]\n"));
    let [a, b] = [&fixed, &resting].map(|plan| plan.frame(3).frame.pixels);
    let largest = a.iter().fold(0.0, |m: f64, v| m.max(*v));
    for (a, b) in a.iter().zip(&b) {
        assert!((a - b).abs() < 1e-12 * largest, "{a} {b}");
    }
    assert!(fixed.poses(0).is_empty() && !resting.poses(0).is_empty());
}

#[test]
fn an_exposure_smears_what_turns_within_it_where_the_scene_calls_for_it() {
    let fast = format!("{LONE_USER}[platform]\nyaw_rate_deg_s = 90.0\n");
    let width = |text: &str| {
        let plan = plan(text);
        let [x, y] = middle_m(&plan, 0);
        let pixels = plan.frame(0).frame.pixels;
        let camera = plan.camera();
        let squares = pixels.indexed_iter().map(|((j, i), e)| {
            let (dx, dy) = (camera.x.centre(i) - x, camera.y.centre(j) - y);
            e * (dx * dx + dy * dy)
        });
        squares.sum::<f64>() / pixels.sum()
    };
    let sharp = width(&fast);
    let smeared = width(&format!("{fast}[effects]\nmotion_blur = {{}}\n"));
    // 9° in the exposure at a distance of 5.66 mm from the middle: 0.89 mm of even light, of variance 0.89²/12 mm².
    let expected = (9f64.to_radians() * 0.036 * 40f64.hypot(25.0) / 300.0).powi(2) / 12.0;
    assert!(
        ((smeared - sharp) / expected - 1.0).abs() < 0.02,
        "{} {expected}",
        smeared - sharp
    );
}

#[test]
fn an_autopilot_is_wrong_late_and_silent_as_the_scene_says() {
    let told = format!(
        "{LONE_USER}{MOVING}[platform.telemetry]\nrate_hz = 20\nattitude_noise_rad = 1e-3\nposition_noise_m = 0.1\n\
         attitude_bias_rad = [0.01, 0, 0.02]\nposition_bias_m = [1, 2, 3]\ndelay_s = 0.04\n\
         lost = {{ from_s = 10, until_s = 12 }}\ndragged = {{ from_s = 20, velocity_m_s = [1, 0] }}\n"
    );
    let (right, wrong) = (plan(&format!("{LONE_USER}{MOVING}")), plan(&told));
    assert_eq!(wrong.poses(0).len(), 10);
    assert_eq!(wrong.poses(1).len(), 2);
    assert!(wrong.poses(105).is_empty() && !wrong.poses(121).is_empty());
    assert_eq!(wrong.poses_after(300).len(), 10);
    let (mut turns, mut moves) = ([0.0; 3], [0.0; 3]);
    let count = 40.0;
    for k in 50..90 {
        let (truth, said) = (stated(&right, k), stated(&wrong, k));
        let late = said.time.duration_since(truth.time);
        assert!((late.as_secs_f64() - 0.04).abs() < 1e-9, "{late}");
        let turn = rotation_between(&truth.attitude, &said.attitude);
        for axis in 0..3 {
            turns[axis] += turn[axis] / count;
            moves[axis] += (said.position_m[axis] - truth.position_m[axis]) / count;
        }
    }
    // Five standard deviations of a mean of forty.
    for (axis, bias) in [0.01, 0.0, 0.02].into_iter().enumerate() {
        assert!((turns[axis] - bias).abs() < 8e-4, "{turns:?}");
        assert!((moves[axis] - 1.0 - axis as f64).abs() < 0.08, "{moves:?}");
    }
    let dragged = stated(&wrong, 300).position_m[0] - stated(&right, 300).position_m[0];
    assert!((dragged - 11.0).abs() < 0.5, "{dragged}");
}

#[test]
fn a_flight_log_moves_the_platform() {
    let log = |name: &str, start_s: f64| {
        let file = format!("{}/tests/data/px4/{name}.ulg", env!("CARGO_MANIFEST_DIR"));
        format!("{LONE_USER}[platform]\nlog = {{ file = {file:?}, start_s = {start_s} }}\n")
    };
    // An airframe that sways on the ground: a log without places.
    let swaying = plan(&log("sway", 5.0));
    let attitudes: Vec<Pose> = (0..300).map(|k| stated(&swaying, k)).collect();
    let places: Vec<[f64; 3]> = attitudes.iter().map(|p| p.position_m).collect();
    assert!(places.iter().all(|p| *p == [0.0, 0.0, 300.0]), "{places:?}");
    let tilts = attitudes.iter().map(|p| p.euler_rad()[0].to_degrees());
    let (low, high) = tilts.fold((f64::MAX, f64::MIN), |(l, h), t| (l.min(t), h.max(t)));
    assert!(high - low > 2.0, "{low} to {high}");
    let hovering = plan(&log("hover", 2.0));
    assert!(stated(&hovering, 0).position_m.map(|v| v.round()) == [0.0, 0.0, 300.0]);
    let there = stated(&hovering, 100).position_m;
    assert!(
        there[0].hypot(there[1]) > 0.02 && (there[2] - 300.0).abs() < 5.0,
        "{there:?}"
    );
    let error = Plan::compile(&super::scene(&log("hover", 500.0)), 0)
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("platform.log.start_s: expected less than the log's"),
        "{error}"
    );
    let error = Plan::compile(&super::scene(&log("missing", 0.0)), 0)
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("platform.log.file: expected a flight log of PX4"),
        "{error}"
    );
}
