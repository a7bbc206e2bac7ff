//! An error of the platform's pose.

use nalgebra::{Rotation3, Vector3, Vector6};

use crate::pose::swap_ned_enu;

/// A turn about north, east, down, rad, and a shift east, north, up, m, with the rotation that the turn is in the axes of the ground.
#[derive(Clone, Debug)]
pub struct PoseError {
    vector: Vector6<f64>,
    pub(super) turn: Rotation3<f64>,
}

impl Default for PoseError {
    fn default() -> Self {
        Self::of(Vector6::zeros())
    }
}

impl PoseError {
    pub fn of(vector: Vector6<f64>) -> Self {
        let turn = swap_ned_enu(vector.fixed_rows::<3>(0).into());
        Self {
            vector,
            turn: Rotation3::from_scaled_axis(turn),
        }
    }

    pub fn vector(&self) -> &Vector6<f64> {
        &self.vector
    }

    pub(super) fn shift_m(&self) -> Vector3<f64> {
        self.vector.fixed_rows::<3>(3).into()
    }
}
