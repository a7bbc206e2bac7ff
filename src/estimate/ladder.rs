//! The ladder of estimators: what each rung does, and building one from a config.

use std::time::Duration;

use super::analytic::Analytic;
use super::corrected::Corrected;
use super::learned::{Learned, LearnedEstimator};
use super::network::NetworkError;
use super::{Config, Estimator};
use crate::optics::Camera;

/// A rung of the ladder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rung {
    /// What `[estimator] name` selects it by.
    pub name: &'static str,
    pub summary: &'static str,
    pub(super) method: Method,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Method {
    Peak { is_subpixel: bool, steps: usize },
    Greedy,
    Pencil { steps: usize },
    MaximumLikelihood,
    MaximumPosterior,
}

impl Rung {
    /// Whether the number of emitters is chosen by the frame's likelihood.
    pub(super) fn is_ordering(&self) -> bool {
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

/// Why an `[estimator]` table describes no estimator.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error(
        "estimator.name: no estimator {found:?}; did you mean {nearest:?}? There are {}",
        names()
    )]
    UnknownName { found: String, nearest: &'static str },
    #[error("estimator.{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error(transparent)]
    Network(#[from] NetworkError),
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
            nearest: LADDER
                .iter()
                .map(|r| r.name)
                .max_by(|a, b| strsim::jaro_winkler(name, a).total_cmp(&strsim::jaro_winkler(name, b)))
                .unwrap_or(DEFAULT),
        })
}

/// Builds the configured estimator for a camera.
pub fn build(config: &Config, camera: &Camera) -> Result<Box<dyn Estimator>, ConfigError> {
    // Frames are small: threads would cost more than they bring, and let the clock decide the last bits.
    faer::set_global_parallelism(faer::Par::Seq);
    let name = config.name.as_deref().unwrap_or(DEFAULT);
    if let Some(budget) = config.budget_ms
        && !(budget.is_finite() && budget > 0.0)
    {
        return Err(ConfigError::OutOfRange {
            field: "budget_ms",
            expected: "a positive finite number",
            found: budget,
        });
    }
    if let Some(known) = &config.known_power {
        known.validate()?;
    }
    let budget = config.budget_ms.map(|ms| Duration::from_secs_f64(ms * 1e-3));
    let estimator: Box<dyn Estimator> = match Learned::ALL.into_iter().find(|l| l.name() == name) {
        Some(learned) => Box::new(LearnedEstimator::new(learned, config.network.as_deref(), camera)?),
        None => Box::new(Analytic::new(rung(name)?, camera, budget, config.known_power.as_ref())),
    };
    Ok(match &camera.pixels {
        Some(maps) => Box::new(Corrected::new(estimator, maps.clone(), camera.saturation_j)),
        None => estimator,
    })
}
