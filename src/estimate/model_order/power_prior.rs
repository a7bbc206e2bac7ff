//! What the network knows of its users' power, as evidence and never as a fact: an emitter's energy is that of a user, or
//! anything. Positions stay free of it but for what a likelier energy says about two spots in one.

use crate::estimate::config::KnownPower;
use crate::estimate::model::hypothesis::{Model, Power, Spot};
use crate::optics::Camera;

/// Energies of "anything" are spread evenly over this many decades' logarithm.
const DECADES: f64 = 6.0;

/// Of a spot's energy, where it may be anything.
fn density(spot: &Spot) -> f64 {
    1.0 / (spot.a.max(1e-3) * DECADES * std::f64::consts::LN_10)
}

/// The mixture for one frame.
pub(crate) struct Prior {
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
