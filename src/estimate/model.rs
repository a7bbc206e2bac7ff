//! A hypothesis about a frame: its emitters and what is fitted beside them.

/// An emitter on the sensor: centre in σ, energy in units of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Spot {
    pub u: [f64; 2],
    pub a: f64,
}

/// What is fitted beside the emitters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Nuisances {
    /// A constant and two slopes.
    pub background: bool,
    pub width: Width,
}

/// Whether the spot's width is known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Width {
    #[default]
    Known,
    Common,
    PerAxis,
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
        }
    }

    pub fn count(self) -> usize {
        self.background_atoms() + self.widths()
    }
}

#[derive(Clone, Debug)]
pub(super) struct Model {
    pub spots: Vec<Spot>,
    pub nuisances: Nuisances,
    pub background: [f64; 3],
    /// Relative to the configured σ.
    pub width: [f64; 2],
    /// Squared residual over the usable numbers, in units of the noise.
    pub deviance: f64,
    pub converged: bool,
}

impl Model {
    pub fn empty(nuisances: Nuisances) -> Self {
        Self {
            spots: Vec::new(),
            nuisances,
            background: [0.0; 3],
            width: [1.0; 2],
            deviance: f64::INFINITY,
            converged: false,
        }
    }

    pub fn parameters(&self) -> usize {
        3 * self.spots.len() + self.nuisances.count()
    }
}
