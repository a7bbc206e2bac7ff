//! Where the platform is and how it is turned at a time, and what its camera then sees of the ground.

use std::f64::consts::TAU;

use nalgebra::{UnitQuaternion, Vector3};
use rand::RngExt;

use super::{FlightLog, Orbit, PlatformConfig, Sway};
use crate::pose::{attitude_of, rotation_between, swap_ned_enu};
use crate::scene::effect::Effect;
use crate::scene::error::Error;
use crate::scene::stream::{Ledger, Streams};
use crate::toml_file::Key;
use crate::ulog;

/// The platform's true motion.
#[derive(Debug)]
pub(in crate::scene) struct Flight {
    /// Body to camera.
    unmount: UnitQuaternion<f64>,
    law: Law,
}

#[derive(Debug)]
enum Law {
    Sum {
        start_m: Vector3<f64>,
        heading_rad: f64,
        yaw_rate_rad_s: f64,
        velocity_m_s: Vector3<f64>,
        sway: Option<(Sway, [f64; 2])>,
        orbit: Option<Orbit>,
    },
    /// In the order of their times.
    Logged(Vec<Sample>),
}

/// One attitude of a log with its place.
#[derive(Clone, Debug)]
struct Sample {
    t: f64,
    position_m: Vector3<f64>,
    attitude: UnitQuaternion<f64>,
}

/// Where the lens is, and the rotation from north, east, down to the camera (sensor +y, sensor +x, optical axis).
#[derive(Clone, Copy, Debug)]
pub(in crate::scene) struct Sight {
    lens_m: Vector3<f64>,
    to_camera: UnitQuaternion<f64>,
}

impl Flight {
    pub fn new(
        config: &PlatformConfig,
        altitude_m: f64,
        field: &Key,
        streams: Streams,
        ledger: &Ledger,
    ) -> Result<Self, Error> {
        let start_m = Vector3::new(0.0, 0.0, altitude_m);
        let law = match &config.log {
            Some(log) => Law::Logged(samples(log, start_m, &field.at("log"))?),
            None => Law::Sum {
                start_m,
                heading_rad: config.heading_deg.to_radians(),
                yaw_rate_rad_s: config.yaw_rate_deg_s.to_radians(),
                velocity_m_s: config.velocity_m_s.into(),
                sway: config.sway.clone().map(|sway| {
                    let mut stream = streams.open(Effect::Platform, 0, 0, ledger);
                    (sway, [0; 2].map(|_| TAU * stream.random::<f64>()))
                }),
                orbit: config.orbit.clone(),
            },
        };
        Ok(Self {
            unmount: config.mount.rotation().inverse(),
            law,
        })
    }

    /// The lens (east, north, up, m) and the attitude (body to north, east, down) at `t` seconds.
    pub fn at(&self, t: f64) -> (Vector3<f64>, UnitQuaternion<f64>) {
        match &self.law {
            Law::Sum {
                start_m,
                heading_rad,
                yaw_rate_rad_s,
                velocity_m_s,
                sway,
                orbit,
            } => {
                let mut position_m = start_m + velocity_m_s * t;
                if let Some(orbit) = orbit {
                    let angle = TAU * t / orbit.period_s;
                    position_m += orbit.radius_m * Vector3::new(libm::cos(angle), libm::sin(angle), 0.0);
                }
                let [roll, pitch] = sway.as_ref().map_or([0.0; 2], |(sway, phases)| {
                    [0, 1]
                        .map(|k| sway.amplitude_deg[k].to_radians() * libm::sin(TAU * t / sway.period_s[k] + phases[k]))
                });
                let yaw = heading_rad + yaw_rate_rad_s * t;
                (position_m, UnitQuaternion::from_euler_angles(roll, pitch, yaw))
            }
            Law::Logged(samples) => {
                let after = samples.partition_point(|s| s.t <= t).clamp(1, samples.len() - 1);
                let (a, b) = (&samples[after - 1], &samples[after]);
                let share = ((t - a.t) / (b.t - a.t)).clamp(0.0, 1.0);
                let turn = rotation_between(&a.attitude, &b.attitude) * share;
                (
                    a.position_m + (b.position_m - a.position_m) * share,
                    UnitQuaternion::from_scaled_axis(turn) * a.attitude,
                )
            }
        }
    }

    pub fn sight(&self, t: f64) -> Sight {
        let (lens_m, attitude) = self.at(t);
        Sight {
            lens_m,
            to_camera: self.unmount * attitude.inverse(),
        }
    }

