//! Distortion of the lens.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::Distortion;
use crate::toml_file::{Key, OutOfRange};

/// The lens's departure from a pinhole (Brown, 1966), in the parameters of a calibration; the data sheet in `[optics]` does not
/// include it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DistortionTable {
    /// Where the optical axis meets the sensor.
    pub principal_point_m: [f64; 2],
    /// k1, k2, k3, over the tangent of the angle.
    pub radial: [f64; 3],
    /// p1, p2.
    pub tangential: [f64; 2],
    /// σ_eff at the sensor's corner is 1 + this of that on the axis, growing with the square of the radius.
    pub spot_growth: f64,
}

impl DistortionTable {
    pub(in crate::scene) fn lens(&self) -> Distortion {
        Distortion {
            principal_point_m: self.principal_point_m,
            focal_scale: 1.0,
            radial: self.radial,
            tangential: self.tangential,
        }
    }
}

impl Table for DistortionTable {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("principal_point_m").finite_pair(self.principal_point_m)?;
        for k in self.radial {
            field.at("radial").finite(k)?;
        }
        field.at("tangential").finite_pair(self.tangential)?;
        if !(self.spot_growth.is_finite() && self.spot_growth > -1.0) {
            return Err(field.at("spot_growth").refuse("more than −1", self.spot_growth));
        }
        Ok(())
    }
}
