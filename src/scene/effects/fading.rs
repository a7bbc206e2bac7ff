use rand::Rng;
use rand_distr::{Distribution, Gamma};
use serde::{Deserialize, Serialize};

use crate::scene::error::{Error, Field};

/// Gamma–Gamma turbulence (Al-Habash, Andrews and Phillips, 2001, eq. 13): ρ is the product of independent
/// Gamma(α, 1/α) and Gamma(β, 1/β), of unit mean and scintillation index 1/α + 1/β + 1/(αβ).
/// Valid from weak to saturated turbulence, for a receiver smaller than the fade's correlation length.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fading {
    pub alpha: f64,
    pub beta: f64,
}

/// Draws ρ.
#[derive(Clone, Copy, Debug)]
pub(in crate::scene) struct GammaGamma {
    large: Gamma<f64>,
    small: Gamma<f64>,
}

impl Fading {
    pub(in crate::scene) fn validate(&self, field: &Field) -> Result<(), Error> {
        field.at("alpha").positive(self.alpha)?;
        field.at("beta").positive(self.beta).map(drop)
    }

    pub(in crate::scene) fn distribution(&self) -> GammaGamma {
        let unit_mean = |shape: f64| Gamma::new(shape, 1.0 / shape).expect("the shape was validated");
        GammaGamma {
            large: unit_mean(self.alpha),
            small: unit_mean(self.beta),
        }
    }
}

impl Distribution<f64> for GammaGamma {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> f64 {
        self.large.sample(rng) * self.small.sample(rng)
    }
}
