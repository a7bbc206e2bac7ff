//! Estimators, frames, and where their emitters are.

use jiff::Timestamp;
use ndarray::Array2;
use oapwatch::estimate::{Config, Estimate, Estimator, build};
use oapwatch::frame::Frame;
use oapwatch::optics::Camera;

/// The estimator of this name, or the default.
pub fn estimator(name: Option<&str>, camera: &Camera) -> Box<dyn Estimator> {
    let config = Config {
        name: name.map(str::to_owned),
        ..Default::default()
    };
    build(&config, camera).unwrap()
}

pub fn frame(pixels: Array2<f64>) -> Frame {
    Frame {
        index: 0,
        time: Timestamp::UNIX_EPOCH,
        pixels,
        masked: None,
        exposure_s: None,
        energy_scale: 1.0,
    }
}

pub fn places(estimate: &Estimate) -> Vec<[f64; 2]> {
    estimate.emitters.iter().map(|e| [e.x_m, e.y_m]).collect()
}
