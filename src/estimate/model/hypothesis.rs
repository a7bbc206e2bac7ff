//! A hypothesis about a frame: its emitters and what is fitted beside them.

/// A user's energy in units of the noise: mean and precision of a normal density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Power {
    pub mean: f64,
    pub precision: f64,
}

impl Power {
    /// Squared distance of an energy in standard deviations.
    pub fn pull(&self, a: f64) -> f64 {
        (a - self.mean).powi(2) * self.precision
    }
}

/// An emitter on the sensor: centre in σ, energy in units of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Spot {
    pub u: [f64; 2],
    pub a: f64,
    /// What is known of its energy where it is taken for a user's.
    pub power: Option<Power>,
}

impl Spot {
    pub fn new(u: [f64; 2], a: f64) -> Self {
        Self { u, a, power: None }
    }
}

/// What is fitted beside the emitters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Nuisances {
    /// A constant and two slopes.
    pub background: bool,
    pub width: Width,
}

/// Whether the spot's width is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Width {
    #[default]
    Known,
    Common,
    PerAxis,
    /// The same with a covariance between the axes: an ellipse that is turned against them.
    Turned,
}

impl Nuisances {
    pub fn background_atoms(self) -> usize {
        if self.background { 3 } else { 0 }
    }

    pub fn widths(self) -> usize {
        match self.width {
            Width::Known => 0,
            Width::Common => 1,
            Width::PerAxis => 2,
            Width::Turned => 3,
        }
    }

    pub fn count(self) -> usize {
        self.background_atoms() + self.widths()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub spots: Vec<Spot>,
    pub nuisances: Nuisances,
    pub background: [f64; 3],
    /// Relative to the configured σ.
    pub width: [f64; 2],
    /// The spot's covariance between the axes, σ².
    pub turn: f64,
    /// Squared residual over the usable numbers, in units of the noise.
    pub deviance: f64,
    /// What the number of emitters costs where known powers are weighed in.
    pub occam: f64,
    pub converged: bool,
}

impl Model {
    pub fn empty(nuisances: Nuisances) -> Self {
        Self {
            spots: Vec::new(),
            nuisances,
            background: [0.0; 3],
            width: [1.0; 2],
            turn: 0.0,
            deviance: f64::INFINITY,
            occam: 0.0,
            converged: false,
        }
    }

    /// Takes out all nuisances but these.
    pub fn confine(&mut self, nuisances: Nuisances) {
        self.nuisances = nuisances;
        if nuisances.width == Width::Known {
            self.width = [1.0; 2];
        }
        if nuisances.width != Width::Turned {
            self.turn = 0.0;
        }
        if !nuisances.background {
            self.background = [0.0; 3];
        }
    }

    /// Squared distances of the energies from what is known of them, in standard deviations.
    pub fn pull(&self) -> f64 {
        pull(&self.spots)
    }

    pub fn parameters(&self) -> usize {
        3 * self.spots.len() + self.nuisances.count()
    }
}

pub(crate) fn pull(spots: &[Spot]) -> f64 {
    spots.iter().filter_map(|s| Some(s.power?.pull(s.a))).sum()
}
