//! Invalid covariances and clock steps as input of the monitor.

use jiff::{SignedDuration, Timestamp};

use super::trial::camera;
use super::{Case, Observed};
use crate::claims::{self, Claim, ClaimState, Store};
use crate::estimate::{Emitter, Estimate, Flags, SecondMomentScore};
use crate::monitor::{self, Monitor, Observation, Source};
use crate::optics::Camera;

const GROUP: &str = "Verdicts";
const RATE_HZ: f64 = 10.0;
const FRAMES: u64 = 200;

pub(super) fn cases() -> Vec<Case> {
    let tiny = f64::MIN_POSITIVE;
    let mut cases = vec![
        covariance("zero", "every gate is a point", [[0.0; 2]; 2]),
        covariance("of rank one", "no inverse", [[4.0, 2.0], [2.0, 1.0]]),
        covariance(
            "of rank one, but for rounding",
            "a determinant of either sign",
            [[1.0, 1.0 - f64::EPSILON], [1.0 - f64::EPSILON, 1.0]],
        ),
        covariance("1e300 m²", "determinants overflow", [[1e300, 0.0], [0.0, 1e300]]),
        covariance(
            "of subnormal size",
            "determinants underflow",
            [[tiny, 0.0], [0.0, tiny]],
        ),
        covariance("1e12 : 1e-12", "condition 1e24", [[1e12, 0.0], [0.0, 1e-12]]),
        covariance("indefinite", "not a covariance", [[1.0, 2.0], [2.0, 1.0]]),
        covariance("NaN", "not a number", [[f64::NAN; 2]; 2]),
    ];
    cases.extend([3600.0, -7200.0, 3.2e8, -3.2e8, 0.01, -0.01].map(clock_step));
    cases
}

/// The clocks of frames and claims step together, as when the clock of a host is set.
fn clock_step(by_s: f64) -> Case {
    Case::new(
        GROUP,
        format!("the clock steps by {by_s:e} s"),
        "time runs backwards, or years pass between two frames",
        "within 20 s the user is verified again; an eavesdropper who comes then is alerted, and no other alert is raised",
        move |_| {
            let camera = camera([64, 64], 1e-3);
            let config = claims::Config::default();
            let mut monitor = Monitor::new(&monitor::Config::default(), &config, &camera, source());
            let mut store = Store::new(&config);
            let (step, intrusion, end) = (100, 300, 400);
            let (mut raised, mut last) = (Vec::new(), None);
            for frame in 0..end {
                let stepped = if frame < step { 0.0 } else { by_s };
                let since = 1.8e9 + frame as f64 / RATE_HZ + stepped;
                let time = Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(since);
                if frame % 10 == 0 {
                    store.insert(claim(time), time);
                }
                let mut emitters = vec![emitter(&camera, frame, [10.0, -20.0], [[0.01, 0.0], [0.0, 0.01]])];
                if frame >= intrusion {
                    emitters.push(emitter(&camera, frame, [-60.0, 70.0], [[0.01, 0.0], [0.0, 0.01]]));
                }
                let estimate = estimate(emitters);
                let seen = Observation {
                    frame,
                    time,
                    result: Ok(&estimate),
                    energy_scale: 1.0,
                    digest: frame + 1,
                    look: crate::monitor::Look::Level,
                };
                let report = monitor.step(seen, &mut store);
                let news = report
                    .events
                    .iter()
                    .filter(|e| e.event == monitor::AlertEventKind::Raised);
                raised.extend(news.map(|e| (frame, e.alert.kind)));
                last = Some(report);
            }
            let is_verified = last.is_some_and(|r| {
                let statuses = r.emitters.iter().filter(|e| e.user.is_some()).map(|e| e.status);
                statuses.into_iter().any(|s| s == monitor::PositionStatus::Verified)
            });
            type Raised<'a> = Vec<&'a (u64, monitor::AlertKind)>;
            let (before, after): (Raised, Raised) = raised.iter().partition(|(frame, _)| *frame < intrusion);
            let is_alerted = after.len() == 1 && after[0].1 == monitor::AlertKind::UnclaimedEmitter;
            let words = |list: &[&(u64, monitor::AlertKind)]| {
                let words: Vec<_> = list
                    .iter()
                    .map(|(frame, kind)| format!("{kind:?} at frame {frame}"))
                    .collect();
                if words.is_empty() {
                    "none".to_owned()
                } else {
                    words.join(", ")
                }
            };
            Observed {
                happened: format!(
                    "user {}; alerts by the step: {}; by the eavesdropper of frame {intrusion}: {}",
                    if is_verified { "verified" } else { "NOT verified" },
                    words(&before),
                    words(&after)
                ),
                holds: is_verified && before.is_empty() && is_alerted,
                fit: None,
            }
        },
    )
}

