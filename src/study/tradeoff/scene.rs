//! The cells of the study: frames from the paper's scene, with truth and bounds.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Gamma, Normal};
use serde::{Deserialize, Serialize};

use super::{Condition, Error};
use crate::estimate::KnownPower;
use crate::estimate::{BoundAssumptions, position_bound_with};
use crate::frame::Frame;
use crate::optics::{self, Camera, Smear, psf, radiometry};

/// Which reading of the paper's N₀ = 10⁻¹² a cell takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Noise {
    /// σ_n = 10⁻⁶ J.
    Energy,
    /// The same signal-to-noise ratio as the paper's literal formula: σ_n = 10⁻⁶·2π σ_eff².
    Paper,
}

/// One setting: its frames are drawn from the paper's scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    pub noise: Noise,
    pub sigma_mm: f64,
    /// Pixels a side.
    pub pixels: usize,
    /// Emitters a frame; 5 to 9 when left out.
    pub emitters: Option<usize>,
    /// The model error that the estimator is not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub condition: Option<Condition>,
}

/// A frame with its truth.
pub(in crate::study) struct Scene {
    pub frame: Frame,
    pub positions: Vec<[f64; 2]>,
    pub bound_m2: Vec<f64>,
    /// The same for who knows what users send with.
    pub known_bound_m2: Vec<f64>,
}

pub(super) const AREA_HALF_M: f64 = 125.0;
const POWER_W: f64 = 1.0;
const BEAM_RADIUS_M: f64 = 0.6;
const POINTING_STD_M: f64 = 0.1;
/// τ·η_s·T_int.
const COLLECTED: f64 = 0.9 * 0.9;
const ATTENUATION_PER_M: f64 = 1e-3;
/// (α, β) of the Gamma–Gamma fading, and the coherence times within one exposure.
const FADING: [f64; 2] = [4.0, 2.0];
const COHERENCE_TIMES: usize = 100;

impl Cell {
    pub fn new(noise: Noise, sigma_mm: f64, pixels: usize) -> Self {
        Self {
            noise,
            sigma_mm,
            pixels,
            emitters: None,
            condition: None,
        }
    }

    /// The same cell with a fixed number of emitters.
    pub fn holding(self, emitters: usize) -> Self {
        Self {
            emitters: Some(emitters),
            ..self
        }
    }

    /// The same cell with a model error that the estimator is not given.
    pub fn under(self, condition: Condition) -> Self {
        Self {
            condition: Some(condition),
            ..self
        }
    }

    /// Five to nine emitters, without a model error.
    pub(super) fn is_plain(&self) -> bool {
        self.emitters.is_none() && self.condition.is_none()
    }

    /// Short name: reading, σ_eff in mm, pixels a side, and emitters where fixed.
    pub fn name(&self) -> String {
        let reading = match self.noise {
            Noise::Energy => 'E',
            Noise::Paper => 'P',
        };
        let emitters = self.emitters.map_or(String::new(), |n| format!(" N={n}"));
        let condition = self.condition.map_or(String::new(), |c| format!(" {}", c.name()));
        format!("{reading}{}/{}{emitters}{condition}", self.sigma_mm, self.pixels)
    }

    /// The camera as the estimator knows it.
    pub fn camera(&self) -> Result<Camera, Error> {
        let sigma = 1e-3 * self.sigma_mm;
        let config = optics::Config {
            pixels: [self.pixels; 2],
            spot_sigma_m: Some(sigma),
            noise_std_j: match self.noise {
                Noise::Energy => 1e-6,
                Noise::Paper => 1e-6 * std::f64::consts::TAU * sigma * sigma,
            },
            ..Default::default()
        };
        let mut camera = config.camera().map_err(|source| Error::Optics {
            cell: self.name(),
            source,
        })?;
        if let Some(condition) = self.condition {
            let energy_j = self.known_power(&camera).energies_j[0];
            condition.configured(&mut camera, energy_j);
        }
        Ok(camera)
    }

    /// What the network knows of its users here: the mean and scatter of `energy` straight below.
    pub(in crate::study) fn known_power(&self, camera: &Camera) -> KnownPower {
        // exp(−2r²/w²) over a pointing offset of σ_s an axis has mean 1/(1 + q) and mean square 1/(1 + 2q).
        let q = 4.0 * (POINTING_STD_M / BEAM_RADIUS_M).powi(2);
        let axial = radiometry::flat_aperture_fraction(camera.lens_radius_m, BEAM_RADIUS_M, 0.0);
        let transmission = radiometry::path_transmission(ATTENUATION_PER_M, camera.altitude_m);
        let square = FADING.iter().map(|shape| 1.0 + 1.0 / shape).product::<f64>() / (1.0 + 2.0 * q);
        KnownPower {
            energies_j: vec![POWER_W * COLLECTED * transmission * axial / (1.0 + q)],
            relative_std: ((square * (1.0 + q).powi(2) - 1.0) / COHERENCE_TIMES as f64).sqrt(),
            share: 0.95,
            attenuation_per_m: ATTENUATION_PER_M,
        }
    }

