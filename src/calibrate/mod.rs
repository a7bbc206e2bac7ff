//! Layer 2: fits the camera, the spot and the pixel maps to frames with known positions, or without.

mod bad_pixels;
mod bundle;
mod cross_validation;
mod device;
mod exposure;
pub mod file;
pub mod first_look;
mod maps;
pub mod photon_transfer;
mod sources;
pub mod spot;
mod survey_residuals;
pub mod truth;

use std::fmt::{self, Display, Formatter};

use ndarray::Array2;

use crate::estimate::{self, Estimator, is_usable};
use crate::optics::{Calibration, CalibrationError, Camera};
pub use cross_validation::Score;
use exposure::Exposure;
use truth::Beacon;

/// Result of a fit.
#[derive(Clone, Debug)]
pub struct Fitted {
    pub calibration: Calibration,
    /// Median reduced χ² of the inlier frames.
    pub reduced_chi2: f64,
    /// Standard deviation per axis of the surveyed positions around their spots, in excess of the pixel noise, m on the ground.
    pub survey_std_m: f64,
    /// Beacons whose positions were used.
    pub accepted: Vec<Beacon>,
    /// Beacons whose positions were rejected: no light there, or too far from it.
    pub rejected: Vec<Beacon>,
    /// Frames that the model does not explain.
    pub unexplained: Vec<usize>,
}

/// A calibration with its cross-validation.
#[derive(Clone, Debug)]
pub struct Calibrated {
    /// Fitted to all frames.
    pub fitted: Fitted,
    pub frames: usize,
    /// What the same frames teach of the spot beside the Gaussian or the shape that was fitted with.
    pub spot: Result<spot::Learned, spot::Error>,
    /// Score of the camera before calibration on the held-out frames.
    pub before: Score,
    /// Score of the camera fitted to the other frames on the held-out frames.
    pub after: Score,
}

/// Factor on the noise that the estimator predicts, up to which a residual counts as noise: covariances are right to some ten
/// per cent in median, and gains that no calibration removes add to them.
const NOISE_ALLOWANCE: f64 = 2.0;

impl Calibrated {
    /// Median squared distance of the held-out positions from the emitters, in excess of the noise, where it is larger than what
    /// the calibration gained, m². Such positions do not describe the frames: they are of another time, or of other frames.
    pub fn unexplained_m2(&self) -> Option<f64> {
        let excess = self.after.median_m2 - NOISE_ALLOWANCE * self.after.noise_median_m2;
        let gained = self.before.median_m2 - self.after.median_m2;
        (excess > gained.max(0.0)).then_some(excess)
    }
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("expected at least {MIN_FRAMES} frames with positions in view, found {frames}")]
    TooLittle { frames: usize },
    #[error(transparent)]
    Estimator(#[from] estimate::ConfigError),
    #[error("the frames and positions lead to no usable calibration: {0}")]
    Unusable(#[from] CalibrationError),
}

/// Progress of a fit.
struct Progress {
    stage: &'static str,
    round: usize,
    reduced_chi2: f64,
    survey_std_m: f64,
}

impl Display for Progress {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { stage, round, .. } = self;
        let (chi2, std) = (self.reduced_chi2, self.survey_std_m);
        write!(
            f,
            "{stage}: round {round}, reduced χ² {chi2:.3}, positions within {std:.3} m"
        )
    }
}

/// Fewest frames: cross-validation needs one of each five.
const MIN_FRAMES: usize = 5;
/// One frame in this many is held out.
const HELD_OUT: usize = 5;

