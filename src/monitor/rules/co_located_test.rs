//! Beams that brighten, are merged into and part again.

use super::*;
use crate::monitor::fixture::{Scene, absent, present};
use crate::monitor::track::association::Association;
use crate::monitor::track::detection::Detection;
use crate::monitor::track::detection::fixture::detection;

const USERS: [[f64; 2]; 4] = [[0.0, 0.0], [80.0, 0.0], [0.0, 80.0], [-80.0, 0.0]];

struct Watch {
    scene: Scene,
    memory: Memory,
}

fn cause(user: usize) -> Cause {
    Cause::CoLocated(format!("u-{user}"))
}

impl Watch {
    /// Four users whose ln energies are known to have been 0 ± 0.3.
    fn new() -> Self {
        let mut memory = Memory::default();
        for k in 0..4 {
            memory.users.entry(&format!("u-{k}")).test = CoLocationTest::remembered(0.0, 0.3);
        }
        let scene = Scene::of_users(&USERS);
        Self { scene, memory }
    }

    fn beams(energies: [f64; 4]) -> Vec<Detection> {
        let of = |([x, y], energy_j): ([f64; 2], f64)| Detection {
            energy_j,
            ..detection(x, y)
        };
        USERS.into_iter().zip(energies).map(of).collect()
    }

    /// The first user's spot is three times as bright, and an alerted stranger stands 5 m off: their beams, and the stranger's track.
    fn beside_a_stranger() -> (Self, Vec<Detection>, u64) {
        let mut watch = Self::new();
        let mut beams = Self::beams([3.0, 1.0, 1.0, 1.0]);
        beams.push(detection(5.0, 0.0));
        watch.scene.detect(&beams);
        let stranger = watch.scene.tracker.tracks.last().expect("a track").id;
        let at = nalgebra::Vector3::new(5.0, 0.0, 0.0);
        let content = Content::new(Severity::Warning, json!({})).at(at, Default::default());
        watch
            .scene
            .apply(vec![Finding::present(Cause::Track(stranger), content)]);
        (watch, beams, stranger)
    }

    fn detect(&mut self, beams: &[Detection]) -> Vec<Finding> {
        self.scene.detect(beams);
        let findings = evaluate(self.scene.context(), &mut self.memory);
        self.scene.apply(findings.clone());
        findings
    }

    /// Frames with these energies until one has a finding, and that finding; at most a hundred.
    fn until_found(&mut self, energies: [f64; 4]) -> Option<(usize, Vec<Finding>)> {
        (0..100).find_map(|k| {
            let findings = self.detect(&Self::beams(energies));
            (!present(&findings).is_empty()).then_some((k, findings))
        })
    }
}

#[test]
fn a_spot_that_becomes_three_times_as_bright_is_two_beams() {
    let mut watch = Watch::new();
    let (frame, findings) = watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
    // No sooner than ten frames, and than claims may take.
    assert!((9..20).contains(&frame), "{frame}");
    assert_eq!(present(&findings), [&cause(0)]);
    let alert = watch.scene.alerts.open().next().unwrap().1;
    assert_eq!(alert.evidence[SHARED_SPOT], "u-0");
    let ratio = alert.evidence["energy_over_the_past"]["ratio"].as_f64().unwrap();
    assert!((ratio - 3.0).abs() < 1e-9, "{ratio}");
    assert_eq!(alert.severity, Severity::Warning);
}

#[test]
fn a_spot_a_third_brighter_or_all_spots_brighter_are_not() {
    assert!(Watch::new().until_found([1.34, 1.0, 1.0, 1.0]).is_none());
    assert!(Watch::new().until_found([3.0, 3.0, 3.0, 3.0]).is_none());
}

#[test]
fn a_verdict_survives_a_frame_that_misses_the_beam_and_ends_with_the_beam() {
    let mut watch = Watch::new();
    watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
    let beams = Watch::beams([3.0, 1.0, 1.0, 1.0]);
    // The association of a beam that was just missed is held, but it cannot be tested: neither present nor absent.
    watch.scene.detect(&beams[1..]);
    watch.scene.association.assign(0, 1);
    assert!(evaluate(watch.scene.context(), &mut watch.memory).is_empty());
    watch.scene.association = Association::none(4);
    assert_eq!(absent(&evaluate(watch.scene.context(), &mut watch.memory)), [&cause(0)]);
}

#[test]
fn it_ends_when_the_light_is_one_beams_again() {
    let mut watch = Watch::new();
    watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
    let findings: Vec<_> = (0..100).map(|_| watch.detect(&Watch::beams([1.0; 4]))).collect();
    let first_absent = findings.iter().position(|f| !absent(f).is_empty()).expect("it ends");
    // The windows still hold some of the light; 40 frames are needed for a verdict.
    assert!((20..80).contains(&first_absent), "{first_absent}");
}

#[test]
fn a_stranger_with_an_alert_beside_the_user_explains_the_light() {
    let (mut watch, mut beams, stranger) = Watch::beside_a_stranger();
    assert!((0..40).all(|_| present(&watch.detect(&beams)).is_empty()));
    // Once it has merged into the spot, its alert goes on as that of the spot.
    beams.pop();
    let found = (0..40)
        .find_map(|_| Some(watch.detect(&beams)).filter(|f| !f.is_empty()))
        .expect("found");
    let [Finding::Renamed { from, to }, Finding::Present(..)] = &found[..] else {
        panic!("{found:?}");
    };
    assert_eq!((from, to), (&Cause::Track(stranger), &cause(0)));
}

#[test]
fn what_a_spot_showed_beside_a_stranger_counts_no_more_once_they_have_parted() {
    let (mut watch, mut beams, _) = Watch::beside_a_stranger();
    (0..40).for_each(|_| drop(watch.detect(&beams)));
    // The stranger goes away at 4 m/s, and the user's light is their own.
    beams[0].energy_j = 1.0;
    for k in 0..60 {
        *beams.last_mut().unwrap() = detection(5.0 + 0.4 * f64::from(k), 0.0);
        assert!(present(&watch.detect(&beams)).is_empty(), "frame {k}");
    }
}

#[test]
fn the_past_outlasts_a_restart() {
    let mut watch = Watch::new();
    watch.until_found([3.0, 1.0, 1.0, 1.0]).expect("found");
    let mut restarted = Memory::default();
    restarted.restore(watch.scene.alerts.open().next().unwrap().1);
    let energy = restarted.usual_energy_j("u-0").unwrap();
    assert!((energy - 1.0).abs() < 1e-9, "{energy}");
    restarted.retain(|user| user != "u-0");
    assert!(restarted.usual_energy_j("u-0").is_none());
}
