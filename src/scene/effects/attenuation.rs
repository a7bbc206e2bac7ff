use serde::{Deserialize, Serialize};

use crate::scene::error::{Error, Field};

/// Absorption and scattering along the path: g = exp(−κL) (Beer and Lambert). Valid for a path of uniform extinction.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attenuation {
    /// κ, 1/m.
    pub kappa_per_m: f64,
}

impl Attenuation {
    pub(in crate::scene) fn validate(&self, field: &Field) -> Result<(), Error> {
        field.at("kappa_per_m").non_negative(self.kappa_per_m).map(drop)
    }

    /// g over `length_m`.
    pub fn transmittance(&self, length_m: f64) -> f64 {
        libm::exp(-self.kappa_per_m * length_m)
    }
}