    /// Neither the speed, m/s, nor the rate of turn, rad/s, is larger.
    pub fn top_rates(&self) -> [f64; 2] {
        match &self.law {
            Law::Sum {
                yaw_rate_rad_s,
                velocity_m_s,
                sway,
                orbit,
                ..
            } => {
                let orbiting = orbit.as_ref().map_or(0.0, |o| TAU * o.radius_m / o.period_s);
                let swaying = sway.as_ref().map_or(0.0, |(sway, _)| {
                    let rate = |k: usize| TAU * sway.amplitude_deg[k].to_radians() / sway.period_s[k];
                    rate(0).hypot(rate(1))
                });
                [velocity_m_s.norm() + orbiting, yaw_rate_rad_s.abs() + swaying]
            }
            Law::Logged(samples) => samples.windows(2).fold([0.0; 2], |[speed, rate], pair| {
                let dt = pair[1].t - pair[0].t;
                let moved = (pair[1].position_m - pair[0].position_m).norm();
                let turned = rotation_between(&pair[0].attitude, &pair[1].attitude).norm();
                [f64::max(speed, moved / dt), f64::max(rate, turned / dt)]
            }),
        }
    }
}

impl Sight {
    /// A place on the ground as the camera sees it: sensor +y, sensor +x, along the optical axis, m.
    fn in_camera_m(&self, [x, y]: [f64; 2]) -> Vector3<f64> {
        self.to_camera * swap_ned_enu(Vector3::new(x, y, 0.0) - self.lens_m)
    }

    /// Its distance, and the part of it along the optical axis, m: negative behind the camera.
    pub fn range_m(&self, ground: [f64; 2]) -> [f64; 2] {
        let seen = self.in_camera_m(ground);
        [seen.norm(), seen.z]
    }

    /// Its (tan θx, tan θy).
    pub fn tangents(&self, ground: [f64; 2]) -> [f64; 2] {
        let seen = self.in_camera_m(ground);
        [seen.y / seen.z, seen.x / seen.z]
    }
}

/// The attitudes of a log with their places interpolated, on the clock of the scene. Without places the platform stands.
fn samples(log: &FlightLog, start_m: Vector3<f64>, field: &Key) -> Result<Vec<Sample>, Error> {
    let refuse = |expected: &str, found: String| field.at("file").refuse(expected, found);
    let read = ulog::read(&log.file).map_err(|e| refuse("a flight log of PX4", e.to_string()))?;
    let mut places: Vec<(u64, Vector3<f64>)> = read
        .places
        .iter()
        .filter(|p| p.axes == ulog::Axes::Local && p.ned_m.iter().all(|v| v.is_finite()))
        .map(|p| (p.time_us, swap_ned_enu(p.ned_m.into())))
        .collect();
    places.sort_by_key(|(time_us, _)| *time_us);
    places.dedup_by_key(|(time_us, _)| *time_us);
    let mut attitudes: Vec<(u64, UnitQuaternion<f64>)> = read
        .attitudes
        .iter()
        .filter_map(|a| Some((a.time_us, attitude_of(a.q).ok()?)))
        .collect();
    attitudes.sort_by_key(|(time_us, _)| *time_us);
    attitudes.dedup_by_key(|(time_us, _)| *time_us);
    let Some((first_us, _)) = attitudes.first().copied() else {
        return Err(refuse("a log with attitudes", "none".to_owned()).into());
    };
    let place_at = |time_us: u64| {
        if places.len() < 2 {
            return Vector3::zeros();
        }
        let after = places
            .partition_point(|(t, _)| *t <= time_us)
            .clamp(1, places.len() - 1);
        let ((ta, a), (tb, b)) = (places[after - 1], places[after]);
        let share = (time_us as f64 - ta as f64) / (tb - ta) as f64;
        a + (b - a) * share.clamp(0.0, 1.0)
    };
    let origin = place_at(first_us + (log.start_s * 1e6) as u64);
    let samples: Vec<Sample> = attitudes
        .into_iter()
        .map(|(time_us, attitude)| Sample {
            t: (time_us - first_us) as f64 * 1e-6 - log.start_s,
            position_m: start_m + place_at(time_us) - origin,
            attitude,
        })
        .collect();
    match samples.last() {
        Some(last) if last.t > 0.0 && samples.len() > 1 => Ok(samples),
        last => {
            let seconds = last.map_or(0.0, |last| last.t + log.start_s);
            let refused = field
                .at("start_s")
                .refuse(format!("less than the log's {seconds:.1} s"), log.start_s);
            Err(refused.into())
        }
    }
}
