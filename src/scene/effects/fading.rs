//! Gamma–Gamma fading of the beams.

use rand::Rng;
use rand_distr::{Distribution, Gamma};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::fading::{GammaGamma, Wave, rytov_variance};
use crate::toml_file::{Key, OutOfRange};

/// Gamma–Gamma turbulence (Al-Habash, Andrews and Phillips, 2001, eq. 9): ρ is the product of independent Gamma(α, 1/α)
/// and Gamma(β, 1/β), of unit mean and scintillation index 1/α + 1/β + 1/(αβ). Give α and β, or C_n² and the wavelength,
/// from which they follow with each emitter's range (Andrews and Phillips, 2005, spherical wave).
/// Valid from weak to saturated turbulence of constant C_n², for a lens smaller than the fade's correlation length.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fading {
    pub alpha: Option<f64>,
    pub beta: Option<f64>,
    /// C_n², m^(−2/3).
    pub cn2: Option<f64>,
    pub wavelength_m: Option<f64>,
}

/// Where α and β come from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::scene) enum Turbulence {
    Given(GammaGamma),
    FromPath { cn2: f64, wavelength_m: f64 },
}

impl Fading {
    pub(in crate::scene) fn turbulence(&self, field: &Key) -> Result<Turbulence, OutOfRange> {
        match (self.alpha, self.beta, self.cn2, self.wavelength_m) {
            (Some(alpha), Some(beta), None, None) => Ok(Turbulence::Given(GammaGamma {
                alpha: field.at("alpha").positive(alpha)?,
                beta: field.at("beta").positive(beta)?,
            })),
            (None, None, Some(cn2), Some(wavelength_m)) => Ok(Turbulence::FromPath {
                cn2: field.at("cn2").positive(cn2)?,
                wavelength_m: field.at("wavelength_m").positive(wavelength_m)?,
            }),
            _ => Err(field.refuse("alpha and beta, or cn2 and wavelength_m", Given(self))),
        }
    }
}

/// The keys that the table holds.
struct Given<'a>(&'a Fading);

impl std::fmt::Debug for Given<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let table = self.0;
        let keys = [
            ("alpha", table.alpha),
            ("beta", table.beta),
            ("cn2", table.cn2),
            ("wavelength_m", table.wavelength_m),
        ];
        let present: Vec<&str> = keys.iter().filter(|(_, v)| v.is_some()).map(|(k, _)| *k).collect();
        if present.is_empty() {
            f.write_str("neither")
        } else {
            f.write_str(&present.join(" and "))
        }
    }
}

impl Turbulence {
    /// The law over a path of `length_m`.
    pub fn law(&self, length_m: f64) -> GammaGamma {
        match *self {
            Self::Given(law) => law,
            Self::FromPath { cn2, wavelength_m } => {
                GammaGamma::from_rytov(rytov_variance(cn2, wavelength_m, length_m), Wave::Spherical)
            }
        }
    }
}

/// Draws ρ.
#[derive(Clone, Copy, Debug)]
pub(in crate::scene) struct Fades {
    large: Gamma<f64>,
    small: Gamma<f64>,
}

impl Fades {
    pub fn new(law: GammaGamma) -> Self {
        let unit_mean = |shape: f64| Gamma::new(shape, 1.0 / shape).expect("the shape is positive and finite");
        Self {
            large: unit_mean(law.alpha),
            small: unit_mean(law.beta),
        }
    }
}

impl Distribution<f64> for Fades {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> f64 {
        self.large.sample(rng) * self.small.sample(rng)
    }
}

impl Table for Fading {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        self.turbulence(field).map(drop)
    }
}
