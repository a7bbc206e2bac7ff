//! What the network knows of its users' power, as evidence and never as a fact: an emitter's energy is that of a user, or
//! anything. Positions stay free of it but for what a likelier energy says about two spots in one.

use serde::{Deserialize, Serialize};

use super::ladder::ConfigError;
use super::model::{Model, Spot};
use crate::optics::Camera;

/// `[estimator.known_power]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownPower {
    /// Energies that one exposure collects on average from a user straight below, J: one for each power users send with.
    pub energies_j: Vec<f64>,
    /// Scatter of a frame's energy around that mean (fading and pointing averaged over the exposure), relative.
    #[serde(default = "typical_scatter")]
    pub relative_std: f64,
    /// Of the beams that arrive, those expected to be such users'.
    #[serde(default = "typical_share")]
    pub share: f64,
    /// Attenuation of the air, 1/m: who stands farther away arrives weaker.
    #[serde(default)]
    pub attenuation_per_m: f64,
}

/// Gamma–Gamma fading with (α, β) = (4, 2), a hundred coherence times an exposure.
fn typical_scatter() -> f64 {
    0.094
}

fn typical_share() -> f64 {
    0.95
}

impl KnownPower {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let outside = |field, expected, found| Err(ConfigError::OutOfRange { field, expected, found });
        let is_positive = |v: f64| v.is_finite() && v > 0.0;
        if let Some(&energy) = self.energies_j.iter().find(|e| !is_positive(**e)) {
            return outside("known_power.energies_j", "positive finite numbers", energy);
        }
        if !is_positive(self.relative_std) {
            return outside(
                "known_power.relative_std",
                "a positive finite number",
                self.relative_std,
            );
        }
        if !(self.share > 0.0 && self.share < 1.0) {
            return outside("known_power.share", "a number between 0 and 1", self.share);
        }
        if !(self.attenuation_per_m.is_finite() && self.attenuation_per_m >= 0.0) {
            return outside(
                "known_power.attenuation_per_m",
                "a finite number, 0 or more",
                self.attenuation_per_m,
            );
        }
        Ok(())
    }
}

/// A user's energy in units of the noise: mean and precision of a normal density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Power {
    pub mean: f64,
    pub precision: f64,
}

impl Power {
    /// Squared distance of an energy in standard deviations.
    pub fn pull(&self, a: f64) -> f64 {
        (a - self.mean).powi(2) * self.precision
    }
}

/// Energies of "anything" are spread evenly over this many decades' logarithm.
const DECADES: f64 = 6.0;

/// Of a spot's energy, where it may be anything.
fn density(spot: &Spot) -> f64 {
    1.0 / (spot.a.max(1e-3) * DECADES * std::f64::consts::LN_10)
}

/// The mixture for one frame.
pub(super) struct Prior {
    known: KnownPower,
    camera: Camera,
    /// Standard deviation of the frame's noise, J.
    pub noise_j: f64,
    /// Misfit of the frame beyond the noise: what the data say is believed so many times less.
    pub temper: f64,
}

impl Prior {
    pub fn new(known: &KnownPower, camera: &Camera) -> Self {
        let mut camera = camera.clone();
        camera.pixels = None;
        Self {
            known: known.clone(),
            noise_j: camera.noise_std_j,
            camera,
            temper: 1.0,
        }
    }

    /// The known power nearest to what a spot shows, from where it stands.
    fn nearest(&self, spot: &Spot) -> Option<Power> {
        let sensor = spot.u.map(|u| u * self.camera.spot_sigma_m);
        let [x, y] = self.camera.to_ground(sensor);
        let h = self.camera.altitude_m;
        let length = (h * h + x * x + y * y).sqrt();
        let way = h / length * (-self.known.attenuation_per_m * (length - h)).exp();
        let powers = self.known.energies_j.iter().map(|e| {
            let mean = e * way / self.noise_j;
            Power {
                mean,
                precision: self.temper / (mean * self.known.relative_std).powi(2),
            }
        });
        powers.min_by(|p, q| p.pull(spot.a).total_cmp(&q.pull(spot.a)))
    }

    /// −2 ln of the mixture's share and density at a spot's energy, but for the pull, if it is a user's (with `power`) or
    /// anything.
    fn cost(&self, spot: &Spot, power: Option<Power>) -> f64 {
        let known = &self.known;
        match power {
            Some(p) => {
                let share = known.share / known.energies_j.len() as f64;
                -2.0 * share.ln() + (std::f64::consts::TAU * self.temper / p.precision).ln()
            }
            None => -2.0 * (1.0 - known.share).ln() - 2.0 * density(spot).ln(),
        }
    }

    /// Precision below which an energy is no more uncertain: the prior holds no more than one, whatever the frame leaves open, as it
    /// does of a spot beyond the sensor's edge. A user's own is in the fit.
    pub fn least_precision(&self, spot: &Spot) -> f64 {
        match spot.power {
            Some(_) => 0.0,
            None => std::f64::consts::TAU * density(spot).powi(2),
        }
    }

    /// Takes every spot for a user's where that is the likelier by `leniency`, and for anything else elsewhere. Tells
    /// whether that changed anything.
    pub fn label(&self, model: &mut Model, leniency: f64) -> bool {
        let mut has_changed = false;
        for spot in &mut model.spots {
            let power = self.nearest(spot).filter(|p| {
                let pull = p.pull(spot.a) / self.temper;
                pull + self.cost(spot, Some(*p)) < self.cost(spot, None) + leniency
            });
            has_changed |= power.is_some() != spot.power.is_some();
            spot.power = power;
        }
        has_changed
    }

    /// How many times a known power a spot holds.
    pub fn multiple(&self, spot: &Spot) -> f64 {
        self.nearest(spot).map_or(1.0, |p| spot.a / p.mean)
    }

    /// −2 ln of the prior at a model's energies, but for the pull.
    pub fn total_cost(&self, model: &Model) -> f64 {
        self.temper * model.spots.iter().map(|s| self.cost(s, s.power)).sum::<f64>()
    }
}
