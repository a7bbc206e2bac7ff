//! What the autopilot says of the platform's motion: noisy, biased, late, silent or dragged away as the scene specifies.

use nalgebra::{UnitQuaternion, Vector3};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::Flight;
use crate::pose::{Pose, PoseSigmas};
use crate::scene::effect::Effect;
use crate::scene::motion::Schedule;
use crate::scene::stream::{Ledger, Streams};
use crate::toml_file::{Key, OutOfRange};

/// `[platform.telemetry]`: without an entry the autopilot is right.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TelemetryConfig {
    /// Poses per second.
    pub rate_hz: f64,
    /// The standard deviations that a pose states.
    pub attitude_sigma_rad: f64,
    pub position_sigma_m: f64,
    /// Standard deviation, per axis, of each pose's own error.
    pub attitude_noise_rad: f64,
    pub position_noise_m: f64,
    /// Lasting error of the attitude: what is stated is the truth turned by this about north, east and down.
    pub attitude_bias_rad: [f64; 3],
    /// Lasting error of the place: east, north, up.
    pub position_bias_m: [f64; 3],
    /// Stamps are later than the truth by this.
    pub delay_s: f64,
    /// When no pose comes.
    pub lost: Option<Schedule>,
    pub dragged: Option<Drag>,
}

/// The stated place is led away, as by false GNSS signals.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drag {
    pub from_s: f64,
    /// East, north.
    pub velocity_m_s: [f64; 2],
}

impl Default for TelemetryConfig {
    fn default() -> Self {
        let stated = PoseSigmas::default();
        Self {
            rate_hz: 50.0,
            attitude_sigma_rad: stated.attitude_rad,
            position_sigma_m: stated.position_m,
            attitude_noise_rad: 0.0,
            position_noise_m: 0.0,
            attitude_bias_rad: [0.0; 3],
            position_bias_m: [0.0; 3],
            delay_s: 0.0,
            lost: None,
            dragged: None,
        }
    }
}

impl TelemetryConfig {
    pub(super) fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        let reason = "poses per second: from one a second to faster than any autopilot";
        field.at("rate_hz").within(self.rate_hz, 1.0..=1000.0, reason)?;
        field.at("attitude_sigma_rad").positive(self.attitude_sigma_rad)?;
        field.at("position_sigma_m").positive(self.position_sigma_m)?;
        field.at("attitude_noise_rad").non_negative(self.attitude_noise_rad)?;
        field.at("position_noise_m").non_negative(self.position_noise_m)?;
        for (name, bias) in [
            ("attitude_bias_rad", self.attitude_bias_rad),
            ("position_bias_m", self.position_bias_m),
        ] {
            for value in bias {
                field.at(name).finite(value)?;
            }
        }
        field
            .at("delay_s")
            .within(self.delay_s, -10.0..=10.0, "seconds either way")?;
        if let Some(lost) = &self.lost {
            lost.validate(&field.at("lost"))?;
        }
        if let Some(drag) = &self.dragged {
            let field = field.at("dragged");
            field.at("from_s").finite(drag.from_s)?;
            field.at("velocity_m_s").finite_pair(drag.velocity_m_s)?;
        }
        Ok(())
    }
}

/// The autopilot.
#[derive(Debug)]
pub(in crate::scene) struct Telemetry(TelemetryConfig);

impl Telemetry {
    pub fn new(config: TelemetryConfig) -> Self {
        Self(config)
    }

    pub fn rate_hz(&self) -> f64 {
        self.0.rate_hz
    }

    /// The poses of the times in (`after`, `until`], s; `date` tells a time's stamp.
    pub fn poses(
        &self,
        flight: &Flight,
        [after, until]: [f64; 2],
        date: impl Fn(f64) -> jiff::Timestamp,
        streams: Streams,
        ledger: &Ledger,
    ) -> Vec<Pose> {
        let config = &self.0;
        let [first, last] = [after, until].map(|t| (t * config.rate_hz + 1e-9).floor() as i64);
        let numbers = first + 1..=last;
        let times = numbers.map(|n| (n, n as f64 / config.rate_hz));
        times
            .filter(|(_, t)| !config.lost.is_some_and(|lost| lost.on(*t)))
            .map(|(n, t)| {
                let (position_m, attitude) = flight.at(t);
                let [attitude_noise, position_noise] = self.noise(n, streams, ledger);
                let turn = Vector3::from(config.attitude_bias_rad) + attitude_noise;
                let mut place = position_m + Vector3::from(config.position_bias_m) + position_noise;
                if let Some(drag) = &config.dragged {
                    let [east, north] = drag.velocity_m_s.map(|v| v * (t - drag.from_s).max(0.0));
                    place += Vector3::new(east, north, 0.0);
                }
                Pose {
                    time: date(t + config.delay_s),
                    position_m: place.into(),
                    attitude: UnitQuaternion::from_scaled_axis(turn) * attitude,
                    cov: PoseSigmas {
                        attitude_rad: config.attitude_sigma_rad,
                        position_m: config.position_sigma_m,
                    }
                    .cov(),
                }
            })
            .collect()
    }

    /// Errors of attitude and place of pose `n`; nothing is drawn where there are none.
    fn noise(&self, n: i64, streams: Streams, ledger: &Ledger) -> [Vector3<f64>; 2] {
        let scales = [self.0.attitude_noise_rad, self.0.position_noise_m];
        if scales == [0.0; 2] {
            return [Vector3::zeros(); 2];
        }
        let mut stream = streams.open(Effect::Telemetry, 0, n as u64, ledger);
        scales.map(|scale| scale * Vector3::from_fn(|_, _| StandardNormal.sample(&mut *stream)))
    }
}
