//! Attenuation along the path.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::radiometry;
use crate::toml_file::{Key, OutOfRange};

/// Absorption and scattering along the path: g = exp(−κL) (Beer and Lambert). Valid for a path of uniform extinction.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attenuation {
    /// κ, 1/m. Koschmieder: 3.9/visibility in the visible.
    pub kappa_per_m: f64,
}

impl Attenuation {
    /// g over `length_m`.
    pub fn transmittance(&self, length_m: f64) -> f64 {
        radiometry::path_transmission(self.kappa_per_m, length_m)
    }
}

impl Table for Attenuation {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("kappa_per_m").non_negative(self.kappa_per_m).map(drop)
    }
}
