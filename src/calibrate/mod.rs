//! Floor 2: what a device is, from frames with known positions.

mod bundle;
pub mod file;
mod maps;
mod shot;
pub mod truth;

use ndarray::Array2;

use crate::optics::{Calibration, Camera};
use shot::Shot;
use truth::Beacon;

/// What a fit found.
#[derive(Clone, Debug)]
pub struct Fitted {
    pub calibration: Calibration,
    /// Median reduced χ² of the frames that took part.
    pub reduced_chi2: f64,
    /// Standard deviation per axis of the surveyed positions around their spots beyond the pixel noise, m on the ground.
    pub survey_std_m: f64,
    /// Beacons whose positions took part.
    pub believed: Vec<Beacon>,
    /// Beacons whose positions did not: no light there, or too far from it.
    pub rejected: Vec<Beacon>,
    /// Frames that nothing explained.
    pub unexplained: Vec<usize>,
}

/// Fits the device to frames of shape (Ny, Nx) in joules. `frames` pairs each frame with its number; `camera` is where
/// the fit starts.
pub fn fit(
    camera: &Camera,
    frames: &[(usize, &Array2<f64>)],
    beacons: &[Beacon],
    progress: &mut dyn FnMut(usize, f64, f64),
) -> Fitted {
    let saturated = camera.saturation_j.unwrap_or(f64::INFINITY);
    let shots = frames
        .iter()
        .map(|(frame, pixels)| Shot {
            frame: *frame,
            pixels: pixels.iter().map(|v| if v.is_finite() { *v } else { 0.0 }).collect(),
            valid: pixels.iter().map(|v| v.is_finite() && *v < saturated).collect(),
            spots: Vec::new(),
            background: None,
            chi2: 0.0,
            trusted: true,
        })
        .collect();
    let mut fit = bundle::Fit::new(camera.clone(), shots, beacons);
    fit.run(progress);
    let mut is_believed = vec![false; beacons.len()];
    for shot in fit.shots.iter().filter(|s| s.trusted) {
        for spot in shot.spots.iter().filter(|s| s.trusted) {
            if let Some(k) = spot.beacon {
                is_believed[k] = true;
            }
        }
    }
    let among = |wanted: bool| {
        let here = |b: &Beacon| frames.iter().any(|(f, _)| *f == b.frame);
        let pairs = beacons.iter().zip(&is_believed);
        pairs
            .filter(|(b, believed)| **believed == wanted && here(b))
            .map(|(b, _)| *b)
            .collect()
    };
    Fitted {
        calibration: Calibration::of(&fit.camera),
        reduced_chi2: fit.reduced_chi2(),
        survey_std_m: fit.tether_m2.sqrt() * fit.camera.ground_scale(),
        believed: among(true),
        rejected: among(false),
        unexplained: fit.shots.iter().filter(|s| !s.trusted).map(|s| s.frame).collect(),
    }
}
