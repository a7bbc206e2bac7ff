//! Attitude errors of the platform.

use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::scene::effect::Effect;
use crate::scene::process::GaussianProcess;
use crate::scene::stream::{Ledger, Streams};
use crate::toml_file::{Key, OutOfRange};

/// The platform's attitude differs from the assumed one: every spot of a frame moves alike. Tilts about y and x shift the
/// angles θx and θy, yaw turns them about the lens's axis; each is N(bias, std²), anew for every frame, or with
/// autocovariance std²·exp(−τ²/2T²) over the time T. Valid for rotations about the lens.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Attitude {
    pub tilt_std_rad: [f64; 2],
    pub tilt_bias_rad: [f64; 2],
    pub yaw_std_rad: f64,
    pub yaw_bias_rad: f64,
    /// Independent from frame to frame when left out.
    pub time_s: Option<f64>,
}

impl Table for Attitude {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        for std in self.tilt_std_rad {
            field.at("tilt_std_rad").non_negative(std)?;
        }
        field.at("tilt_bias_rad").finite_pair(self.tilt_bias_rad)?;
        field.at("yaw_std_rad").non_negative(self.yaw_std_rad)?;
        field.at("yaw_bias_rad").finite(self.yaw_bias_rad)?;
        self.time_s.map_or(Ok(()), |t| field.at("time_s").positive(t).map(drop))
    }
}

/// An attitude prepared for evaluation in any frame.
#[derive(Debug)]
pub(in crate::scene) struct Pose {
    table: Attitude,
    processes: Option<[GaussianProcess; 3]>,
}

/// Tilts in x and y and yaw, rad.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::scene) struct Rotation {
    pub tilt: [f64; 2],
    pub yaw: f64,
}

impl Pose {
    pub fn new(table: &Attitude, streams: Streams, ledger: &Ledger) -> Self {
        let processes = table.time_s.map(|time_s| {
            [0, 1, 2].map(|axis| {
                let mut stream = streams.open(Effect::Attitude, 1 + axis, 0, ledger);
                GaussianProcess::new(&mut *stream, time_s)
            })
        });
        Self {
            table: table.clone(),
            processes,
        }
    }

    /// The rotation in frame `k` at `t` seconds.
    pub fn at(&self, k: u64, t: f64, streams: Streams, ledger: &Ledger) -> Rotation {
        let unit: [f64; 3] = match &self.processes {
            Some(processes) => [0, 1, 2].map(|axis| processes[axis].at(t)),
            None => {
                let mut stream = streams.open(Effect::Attitude, 0, k, ledger);
                std::array::from_fn(|_| StandardNormal.sample(&mut *stream))
            }
        };
        let table = &self.table;
        Rotation {
            tilt: [0, 1].map(|i| table.tilt_bias_rad[i] + table.tilt_std_rad[i] * unit[i]),
            yaw: table.yaw_bias_rad + table.yaw_std_rad * unit[2],
        }
    }
}

impl Rotation {
    /// Tangents of a direction after the rotation.
    pub fn apply(&self, tangents: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = (libm::sin(self.yaw), libm::cos(self.yaw));
        let turned = [
            cos * tangents[0] - sin * tangents[1],
            sin * tangents[0] + cos * tangents[1],
        ];
        tilt(turned, self.tilt)
    }
}

/// Tangents after both angles grow by `by` (rad): tan(θ + δ) = (t + tan δ)/(1 − t·tan δ).
pub(in crate::scene) fn tilt(tangents: [f64; 2], by: [f64; 2]) -> [f64; 2] {
    std::array::from_fn(|i| {
        let d = libm::tan(by[i]);
        (tangents[i] + d) / (1.0 - tangents[i] * d)
    })
}
