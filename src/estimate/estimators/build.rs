//! Builds an estimator from a config.

use crate::estimate::config::{Config, ConfigError};
use crate::estimate::estimator::Estimator;
use crate::estimate::estimators::analytic::AnalyticEstimator;
use crate::estimate::estimators::list::{DEFAULT, Learned, Method, find};
use crate::estimate::estimators::network::NetworkEstimator;
use crate::estimate::estimators::pixel_correction::PixelCorrected;
use crate::estimate::estimators::windowed::WindowedEstimator;
use crate::estimate::sequence::{LensWatch, SensorWatch, SequenceEstimator};
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
    if !(0.1..=3600.0).contains(&config.memory_s()) {
        return Err(ConfigError::OutOfRange {
            field: "memory_s",
            expected: "0.1 to 3600 (seconds; nobody walks straight on for an hour)",
            found: config.memory_s(),
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
        None => {
            let spec = find(name)?;
            let single = || AnalyticEstimator::new(spec, camera, config.known_power.as_ref(), config.rules);
            match spec.method {
                Method::Sequence => {
                    let rules = config.rules;
                    let together = SequenceEstimator::new(spec, single(), camera, config.memory_s(), rules);
                    let watched: Box<dyn Estimator> = if rules.watch_lens && !WindowedEstimator::suits(camera, rules) {
                        let alone = AnalyticEstimator::new(find(DEFAULT)?, camera, None, rules);
                        Box::new(LensWatch::new(together, alone))
                    } else {
                        Box::new(together)
                    };
                    match rules.watch_sensor {
                        true => Box::new(SensorWatch::new(watched, camera)),
                        false => watched,
                    }
                }
                Method::MaximumLikelihood if WindowedEstimator::suits(camera, config.rules) => {
                    Box::new(WindowedEstimator::new(spec, camera, config.rules))
                }
                // Through a measured lens one pixel may be a spot.
                Method::MaximumLikelihood if config.rules.watch_sensor && camera.spot_shape.is_some() => {
                    Box::new(SensorWatch::of_pixels(Box::new(single()), camera))
                }
                _ => Box::new(single()),
            }
        }
    };
    Ok(match &camera.pixels {
        Some(maps) => Box::new(PixelCorrected::new(estimator, maps.clone(), camera.saturation_j)),
        None => estimator,
    })
}
