//! Errors of a camera and its calibration.

use std::path::PathBuf;

use crate::toml_file::OutOfRange;

/// Why an `[optics]` table describes no camera.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    #[error("optics: give either spot_sigma_m or [optics.blur], not both")]
    TwoBlurs,
    #[error("optics.calibration: {0} was named but not read: only a config can name a calibration, a scene cannot")]
    CalibrationNotRead(PathBuf),
    #[error("optics.calibration: {0}")]
    Calibration(#[from] CalibrationError),
}

/// Why a calibration does not fit a camera.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    #[error("{map} map is {found_x} × {found_y} pixels, the camera has {expected_x} × {expected_y}")]
    WrongShape {
        map: &'static str,
        expected_x: usize,
        expected_y: usize,
        found_x: usize,
        found_y: usize,
    },
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    #[error("the distortion folds back within the sensor: no direction belongs to some of its points")]
    NotInvertible,
}
