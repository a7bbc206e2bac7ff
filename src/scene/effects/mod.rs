//! The effects: one small file each, with its equation and where it is valid.

mod attenuation;
mod fading;
mod pointing;
mod thermal_noise;

pub use attenuation::Attenuation;
pub use fading::Fading;
pub use pointing::Pointing;
pub use thermal_noise::ThermalNoise;

use serde::{Deserialize, Serialize};

use super::error::{Error, Field};

/// `[effects]`: what is not named does not happen and costs nothing.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Effects {
    pub attenuation: Option<Attenuation>,
    pub fading: Option<Fading>,
    pub pointing: Option<Pointing>,
    pub thermal_noise: Option<ThermalNoise>,
}

impl Effects {
    pub(super) fn validate(&self, field: &Field) -> Result<(), Error> {
        if let Some(e) = &self.attenuation {
            e.validate(&field.at("attenuation"))?;
        }
        if let Some(e) = &self.fading {
            e.validate(&field.at("fading"))?;
        }
        if let Some(e) = &self.pointing {
            e.validate(&field.at("pointing"))?;
        }
        if let Some(e) = &self.thermal_noise {
            e.validate(&field.at("thermal_noise"))?;
        }
        Ok(())
    }
}
