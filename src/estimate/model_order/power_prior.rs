//! The prior of a source's energy: a mixture of the known users' energies and a log-uniform background. Positions depend on it only
//! through the energies.

use crate::estimate::config::KnownPower;
use crate::estimate::model::hypothesis::{EnergyPrior, Hypothesis, PointSource};
use crate::optics::Camera;

/// Decades of the log-uniform density of energies that are no user's.
const DECADES: f64 = 6.0;

/// Log-uniform density at a source's energy.
fn density(source: &PointSource) -> f64 {
    1.0 / (source.a.max(1e-3) * DECADES * std::f64::consts::LN_10)
}

/// The mixture, with the noise and the misfit of one frame.
pub(crate) struct PowerPrior {
    known: KnownPower,
    camera: Camera,
    /// Standard deviation of the frame's noise, J.
    pub noise_j: f64,
    /// Misfit of the frame: the likelihood's exponent is divided by it.
    pub tempering: f64,
}

impl PowerPrior {
    pub fn new(known: &KnownPower, camera: &Camera) -> Self {
        let mut camera = camera.clone();
        camera.pixels = None;
        Self {
            known: known.clone(),
            noise_j: camera.noise_std_j,
            camera,
            tempering: 1.0,
        }
    }

    /// Spots of another width: positions come in units of it.
    pub fn set_spot_sigma(&mut self, spot_sigma_m: f64) {
        self.camera.spot_sigma_m = spot_sigma_m;
    }

    /// The energy prior of the user nearest to a source's energy, at the source's position.
    fn nearest(&self, source: &PointSource) -> Option<EnergyPrior> {
        let sensor = source.u.map(|u| u * self.camera.spot_sigma_m);
        let [x, y] = self.camera.to_ground(sensor);
        let h = self.camera.altitude_m;
        let length = (h * h + x * x + y * y).sqrt();
        let way = h / length * (-self.known.attenuation_per_m * (length - h)).exp();
        let powers = self.known.energies_j.iter().map(|e| {
            let mean = e * way / self.noise_j;
            EnergyPrior {
                mean,
                precision: self.tempering / (mean * self.known.relative_std).powi(2),
            }
        });
        powers.min_by(|p, q| p.prior_penalty(source.a).total_cmp(&q.prior_penalty(source.a)))
    }

    /// −2 ln of a component's weight and density at a source's energy, without the squared distance: a user's with `power`, the
    /// log-uniform one without.
    fn cost(&self, source: &PointSource, power: Option<EnergyPrior>) -> f64 {
        let known = &self.known;
        match power {
            Some(p) => {
                let share = known.share / known.energies_j.len() as f64;
                -2.0 * share.ln() + (std::f64::consts::TAU * self.tempering / p.precision).ln()
            }
            None => -2.0 * (1.0 - known.share).ln() - 2.0 * density(source).ln(),
        }
    }

    /// The log-uniform prior's precision of an energy, which limits the Occam factor where the frame says little, as for a source beyond
    /// the sensor's edge. 0 for a user's energy, whose prior is part of the fit.
    pub fn least_precision(&self, source: &PointSource) -> f64 {
        match source.power {
            Some(_) => 0.0,
            None => std::f64::consts::TAU * density(source).powi(2),
        }
    }

    /// Assigns every source to a user where that is more probable up to `leniency`, and to the log-uniform component elsewhere. Returns
    /// whether an assignment changed.
    pub fn assign_components(&self, hypothesis: &mut Hypothesis, leniency: f64) -> bool {
        let mut has_changed = false;
        for source in &mut hypothesis.sources {
            let power = self.nearest(source).filter(|p| {
                let prior_penalty = p.prior_penalty(source.a) / self.tempering;
                prior_penalty + self.cost(source, Some(*p)) < self.cost(source, None) + leniency
            });
            has_changed |= power.is_some() != source.power.is_some();
            source.power = power;
        }
        has_changed
    }

    /// A source's energy in units of the nearest user's.
    pub fn multiple(&self, source: &PointSource) -> f64 {
        self.nearest(source).map_or(1.0, |p| source.a / p.mean)
    }

    /// −2 ln of the prior of a hypothesis's energies, without the squared distances.
    pub fn total_cost(&self, hypothesis: &Hypothesis) -> f64 {
        self.tempering * hypothesis.sources.iter().map(|s| self.cost(s, s.power)).sum::<f64>()
    }
}