/// Fits to four frames in five, scores the fifth with the estimators that `build` makes, and refits to all. Where the fitted spot leaves
/// a shape to be learned, the fits are made with that.
pub fn calibrate(
    camera: &Camera,
    frames: &[(usize, &Array2<f64>)],
    beacons: &[Beacon],
    build: &mut dyn FnMut(&Camera) -> Result<Box<dyn Estimator>, estimate::ConfigError>,
    progress: &mut dyn FnMut(&dyn Display),
) -> Result<Calibrated, Error> {
    if frames.len() < MIN_FRAMES {
        return Err(Error::TooLittle { frames: frames.len() });
    }
    let is_held = |k: usize| k % HELD_OUT == HELD_OUT / 2;
    let part = |held: bool| -> Vec<(usize, &Array2<f64>)> {
        let chosen = frames.iter().enumerate().filter(|(k, _)| is_held(*k) == held);
        chosen.map(|(_, frame)| *frame).collect()
    };
    let (held, fitted_to) = (part(true), part(false));
    const FIRST: &str = "fitting to four frames in five";
    let fit = |start: &Camera, frames: &[(usize, &Array2<f64>)], stage, progress: &mut dyn FnMut(&dyn Display)| {
        fit(start, frames, beacons, &mut |round, reduced_chi2, survey_std_m| {
            progress(&Progress {
                stage,
                round,
                reduced_chi2,
                survey_std_m,
            });
        })
    };
    let fitted = fit(camera, &fitted_to, FIRST, progress);
    let mut trial = fitted.calibration.applied_to(camera)?;
    // What a wrong shape did to noise and pixels is not kept; estimators do not use the growth, and do a shape that changes.
    let with_its_spot = Calibration {
        spot_growth: 0.0,
        noise_std_j: camera.noise_std_j,
        pixels: camera.pixels.clone(),
        ..Calibration::of(&trial)
    };
    let spot = spot::learn(&with_its_spot.applied_to(camera)?, &fitted_to, &mut |p| progress(&p));
    if let Ok(learned) = &spot
        && learned.is_shape_better
    {
        let with_shape = learned.calibration.applied_to(&trial)?;
        let fitted = fit(&with_shape, &fitted_to, FIRST, progress);
        trial = fitted.calibration.applied_to(&with_shape)?;
    }
    let before = cross_validation::score(&mut *build(camera)?, &held, beacons);
    let after = cross_validation::score(&mut *build(&trial)?, &held, beacons);
    let fitted = fit(&trial, frames, "fitting to all frames", progress);
    fitted.calibration.applied_to(camera)?;
    Ok(Calibrated {
        fitted,
        frames: frames.len(),
        spot,
        before,
        after,
    })
}

/// Fits the device to frames of shape (Ny, Nx), J. `frames` pairs each frame with its number; the fit starts from `camera`.
pub fn fit(
    camera: &Camera,
    frames: &[(usize, &Array2<f64>)],
    beacons: &[Beacon],
    progress: &mut dyn FnMut(usize, f64, f64),
) -> Fitted {
    let ceiling = camera.saturation_limit_j();
    let usable = |v: f64| is_usable(v, 1.0 / camera.noise_std_j, ceiling);
    let exposures = frames
        .iter()
        .map(|(frame, pixels)| Exposure {
            frame: *frame,
            pixels: pixels.iter().map(|v| if usable(*v) { *v } else { 0.0 }).collect(),
            valid: pixels.iter().map(|v| usable(*v)).collect(),
            spots: Vec::new(),
            background: Some([0.0; 3]),
            chi2: 0.0,
            is_inlier: true,
        })
        .collect();
    let mut fit = bundle::Fit::new(camera.clone(), exposures, beacons);
    fit.run(progress);
    let mut is_accepted = vec![false; beacons.len()];
    for exposure in fit.exposures.iter().filter(|s| s.is_inlier) {
        for spot in exposure.spots.iter().filter(|s| s.is_inlier) {
            if let Some(k) = spot.beacon {
                is_accepted[k] = true;
            }
        }
    }
    let among = |wanted: bool| {
        let here = |b: &Beacon| frames.iter().any(|(f, _)| *f == b.frame);
        let pairs = beacons.iter().zip(&is_accepted);
        pairs
            .filter(|(b, accepted)| **accepted == wanted && here(b))
            .map(|(b, _)| *b)
            .collect()
    };
    Fitted {
        calibration: Calibration::of(&fit.camera),
        reduced_chi2: fit.reduced_chi2(),
        survey_std_m: fit.survey_var_m2.sqrt() * fit.camera.ground_scale(),
        accepted: among(true),
        rejected: among(false),
        unexplained: fit.exposures.iter().filter(|s| !s.is_inlier).map(|s| s.frame).collect(),
    }
}
