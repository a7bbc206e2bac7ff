//! `[estimator]` and why it may be refused.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::estimate::detect::heatmap_network::NetworkError;
use crate::estimate::rules::Rules;

/// `[estimator]`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The name of an estimator; [`crate::estimate::DEFAULT`] when left out.
    pub name: Option<String>,
    /// ONNX file of the `network` and `hybrid` estimators, its card beside it; the embedded one when left out.
    pub network: Option<PathBuf>,
    /// Time allowed a frame, ms; the best hypothesis reached by then is returned. Whoever holds the clock passes the test to
    /// [`Estimator::estimate_until`](crate::estimate::Estimator::estimate_until); see [`Config::budget`].
    pub budget_ms: Option<f64>,
    /// How long the `sequence` estimator remembers, s: what frames said fades with this time constant, and after a gap this long nothing is
    /// left.
    pub memory_s: Option<f64>,
    /// What the `map` estimator may assume of users' power; without it `map` is `ml`.
    pub known_power: Option<KnownPower>,
    /// The rules in force; all, but where a study measures what one of them gains.
    #[serde(skip)]
    pub rules: Rules,
}

impl Config {
    /// How long the `sequence` estimator remembers: as long as people walk straight on.
    const MEMORY_S: f64 = 60.0;

    /// How long the `sequence` estimator remembers, s.
    pub fn memory_s(&self) -> f64 {
        self.memory_s.unwrap_or(Self::MEMORY_S)
    }

    /// Time allowed a frame.
    pub fn budget(&self) -> Option<Duration> {
        self.budget_ms.map(|ms| Duration::from_secs_f64(ms * 1e-3))
    }
}

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
        if let Some(&energy) = self.energies_j.iter().find(|e| !(1e-30..=1e6).contains(*e)) {
            return outside(
                "known_power.energies_j",
                "numbers from 1e-30 to 1e6 (joules per exposure)",
                energy,
            );
        }
        if !(1e-6..=10.0).contains(&self.relative_std) {
            return outside(
                "known_power.relative_std",
                "1e-6 to 10 (fading scatters by less than its mean several times over)",
                self.relative_std,
            );
        }
        if !(self.share > 0.0 && self.share < 1.0) {
            return outside("known_power.share", "a number between 0 and 1", self.share);
        }
        if !(0.0..=1.0).contains(&self.attenuation_per_m) {
            return outside(
                "known_power.attenuation_per_m",
                "0 to 1 (per metre; more lets no light through)",
                self.attenuation_per_m,
            );
        }
        Ok(())
    }
}

/// Why an `[estimator]` table describes no estimator.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    #[error("estimator.name: no estimator {found:?}; did you mean {nearest:?}? There are {known}")]
    UnknownName {
        found: String,
        nearest: &'static str,
        /// All names, as a list.
        known: String,
    },
    #[error("estimator.{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error(transparent)]
    Network(#[from] NetworkError),
}
