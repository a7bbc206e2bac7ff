//! What the estimator makes of a recorded frame: the emitters, the frame that they predict, and the residual.

use std::sync::{Mutex, PoisonError};

use ndarray::Array2;

use crate::estimate::{self, Emitter};
use crate::frame::Frame;
use crate::optics::{self, Camera};

/// Turns recorded frames into fits, one at a time: pictures that are asked for together must not take the cores that the live
/// frames need.
pub struct Fitter {
    config: estimate::Config,
    turn: Mutex<()>,
}

/// A frame as it was explained.
#[derive(Debug)]
pub struct Fit {
    pub emitters: Vec<Emitter>,
    /// Corrected by the pixel maps, J; what the model is compared with.
    pub data: Frame,
    /// Expected energy of each pixel, J, shape (Ny, Nx).
    pub model: Array2<f64>,
    /// Data minus model in standard deviations of the pixel's noise; NaN where a pixel is masked.
    pub residual: Array2<f64>,
}

impl Fitter {
    pub fn new(config: estimate::Config) -> Self {
        Self {
            config,
            turn: Mutex::new(()),
        }
    }

    /// The fit of one frame; takes as long as a live frame does. `None` where the estimator cannot use it.
    pub fn fit(&self, camera: &Camera, mut frame: Frame) -> Option<Fit> {
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let mut estimator = estimate::build(&self.config, camera).ok()?;
        let emitters = estimator.estimate(&frame).ok()?.emitters;
        if let Some(maps) = &camera.pixels {
            maps.correct(&mut frame, camera.saturation_j);
        }
        let model = predicted(camera, &emitters);
        let mut residual = &frame.pixels - &model;
        if let Some(masked) = frame.masked.as_ref().filter(|masked| masked.dim() == residual.dim()) {
            residual.zip_mut_with(masked, |r, masked| *r = if *masked { f64::NAN } else { *r });
        }
        let sigma = match camera.noise_std_j {
            known if known > 0.0 => known,
            _ => spread(&residual),
        };
        residual /= sigma;
        Some(Fit {
            emitters,
            data: frame,
            model,
            residual,
        })
    }
}

/// The frame that emitters give, J, no brighter than a pixel can be.
fn predicted(camera: &Camera, emitters: &[Emitter]) -> Array2<f64> {
    let (ny, nx) = camera.shape();
    let mut model = vec![0.0; ny * nx];
    for emitter in emitters {
        optics::add_spot(camera, emitter.sensor_m, emitter.energy_j, &mut model);
    }
    let model = Array2::from_shape_vec((ny, nx), model).expect("one value a pixel");
    let ceiling = camera.saturation_j.unwrap_or(f64::INFINITY);
    model.mapv_into(|value: f64| value.min(ceiling))
}

/// Standard deviation of what most pixels show, from the median magnitude (Gaussian); positive.
fn spread(residual: &Array2<f64>) -> f64 {
    let mut values: Vec<f64> = residual.iter().map(|r| r.abs()).filter(|r| r.is_finite()).collect();
    if values.is_empty() {
        return 1.0;
    }
    let middle = values.len() / 2;
    let (_, median, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    (1.4826 * *median).max(f64::MIN_POSITIVE)
}
