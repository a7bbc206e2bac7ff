//! Model errors that the estimator is not given, and the bound under each.

use ndarray::Array2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::estimate::{BoundAssumptions, PsfShape, position_bound_with};
use crate::optics::{Axis, Camera, psf};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Condition {
    /// Spots 5 % wider than configured.
    Width,
    /// Spots 5 % longer along the array's diagonal and 5 % narrower across it.
    Ellipse,
    /// Even light, a fifth of a typical peak.
    Background,
    /// 12 bits up to twice a typical peak.
    Quantised,
    /// Clipped at six tenths of a typical peak; the level is configured.
    Saturated,
    /// One pixel in a hundred reads nothing.
    Dead,
    /// One pixel in a hundred is off by a normal variate of thirty times the noise, another one in every frame.
    Spikes,
    /// Every pixel's gain is off by a normal variate of a hundredth, another one in every frame. The bound knows the gains: r is far above
    /// 1. Only [`super::Plan::ablation`] asks for it.
    Gains,
}

const WIDER: f64 = 1.05;
const ELLIPSE: [f64; 2] = [1.05, 0.95];
const LIGHT: f64 = 0.2;
const LEVELS: f64 = 4095.0;
const HEADROOM: f64 = 2.0;
const CLIP: f64 = 0.6;
const DEAD: f64 = 0.01;
const SPIKE: f64 = 30.0;
const GAIN: f64 = 0.01;

impl Condition {
    pub const ALL: [Self; 7] = [
        Self::Width,
        Self::Ellipse,
        Self::Background,
        Self::Quantised,
        Self::Saturated,
        Self::Dead,
        Self::Spikes,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::Width => "width+5%",
            Self::Ellipse => "ellipse",
            Self::Background => "background",
            Self::Quantised => "12-bit",
            Self::Saturated => "saturated",
            Self::Dead => "dead",
            Self::Spikes => "spikes",
            Self::Gains => "gains",
        }
    }

    /// The camera as it is configured under the condition. `energy_j`: typical of an emitter.
    pub(super) fn configured(self, camera: &mut Camera, energy_j: f64) {
        if self == Self::Saturated {
            camera.saturation_j = Some(CLIP * typical_peak(camera, energy_j));
        }
    }

    /// The camera that frames are made with.
    pub(super) fn lens(condition: Option<Self>, camera: &Camera) -> Camera {
        let mut truth = camera.clone();
        truth.spot_sigma_m *= match condition {
            Some(Self::Width) => WIDER,
            Some(Self::Ellipse) => ELLIPSE[1],
            _ => 1.0,
        };
        truth
    }

    /// The Gaussians that a spot consists of: offsets in x and y, and shares.
    pub(super) fn parts(condition: Option<Self>, camera: &Camera) -> Vec<([f64; 2], f64)> {
        if condition != Some(Self::Ellipse) {
            return vec![([0.0; 2], 1.0)];
        }
        // A round spot smeared by a Gaussian along the diagonal; sums of Gaussians half their σ apart are exact to rounding.
        let smear = camera.spot_sigma_m * (ELLIPSE[0].powi(2) - ELLIPSE[1].powi(2)).sqrt();
        (-12..=12)
            .map(|k| 0.5 * f64::from(k))
            .map(|t| {
                let share = 0.5 * (-0.5 * t * t).exp() / std::f64::consts::TAU.sqrt();
                ([t * smear * std::f64::consts::FRAC_1_SQRT_2; 2], share)
            })
            .collect()
    }

    /// Does to a frame what the condition does; returns each emitter's bound, m², with what is to be estimated under it, and the
    /// same where energies are known to `relative_std` beforehand.
    pub(super) fn apply(
        condition: Option<Self>,
        truth: &Camera,
        pixels: &mut Array2<f64>,
        positions: &[[f64; 2]],
        energies: &[f64],
        relative_std: f64,
        rng: &mut ChaCha8Rng,
    ) -> [Vec<f64>; 2] {
        let mean = energies.iter().sum::<f64>() / energies.len().max(1) as f64;
        let peak = typical_peak(truth, mean);
        let mut camera = truth.clone();
        let mut beside = BoundAssumptions::default();
        let mut unusable = vec![false; pixels.len()];
        match condition {
            None => {}
            Some(Self::Width) => beside.shape = PsfShape::Width,
            Some(Self::Ellipse) => {
                beside.shape = PsfShape::Ellipse;
                camera.spot_sigma_m /= ELLIPSE[1];
            }
            Some(Self::Background) => {
                beside.background = true;
                *pixels += LIGHT * peak;
            }
            Some(Self::Quantised) => {
                let step = HEADROOM * peak / LEVELS;
                pixels.mapv_inplace(|p| (p / step).round() * step);
                camera.noise_std_j = (camera.noise_std_j.powi(2) + step * step / 12.0).sqrt();
            }
            Some(Self::Saturated) => {
                let level = truth.saturation_limit_j();
                for (pixel, bad) in pixels.iter_mut().zip(&mut unusable) {
                    *bad = *pixel >= level;
                    *pixel = pixel.min(level);
                }
            }
            Some(Self::Dead) => {
                for (pixel, bad) in pixels.iter_mut().zip(&mut unusable) {
                    if rng.random_bool(DEAD) {
                        (*pixel, *bad) = (0.0, true);
                    }
                }
            }
            Some(Self::Spikes) => {
                for (pixel, bad) in pixels.iter_mut().zip(&mut unusable) {
                    if rng.random_bool(DEAD) {
                        let spike: f64 = StandardNormal.sample(rng);
                        *pixel += SPIKE * truth.noise_std_j * spike;
                        *bad = true;
                    }
                }
            }
            Some(Self::Gains) => {
                for pixel in pixels.iter_mut() {
                    let gain: f64 = StandardNormal.sample(rng);
                    *pixel *= 1.0 + GAIN * gain;
                }
            }
        }
        beside.masked = Some(&unusable);
        let known: Vec<f64> = energies.iter().map(|e| e * relative_std).collect();
        [None, Some(known.as_slice())]
            .map(|known| position_bound_with(&camera, positions, energies, BoundAssumptions { known, ..beside }))
    }
}

/// The brightest pixel of a spot of that energy in the mean light of as many others as a frame typically holds.
fn typical_peak(camera: &Camera, energy_j: f64) -> f64 {
    const OTHERS: f64 = 6.0;
    let half = |axis: &Axis| psf::pixel_fraction(-0.5 * axis.pitch_m, 0.5 * axis.pitch_m, 0.0, camera.spot_sigma_m);
    energy_j * (half(&camera.x) * half(&camera.y) + OTHERS / (camera.x.n * camera.y.n) as f64)
}
