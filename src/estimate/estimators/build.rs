//! Builds an estimator from a config.

use crate::estimate::config::{Config, ConfigError};
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::{DEFAULT, Learned, find};
use crate::estimate::estimators::network::NetworkEstimator;
use crate::estimate::estimators::pixel_correction::PixelCorrected;
use crate::optics::Camera;

/// Builds the configured estimator for a camera.
pub fn build(config: &Config, camera: &Camera) -> Result<Box<dyn Estimator>, ConfigError> {
    // Frames are small: threads cost more than they gain, and make the last bits depend on timing.
    faer::set_global_parallelism(faer::Par::Seq);
    let name = config.name.as_deref().unwrap_or(DEFAULT);
    if let Some(budget) = config.budget_ms
        && !(1e-3..=60_000.0).contains(&budget)
    {
        return Err(ConfigError::OutOfRange {
            field: "budget_ms",
            expected: "0.001 to 60000 (milliseconds; a frame that takes a minute comes too late)",
            found: budget,
        });
    }
    if let Some(known) = &config.known_power {
        known.validate()?;
    }
    let estimator: Box<dyn Estimator> = match Learned::ALL.into_iter().find(|l| l.name() == name) {
        Some(learned) => Box::new(NetworkEstimator::new(
            learned,
            config.network.as_deref(),
            camera,
            config.rules,
        )?),
        None => Box::new(AnalyticEstimator::new(
            find(name)?,
            camera,
            config.known_power.as_ref(),
            config.rules,
        )),
    };
    Ok(match &camera.pixels {
        Some(maps) => Box::new(PixelCorrected::new(estimator, maps.clone(), camera.saturation_j)),
        None => estimator,
    })
}
