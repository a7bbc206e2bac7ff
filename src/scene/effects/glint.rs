//! Light sources that are not beams: glints and lamps.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::Camera;
use crate::scene::motion::Schedule;
use crate::scene::render::Spot;
use crate::toml_file::{Key, OutOfRange};

/// Light that is not a beam: the sun's glint on water, or a dazzling lamp. A Gaussian of the given width and peak, imaged where an
/// emitter at `at_m` would be.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Glint {
    pub at_m: [f64; 2],
    /// Standard deviation, on the ground.
    pub spread_m: f64,
    /// Energy of the brightest pixel.
    pub peak_j: f64,
    #[serde(default)]
    pub present: Schedule,
}

impl Glint {
    pub(in crate::scene) fn spot(&self, camera: &Camera) -> Spot {
        let sigma_m = self.spread_m / camera.ground_scale();
        let pixel = camera.x.pitch_m * camera.y.pitch_m;
        Spot {
            centre: camera.to_sensor(self.at_m),
            sigma_m,
            energy_j: self.peak_j * TAU * sigma_m * sigma_m / pixel,
        }
    }
}

impl Table for Glint {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("at_m").finite_pair(self.at_m)?;
        field.at("spread_m").positive(self.spread_m)?;
        field.at("peak_j").positive(self.peak_j)?;
        self.present.validate(&field.at("present"))
    }
}