    /// Draws frames from the paper's scene.
    pub(in crate::study) fn scenes(&self, frames: usize, seed: u64) -> Result<Vec<Scene>, Error> {
        self.smeared_scenes(frames, seed, None)
    }

    /// The same of a camera that moves, with the bounds of the smeared spots; in a cell without a condition.
    pub(in crate::study) fn smeared_scenes(
        &self,
        frames: usize,
        seed: u64,
        smear: Option<&Smear>,
    ) -> Result<Vec<Scene>, Error> {
        let camera = self.camera()?;
        Ok((0..frames)
            .map(|k| {
                // A stream a frame: more frames leave the first ones as they were.
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                rng.set_stream(k as u64);
                self.scene(&camera, k as u64, smear, &mut rng)
            })
            .collect())
    }

    fn scene(&self, camera: &Camera, index: u64, smear: Option<&Smear>, rng: &mut ChaCha8Rng) -> Scene {
        let drawn = rng.random_range(5..=9);
        let positions: Vec<[f64; 2]> = (0..self.emitters.unwrap_or(drawn))
            .map(|_| std::array::from_fn(|_| rng.random_range(-AREA_HALF_M..AREA_HALF_M)))
            .collect();
        let energies: Vec<f64> = positions.iter().map(|&p| energy(camera, p, rng)).collect();
        let noise = Normal::new(0.0, camera.noise_std_j).expect("a camera's noise is positive and finite");
        let mut pixels = ndarray::Array2::from_shape_simple_fn(camera.shape(), || noise.sample(rng));
        let truth = Condition::lens(self.condition, camera);
        let parts = Condition::parts(self.condition, camera);
        let (mut row, mut column) = (vec![0.0; camera.x.n], vec![0.0; camera.y.n]);
        for (&p, &e) in positions.iter().zip(&energies) {
            let [x, y] = truth.to_sensor(p);
            let moved = smear.map(|smear| moments(smear.displacement_m([x, y])));
            for &([dx, dy], share) in moved.as_ref().unwrap_or(&parts) {
                psf::profile(&camera.x, x + dx, truth.spot_sigma_m, &mut row);
                psf::profile(&camera.y, y + dy, truth.spot_sigma_m, &mut column);
                for ((b, a), pixel) in pixels.indexed_iter_mut() {
                    *pixel += share * e * column[b] * row[a];
                }
            }
        }
        let relative_std = self.known_power(camera).relative_std;
        let [mut bound_m2, known_bound_m2] = Condition::apply(
            self.condition,
            &truth,
            &mut pixels,
            &positions,
            &energies,
            relative_std,
            rng,
        );
        if let Some(displaced) = smear.map(|smear| smear.displaced(camera, 1e-3)) {
            let assumptions = BoundAssumptions {
                smear: Some(&displaced),
                ..Default::default()
            };
            bound_m2 = position_bound_with(camera, &positions, &energies, assumptions);
        }
        Scene {
            frame: Frame {
                index,
                time: jiff::Timestamp::UNIX_EPOCH,
                pixels,
                masked: None,
                exposure_s: None,
                energy_scale: 1.0,
            },
            bound_m2,
            known_bound_m2,
            positions,
        }
    }
}

/// A displacement during an exposure as moments of it, each with its share of the light: Gauss's three in each of 32 parts. Up to 7 σ that is
/// exact to 10⁻⁹ of a spot's peak.
fn moments([dx, dy]: [f64; 2]) -> Vec<([f64; 2], f64)> {
    const PARTS: u32 = 32;
    let node = 0.5 * 0.6f64.sqrt();
    let of_part = |k: u32| {
        [(-node, 5.0 / 18.0), (0.0, 8.0 / 18.0), (node, 5.0 / 18.0)].map(|(t, share)| {
            let at = (f64::from(k) + 0.5 + t) / f64::from(PARTS) - 0.5;
            ([at * dx, at * dy], share / f64::from(PARTS))
        })
    };
    (0..PARTS).flat_map(of_part).collect()
}

/// Collected energy of one emitter, J: the mean over the coherence times of fading and pointing.
pub(super) fn energy(camera: &Camera, [x, y]: [f64; 2], rng: &mut ChaCha8Rng) -> f64 {
    let h = camera.altitude_m;
    let length = (h * h + x * x + y * y).sqrt();
    let gammas = FADING.map(|shape| Gamma::new(shape, 1.0 / shape).expect("positive shapes"));
    let jitter = Normal::new(0.0, POINTING_STD_M).expect("a positive deviation");
    let scale: f64 = (0..COHERENCE_TIMES)
        .map(|_| {
            let fading: f64 = gammas.iter().map(|g| g.sample(rng)).product();
            let offset = jitter.sample(rng).hypot(jitter.sample(rng));
            fading * radiometry::flat_aperture_fraction(camera.lens_radius_m, BEAM_RADIUS_M, offset)
        })
        .sum::<f64>()
        / COHERENCE_TIMES as f64;
    POWER_W * COLLECTED * radiometry::path_transmission(ATTENUATION_PER_M, length) * scale * h / length
}
