//! Gain, dark level and bad pixels of frames whose spots were learned.

use ndarray::Array2;

use super::learn::Learner;
use super::prepare::Prepared;
use crate::calibrate::maps::{self, Pixels};
use crate::optics::PixelMaps;

/// Gains and dark levels that scatter by less than this, relative and in σ, are left alone: what the maps gain is below the noise of a
/// hundred frames.
const LEAST_GAIN: f64 = 2e-3;
const LEAST_DARK: f64 = 0.05;

/// Pixel maps, none where the pixels are alike.
pub fn estimate(learner: &Learner, prepared: &Prepared) -> Option<PixelMaps> {
    let camera = learner.camera;
    let (ny, nx) = camera.shape();
    let mut expected: Vec<Vec<f64>> = learner.images.iter().map(|i| vec![i.level; i.pixels.len()]).collect();
    for patch in &learner.patches {
        let values = patch.expected(camera, &learner.model);
        for (row, line) in patch.y.clone().zip(values.chunks_exact(patch.x.len())) {
            let start = row * nx + patch.x.start;
            expected[patch.frame][start..start + line.len()].copy_from_slice(line);
        }
    }
    let frames = learner.images.iter().zip(&expected).map(|(image, ideal)| Pixels {
        ideal: ideal.clone(),
        recorded: &image.pixels,
        used: image.weight.iter().map(|w| *w > 0.0).collect(),
    });
    let mut found = maps::estimate_from((ny, nx), learner.noise_j, frames)?;
    for p in &prepared.hot {
        found.bad[(p / nx, p % nx)] = true;
    }
    let n = (ny * nx) as f64;
    let dark = (found.dark_j.iter().map(|d| d * d).sum::<f64>() / n).sqrt();
    if gain_scatter(&found).is_none() {
        found.gain = Array2::ones((ny, nx));
    }
    if dark < LEAST_DARK * learner.noise_j {
        found.dark_j = Array2::zeros((ny, nx));
    }
    let is_ideal = found == PixelMaps::ideal((ny, nx));
    (!is_ideal).then_some(found)
}

/// Relative scatter of the gains; none below what counts.
pub fn gain_scatter(maps: &PixelMaps) -> Option<f64> {
    let scatter = (maps.gain.iter().map(|g| (g - 1.0).powi(2)).sum::<f64>() / maps.gain.len() as f64).sqrt();
    (scatter > LEAST_GAIN).then_some(scatter)
}
