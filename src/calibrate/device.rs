//! The device parameters that all frames share, and their prior.

use crate::optics::{Camera, Distortion};

/// Distortion, ln σ_eff, spot growth.
pub(super) const DEVICE: usize = Distortion::PARAMETERS + 2;

/// Gaussian prior of the device parameters: wide compared with real lenses, so that it decides only what few beacons leave
/// undetermined.
pub(super) struct Prior {
    pub mean: [f64; DEVICE],
    pub std: [f64; DEVICE],
}

impl Prior {
    pub fn of(camera: &Camera) -> Self {
        let half = camera.x.half_width().min(camera.y.half_width());
        let r = camera.x.half_width().hypot(camera.y.half_width()) / camera.plane_distance_m;
        Self {
            mean: device_of(&Camera {
                distortion: Distortion::default(),
                spot_growth: 0.0,
                ..camera.clone()
            }),
            std: [
                0.1 * half,
                0.1 * half,
                0.1,
                0.1 / r.powi(2),
                0.05 / r.powi(4),
                0.02 / r.powi(6),
                0.02 / r,
                0.02 / r,
                0.3,
                0.3,
            ],
        }
    }

    pub fn cost(&self, device: &[f64; DEVICE]) -> f64 {
        (0..DEVICE)
            .map(|k| ((device[k] - self.mean[k]) / self.std[k]).powi(2))
            .sum()
    }
}

/// The device parameters of a camera, in the order of [`Prior`].
pub(super) fn device_of(camera: &Camera) -> [f64; DEVICE] {
    let d = camera.distortion.parameters();
    std::array::from_fn(|k| match k {
        k if k < Distortion::PARAMETERS => d[k],
        k if k == Distortion::PARAMETERS => camera.spot_sigma_m.ln(),
        _ => camera.spot_growth,
    })
}

/// Writes device parameters into a camera.
pub(super) fn set_device(camera: &mut Camera, device: &[f64; DEVICE]) {
    camera.distortion = Distortion::from_parameters(std::array::from_fn(|k| device[k]));
    camera.spot_sigma_m = device[Distortion::PARAMETERS].exp();
    camera.spot_growth = device[Distortion::PARAMETERS + 1];
}
