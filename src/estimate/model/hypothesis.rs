//! A hypothesis about a frame: its point sources and nuisance parameters.

/// Spots nearer than this, σ, overlap: what one explains is explained in part by the other. The inner product of two spots d apart is
/// exp(−d²/4) of one's square, here a fifth.
pub(crate) const OVERLAPPING: f64 = 2.5;
/// Spots farther apart than this, σ, are independent: the same is 2 %.
pub(crate) const INDEPENDENT: f64 = 4.0;

/// Normal prior of a source's energy where it is assigned to a user, in units of the noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct EnergyPrior {
    pub mean: f64,
    pub precision: f64,
}

impl EnergyPrior {
    /// Squared distance of an energy in standard deviations.
    pub fn prior_penalty(&self, a: f64) -> f64 {
        (a - self.mean).powi(2) * self.precision
    }
}

/// An emitter on the sensor: centre `u` in σ, energy `a` in units of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct PointSource {
    pub u: [f64; 2],
    pub a: f64,
    /// Prior of its energy, if it is assigned to a user.
    pub power: Option<EnergyPrior>,
}

impl PointSource {
    pub fn new(u: [f64; 2], a: f64) -> Self {
        Self { u, a, power: None }
    }
}

/// Nuisance parameters fitted beside the sources.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Nuisances {
    pub background: Background,
    pub width: Width,
}

/// Which light beside the sources' is fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Background {
    #[default]
    None,
    /// A constant and two slopes.
    Plane,
    /// The same with the three curvatures: daylight through a lens that is darker towards its edge.
    Curved,
}

/// Degrees along x and y of the terms of a background.
pub(crate) const BACKGROUND_TERMS: [[usize; 2]; 6] = [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]];

/// Which widths of the common PSF are fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Width {
    #[default]
    Known,
    Common,
    PerAxis,
    /// Both widths and the covariance between the axes: a rotated ellipse.
    RotatedEllipse,
}

impl Nuisances {
    pub fn background_terms(self) -> usize {
        match self.background {
            Background::None => 0,
            Background::Plane => 3,
            Background::Curved => BACKGROUND_TERMS.len(),
        }
    }

    pub fn widths(self) -> usize {
        match self.width {
            Width::Known => 0,
            Width::Common => 1,
            Width::PerAxis => 2,
            Width::RotatedEllipse => 3,
        }
    }

    pub fn count(self) -> usize {
        self.background_terms() + self.widths()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Hypothesis {
    pub sources: Vec<PointSource>,
    pub nuisances: Nuisances,
    pub background: [f64; BACKGROUND_TERMS.len()],
    /// Widths along x and y, relative to the configured σ.
    pub width: [f64; 2],
    /// The PSF's covariance between the axes, σ².
    pub covariance_xy: f64,
    /// Whether energies may be negative. One frame's may not; over many frames the bound would bias positions.
    pub has_signed_energies: bool,
    /// Squared residual over the usable data, in units of the noise.
    pub deviance: f64,
    /// −2 ln of the Occam factor and the prior of the number of sources; 0 without a power prior.
    pub log_evidence_term: f64,
    pub converged: bool,
}

impl Hypothesis {
    pub fn empty(nuisances: Nuisances) -> Self {
        Self {
            sources: Vec::new(),
            nuisances,
            background: [0.0; BACKGROUND_TERMS.len()],
            width: [1.0; 2],
            covariance_xy: 0.0,
            has_signed_energies: false,
            deviance: f64::INFINITY,
            log_evidence_term: 0.0,
            converged: false,
        }
    }

    /// Removes all nuisances but these.
    pub fn restrict_nuisances(&mut self, nuisances: Nuisances) {
        self.nuisances = nuisances;
        if nuisances.width == Width::Known {
            self.width = [1.0; 2];
        }
        if nuisances.width != Width::RotatedEllipse {
            self.covariance_xy = 0.0;
        }
        self.background[nuisances.background_terms()..].fill(0.0);
    }

    /// Squared distances of the energies from their priors' means, in standard deviations.
    pub fn prior_penalty(&self) -> f64 {
        prior_penalty(&self.sources)
    }

    pub fn parameters(&self) -> usize {
        3 * self.sources.len() + self.nuisances.count()
    }
}

pub(crate) fn prior_penalty(sources: &[PointSource]) -> f64 {
    sources.iter().filter_map(|s| Some(s.power?.prior_penalty(s.a))).sum()
}
