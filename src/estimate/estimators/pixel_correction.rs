//! Corrects a frame's gains and dark levels by the calibration before an estimator sees it.

use std::sync::Arc;

use crate::estimate::emitter::Estimate;
use crate::estimate::error::Error;
use crate::estimate::estimator::Estimator;
use crate::frame::Frame;
use crate::geo::Sight;
use crate::optics::{PixelMaps, Smear};

/// An estimator that is given corrected frames.
pub(crate) struct PixelCorrected {
    inner: Box<dyn Estimator>,
    maps: Arc<PixelMaps>,
    saturation_j: Option<f64>,
    frame: Option<Frame>,
}

impl PixelCorrected {
    pub fn new(inner: Box<dyn Estimator>, maps: Arc<PixelMaps>, saturation_j: Option<f64>) -> Self {
        Self {
            inner,
            maps,
            saturation_j,
            frame: None,
        }
    }
}

impl Estimator for PixelCorrected {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn set_smear(&mut self, smear: Option<&Smear>) {
        self.inner.set_smear(smear);
    }

    fn set_sight(&mut self, sight: Option<&Sight>) {
        self.inner.set_sight(sight);
    }

    fn estimate_until(&mut self, frame: &Frame, is_over: &dyn Fn() -> bool) -> Result<Estimate, Error> {
        let own = match &mut self.frame {
            Some(own) if own.pixels.dim() == frame.pixels.dim() => {
                own.index = frame.index;
                own.time = frame.time;
                own.pixels.assign(&frame.pixels);
                own.masked.clone_from(&frame.masked);
                own.exposure_s = frame.exposure_s;
                own.energy_scale = frame.energy_scale;
                own
            }
            own => own.insert(frame.clone()),
        };
        self.maps.correct(own, self.saturation_j);
        self.inner.estimate_until(own, is_over)
    }
}
