//! Vibration of the platform within an exposure.

use std::f64::consts::TAU;

use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::scene::effect::Effect;
use crate::scene::stream::{Ledger, Streams};
use crate::toml_file::{Key, OutOfRange};

/// The platform vibrates within an exposure: every angle moves by a·sin(2πft + φ), φ drawn once. Over many periods the spot
/// widens by z·a/√2 along the direction of a. Valid for a lens that turns as a whole.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vibration {
    /// a, for θx and θy.
    pub amplitude_rad: [f64; 2],
    /// f.
    pub frequency_hz: f64,
}

impl Table for Vibration {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("amplitude_rad").finite_pair(self.amplitude_rad)?;
        field.at("frequency_hz").positive(self.frequency_hz).map(drop)
    }
}

/// All vibrations with their phases.
#[derive(Debug)]
pub(in crate::scene) struct Shaker {
    parts: Vec<(Vibration, f64)>,
}

impl Shaker {
    pub fn new(tables: &[Vibration], streams: Streams, ledger: &Ledger) -> Self {
        let mut stream = streams.open(Effect::Vibration, 0, 0, ledger);
        let parts = tables.iter().map(|v| (v.clone(), TAU * stream.random::<f64>()));
        Self { parts: parts.collect() }
    }

    /// Shift of (θx, θy) at `t` seconds, rad.
    pub fn at(&self, t: f64) -> [f64; 2] {
        self.parts.iter().fold([0.0; 2], |sum, (v, phase)| {
            let sin = libm::sin(TAU * (v.frequency_hz * t).fract() + phase);
            std::array::from_fn(|i| sum[i] + v.amplitude_rad[i] * sin)
        })
    }
}