fn source() -> Source {
    Source {
        kind: "replay".to_owned(),
        file: None,
        rate_hz: RATE_HZ,
    }
}

fn claim(time: Timestamp) -> Claim {
    Claim {
        time,
        user: "u-1".to_owned(),
        x_m: 10.0,
        y_m: -20.0,
        z_m: None,
        sigma_m: Some(1.0),
        cov_m2: None,
        power_w: None,
        state: ClaimState::Active,
    }
}

/// Varies from frame to frame, because identical frames count as a frozen sensor.
fn emitter(camera: &Camera, frame: u64, [x_m, y_m]: [f64; 2], cov_m2: [[f64; 2]; 2]) -> Emitter {
    Emitter {
        x_m: x_m + 1e-3 * (frame as f64).sin(),
        y_m,
        cov_m2,
        energy_j: 7e-3,
        energy_std_j: 1e-5,
        sensor_m: camera.to_sensor([x_m, y_m]),
        velocity: None,
        lasting_cov_m2: None,
        second_moment: SecondMomentScore::default(),
        flags: Flags::empty(),
    }
}

fn estimate(emitters: Vec<Emitter>) -> Estimate {
    Estimate {
        emitters,
        estimator: "study",
        reduced_chi2: 1.0,
        spot_error: 0.0,
        condition: 1.0,
        ..Estimate::default()
    }
}

/// A user and an eavesdropper, both with the covariance `cov_m2`.
fn covariance(name: &str, hard: &'static str, cov_m2: [[f64; 2]; 2]) -> Case {
    let is_told = cov_m2.iter().flatten().all(|c| c.abs() < 1e6);
    Case::new(
        GROUP,
        format!("covariance {name}"),
        hard,
        if is_told {
            "nothing malformed; the unclaimed emitter is alerted"
        } else {
            "nothing malformed"
        },
        move |_| {
            let camera = camera([64, 64], 1e-3);
            let config = claims::Config::default();
            let mut monitor = Monitor::new(&monitor::Config::default(), &config, &camera, source());
            let mut store = Store::new(&config);
            let at = |frame: u64| Timestamp::UNIX_EPOCH + SignedDuration::from_secs_f64(1e4 + frame as f64 / RATE_HZ);
            let mut raised = Vec::new();
            let mut malformed = 0;
            for frame in 0..FRAMES {
                let time = at(frame);
                if frame % 10 == 0 {
                    store.insert(claim(time), time);
                }
                let places = [[10.0, -20.0], [-60.0, 70.0]];
                let estimate = estimate(places.map(|p| emitter(&camera, frame, p, cov_m2)).into());
                let seen = Observation {
                    frame,
                    time,
                    result: Ok(&estimate),
                    energy_scale: 1.0,
                    digest: frame + 1,
                    look: crate::monitor::Look::Level,
                };
                let report = monitor.step(seen, &mut store);
                malformed += report
                    .emitters
                    .iter()
                    .filter(|e| {
                        let [[a, b], [c, d]] = e.cov_m2;
                        let is_finite = [e.x_m, e.y_m, e.energy_j, a, b, c, d].iter().all(|v| v.is_finite());
                        !(is_finite && b == c && a >= 0.0 && d >= 0.0)
                    })
                    .count();
                raised.extend(report.events.iter().map(|e| e.alert.kind));
            }
            let is_alerted = raised.contains(&monitor::AlertKind::UnclaimedEmitter);
            let words: Vec<String> = raised.iter().map(|k| format!("{k:?}")).collect();
            Observed {
                happened: format!(
                    "{malformed} malformed positions in {FRAMES} frames; alerts: {}",
                    if words.is_empty() {
                        "none".to_owned()
                    } else {
                        words.join(", ")
                    }
                ),
                holds: malformed == 0 && (is_alerted || !is_told),
                fit: None,
            }
        },
    )
}
