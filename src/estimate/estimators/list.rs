//! The ladder of estimators: what each rung does, and building one from a config.

use crate::estimate::config::ConfigError;

/// A rung of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rung {
    /// What `[estimator] name` selects it by.
    pub name: &'static str,
    pub summary: &'static str,
    pub(crate) method: Method,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Method {
    Peak { is_subpixel: bool, steps: usize },
    Greedy,
    Pencil { steps: usize },
    MaximumLikelihood,
    MaximumPosterior,
}

impl Rung {
    /// Whether the number of emitters is chosen by the frame's likelihood.
    pub(crate) fn is_ordering(&self) -> bool {
        matches!(self.method, Method::MaximumLikelihood | Method::MaximumPosterior)
    }
}

/// Every rung offered, cheapest first.
pub const LADDER: &[Rung] = &[
    Rung {
        name: "peak",
        summary: "maxima of the matched filter on its grid, after non-maximum suppression",
        method: Method::Peak {
            is_subpixel: false,
            steps: 0,
        },
    },
    Rung {
        name: "subpixel-peak",
        summary: "the same with a parabola through each maximum",
        method: Method::Peak {
            is_subpixel: true,
            steps: 0,
        },
    },
    Rung {
        name: "peak-fit",
        summary: "the same, and five steps of the joint fit",
        method: Method::Peak {
            is_subpixel: true,
            steps: 5,
        },
    },
    Rung {
        name: "greedy-fit",
        summary: "residual peaks added one round at a time, all emitters refitted jointly",
        method: Method::Greedy,
    },
    Rung {
        name: "pencil",
        summary: "half-kernel matrix pencil where spots overlap, amplitudes by least squares",
        method: Method::Pencil { steps: 0 },
    },
    Rung {
        name: "pencil-fit",
        summary: "the pencil's seeds and five steps of the joint fit",
        method: Method::Pencil { steps: 5 },
    },
    Rung {
        name: "ml",
        summary: "maximum likelihood: pencil or greedy seeds, moves, the number of emitters by a false-alarm test",
        method: Method::MaximumLikelihood,
    },
    Rung {
        name: "map",
        summary: "the same, then the most probable hypothesis where users' power is known (`[estimator.known_power]`)",
        method: Method::MaximumPosterior,
    },
];

/// The rung used when none is named.
pub const DEFAULT: &str = "ml";

/// A rung that a network stands in front of.
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
    LADDER
        .iter()
        .map(|r| r.name)
        .chain(learned)
        .collect::<Vec<_>>()
        .join(", ")
}

/// The rung of that name.
pub fn rung(name: &str) -> Result<&'static Rung, ConfigError> {
    LADDER
        .iter()
        .find(|r| r.name == name)
        .ok_or_else(|| ConfigError::UnknownName {
            found: name.to_owned(),
            known: names(),
            nearest: LADDER
                .iter()
                .map(|r| r.name)
                .max_by(|a, b| strsim::jaro_winkler(name, a).total_cmp(&strsim::jaro_winkler(name, b)))
                .unwrap_or(DEFAULT),
        })
}
