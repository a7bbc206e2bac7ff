//! A moving platform's poses at the times of frames, and the delay that is learned.

use nalgebra::UnitQuaternion;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;

/// The delay as learned in a minute of sway, where poses are `late_s` late and their tilt has white noise, rad.
fn learned(late_s: f64, noise_rad: f64) -> (f64, f64) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut noise = || {
        let value: f64 = StandardNormal.sample(&mut rng);
        value * noise_rad
    };
    let camera = crate::optics::Config::default().camera().unwrap();
    let at = |s: f64| Timestamp::UNIX_EPOCH + SignedDuration::from_nanos(((100.0 + s) * 1e9).round() as i64);
    let tilt = |s: f64| [0.05 * (0.785 * s).sin(), 0.05 * (0.63 * s + 1.0).sin()];
    let mut platform = Platform {
        source: Source::Live(PoseInbox::default(), PoseBuffer::default()),
        ..Platform::level()
    };
    // Stamps at 50 Hz that coincide with those of the frames at 10 Hz.
    for k in 0..3000_u32 {
        let s = 0.02 * f64::from(k);
        let [north, east] = tilt(s - late_s);
        let attitude = UnitQuaternion::from_scaled_axis([north + noise(), east + noise(), 0.0].into());
        let pose = Pose {
            attitude,
            ..Pose::level(at(s), [0.0, 0.0, 300.0])
        };
        platform.receive(vec![pose], at(s), &camera);
        // A frame that is seen when the next poses are there.
        let frame_s = s - 0.04;
        if k % 5 == 2 && frame_s > 0.0 {
            let Placement::At { pose, .. } = platform.at(at(frame_s), &camera) else {
                panic!("poses are there");
            };
            let truth = tilt(frame_s);
            let found = pose.pose.attitude.scaled_axis();
            let error = Vector6::new(found.x - truth[0], found.y - truth[1], 0.0, 0.0, 0.0, 0.0);
            platform.learn(&error, &pose);
        }
    }
    (platform.delay_s(), platform.learned.std_s())
}

#[test]
fn a_delay_is_learned_from_poses_with_noise_too() {
    for late_s in [0.0, 0.03] {
        for noise_rad in [0.0, 0.001, 0.003] {
            let (found, std_s) = learned(late_s, noise_rad);
            assert!(
                (found - late_s).abs() < 4.0 * std_s,
                "{late_s} {noise_rad}: {found} ± {std_s}"
            );
            assert!(std_s < 0.005, "{std_s}");
        }
    }
}

#[test]
fn a_pose_that_shows_no_ground_is_refused() {
    let camera = crate::optics::Config::default().camera().unwrap();
    let at = |ms: i64| Timestamp::from_millisecond(ms).unwrap();
    let pose = |ms: i64, roll: f64, height_m: f64| Pose {
        attitude: UnitQuaternion::from_euler_angles(roll, 0.0, 0.0),
        ..Pose::level(at(ms), [0.0, 0.0, height_m])
    };
    // Level, with half of the view above the horizon, upside down, and below the ground.
    for (roll, height_m, is_one) in [
        (0.0, 300.0, true),
        (1.57, 300.0, true),
        (3.1, 300.0, false),
        (0.0, -5.0, false),
    ] {
        let mut platform = Platform {
            source: Source::Live(PoseInbox::default(), PoseBuffer::default()),
            ..Platform::level()
        };
        platform.receive(vec![pose(0, 0.0, 300.0)], at(0), &camera);
        let later = [9_900, 10_000, 10_100].map(|ms| pose(ms, roll, height_m));
        platform.receive(later.into(), at(10_000), &camera);
        // The last that is one holds, the longer the less exactly.
        let Placement::At {
            pose: found, is_lost, ..
        } = platform.at(at(10_000), &camera)
        else {
            panic!("a pose is known");
        };
        assert_eq!(!is_lost, is_one, "{roll} {height_m}");
        assert!(is_one || found.pose.cov[(0, 0)] > 0.01, "{roll} {height_m}");
    }
    let mut platform = Platform {
        source: Source::Fixed(pose(0, 3.1, 300.0)),
        ..Platform::level()
    };
    platform.at(at(0), &camera);
    let placement = platform.at(at(60_000), &camera);
    assert!(matches!(placement, Placement::Unknown { is_lost: true, .. }));
}

#[test]
fn frames_wait_for_poses_that_are_late_and_for_no_others() {
    let camera = crate::optics::Config::default().camera().unwrap();
    let at = |ms: i64| Timestamp::from_millisecond(10_000 + ms).unwrap();
    let mut platform = Platform {
        source: Source::Live(PoseInbox::default(), PoseBuffer::default()),
        ..Platform::level()
    };
    assert!(platform.is_posed(at(0)) && Platform::level().is_posed(at(0)));
    platform.receive(vec![Pose::level(at(0), [0.0, 0.0, 300.0])], at(0), &camera);
    let waits = |ms: i64| !platform.is_posed(at(ms));
    assert!([-50, 0, 99, 1_000, 5_000].iter().all(|ms| !waits(*ms)));
    assert!([100, 300, 999].iter().all(|ms| waits(*ms)));
}
