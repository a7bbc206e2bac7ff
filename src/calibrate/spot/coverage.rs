//! Whether the spots stand on enough places: within the pixel for the shape, over the sensor for its change.

use super::learn::Learner;
use crate::optics::Camera;

/// Cells of a pixel.
pub const CELLS: usize = 16;

/// Spots of a recording by where they stand.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Coverage {
    /// Sixteenths of a pixel, 4 × 4, on which spots stand.
    pub phases: usize,
    /// Ninths of the sensor, 3 × 3, on which spots stand.
    pub field: usize,
}

/// Least share of all spots that makes a cell count, and least number.
const SHARE: f64 = 0.01;
const LEAST: usize = 2;
/// Phases needed where the spot is narrower than [`WELL_SAMPLED`] pixels, and where it is wider: pixels then overlap it more finely, but
/// a few places cannot tell the shape from the pixels' gains.
const PHASES_NARROW: usize = 12;
const PHASES_WIDE: usize = 8;
const WELL_SAMPLED: f64 = 2.0;
/// Ninths of the sensor from which a change over it is fitted.
const FIELD: usize = 8;

impl Coverage {
    pub(super) fn of(learner: &Learner) -> Self {
        let camera = learner.camera;
        let (mut phases, mut field) = ([0; CELLS], [0; 9]);
        for source in learner.patches.iter().flat_map(|p| &p.sources) {
            let place = |k: usize| {
                let axis = [&camera.x, &camera.y][k];
                (source.at[k] - axis.min_m) / axis.pitch_m
            };
            let cell = |k: usize, n: usize, t: f64| ((t * n as f64) as usize).min(n - 1) * n.pow(k as u32);
            let phase = |k: usize| cell(k, 4, place(k).rem_euclid(1.0));
            let third = |k: usize| {
                let axis = [&camera.x, &camera.y][k];
                cell(k, 3, (place(k) / axis.n as f64).clamp(0.0, 1.0))
            };
            phases[phase(0) + phase(1)] += 1;
            field[third(0) + third(1)] += 1;
        }
        let least = ((SHARE * learner.sources() as f64) as usize).max(LEAST);
        let count = |cells: &[usize]| cells.iter().filter(|c| **c >= least).count();
        Self {
            phases: count(&phases),
            field: count(&field),
        }
    }

    /// Phases that are needed for a camera's spots.
    pub(super) fn needed(camera: &Camera) -> usize {
        let width = camera.spot_sigma_m / camera.x.pitch_m.min(camera.y.pitch_m);
        match width < WELL_SAMPLED {
            true => PHASES_NARROW,
            false => PHASES_WIDE,
        }
    }

    /// Whether the spots stand all over the sensor.
    pub fn is_field_covered(&self) -> bool {
        self.field >= FIELD
    }
}
