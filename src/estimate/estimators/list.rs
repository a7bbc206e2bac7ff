//! The list of estimators: what each one does, cheapest first.

use crate::estimate::config::ConfigError;

/// An estimator without a learned part, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EstimatorSpec {
    /// What `[estimator] name` selects it by.
    pub name: &'static str,
    pub summary: &'static str,
    pub(crate) method: Method,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    Peak { steps: usize },
    Greedy,
    Pencil { steps: usize },
    MaximumLikelihood,
    MaximumPosterior,
    Sequence,
}

impl EstimatorSpec {
    /// Whether the number of emitters is chosen by the frame's likelihood.
    pub(crate) fn chooses_order(&self) -> bool {
        matches!(
            self.method,
            Method::MaximumLikelihood | Method::MaximumPosterior | Method::Sequence
        )
    }

    /// Whether emitters are followed over frames. The others remember at most how far the lens's spots differ from the PSF.
    pub fn remembers(&self) -> bool {
        self.method == Method::Sequence
    }
}

/// Every estimator without a learned part, cheapest first.
pub const ESTIMATORS: &[EstimatorSpec] = &[
    EstimatorSpec {
        name: "subpixel-peak",
        summary: "maxima of the matched filter after non-maximum suppression, with a parabola through each",
        method: Method::Peak { steps: 0 },
    },
    EstimatorSpec {
        name: "peak-fit",
        summary: "the same, and five steps of the joint fit",
        method: Method::Peak { steps: 5 },
    },
    EstimatorSpec {
        name: "greedy-fit",
        summary: "residual peaks added one round at a time, all emitters refitted jointly",
        method: Method::Greedy,
    },
    EstimatorSpec {
        name: "pencil",
        summary: "half-kernel matrix pencil where spots overlap, amplitudes by least squares",
        method: Method::Pencil { steps: 0 },
    },
    EstimatorSpec {
        name: "pencil-fit",
        summary: "the pencil's seeds and five steps of the joint fit",
        method: Method::Pencil { steps: 5 },
    },
    EstimatorSpec {
        name: "ml",
        summary: "maximum likelihood: pencil or greedy seeds, moves, the number of emitters by a false-alarm test",
        method: Method::MaximumLikelihood,
    },
    EstimatorSpec {
        name: "map",
        summary: "the same, then the most probable hypothesis where users' power is known (`[estimator.known_power]`)",
        method: Method::MaximumPosterior,
    },
    EstimatorSpec {
        name: "sequence",
        summary: "`ml` over this frame and those before: positions and velocities shared, energies free in each frame",
        method: Method::Sequence,
    },
];

/// The estimator used when none is named.
pub const DEFAULT: &str = "ml";

/// An estimator that begins with a heatmap network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Learned {
    /// The heatmap's maxima as they are.
    Network,
    /// The heatmap's maxima, fitted jointly; what the fit does not need is merged or dropped.
    Hybrid,
}

impl Learned {
    pub const ALL: [Self; 2] = [Self::Network, Self::Hybrid];

    /// What `[estimator] name` selects it by.
    pub fn name(self) -> &'static str {
        match self {
            Self::Network => "network",
            Self::Hybrid => "hybrid",
        }
    }

    pub fn summary(self) -> &'static str {
        match self {
            Self::Network => "maxima of a network's heatmap, after non-maximum suppression: the paper's method",
            Self::Hybrid => "the network's maxima as seeds of the joint fit",
        }
    }
}

fn names() -> String {
    let learned = Learned::ALL.iter().map(|l| l.name());
    ESTIMATORS
        .iter()
        .map(|r| r.name)
        .chain(learned)
        .collect::<Vec<_>>()
        .join(", ")
}

/// The estimator of that name; an error names the nearest one.
pub fn find(name: &str) -> Result<&'static EstimatorSpec, ConfigError> {
    ESTIMATORS
        .iter()
        .find(|r| r.name == name)
        .ok_or_else(|| ConfigError::UnknownName {
            found: name.to_owned(),
            known: names(),
            nearest: ESTIMATORS
                .iter()
                .map(|r| r.name)
                .max_by(|a, b| strsim::jaro_winkler(name, a).total_cmp(&strsim::jaro_winkler(name, b)))
                .unwrap_or(DEFAULT),
        })
}
