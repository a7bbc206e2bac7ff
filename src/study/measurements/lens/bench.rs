//! A lens before a sensor: frames of spots at random places, with the truth and its bounds.

use std::f64::consts::PI;
use std::sync::Arc;

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::shapes::{Lens, SIGMA};
use crate::calibrate::spot::{self, Learned};
use crate::estimate::position_bound;
use crate::frame::Frame;
use crate::optics::spot::{Field, SpotShape, Template};
use crate::optics::{self, Camera};

pub const PITCH_M: f64 = 0.03 / 64.0;
/// Samples a pixel along each axis.
const FINE: usize = 4;
/// Where the template of a spot ends, pixels, and the share of its light that its separable terms may leave out.
const REACH: f64 = 14.0;
const LEFT_OUT: f64 = 1e-5;
/// Frames that a calibration learns from.
const LEARNED_FROM: usize = 150;

/// How spots stand on the sensor.
#[derive(Clone, Copy, PartialEq)]
pub enum Layout {
    /// Five on 64×64 pixels, two on 20×20.
    Apart,
    /// Three pairs, 2 σ from spot to spot.
    Pairs,
}

/// A lens, a sensor and the light of its spots.
pub struct Bench {
    pub lens: Lens,
    pub pixels: usize,
    pub snr: f64,
    /// As its data sheet describes it.
    pub camera: Camera,
    noise: Normal<f64>,
    rng: ChaCha8Rng,
}

/// A frame's spots: places on the sensor, m, energies, J.
pub struct Spots {
    pub places_m: Vec<[f64; 2]>,
    pub energies: Vec<f64>,
}

impl Bench {
    pub fn new(lens: Lens, pixels: usize, snr: f64, seed: u64) -> Self {
        let config = optics::Config {
            pixels: [pixels; 2],
            sensor_size_m: [PITCH_M * pixels as f64; 2],
            spot_sigma_m: Some(SIGMA * PITCH_M),
            ..Default::default()
        };
        let camera = config.camera().expect("a camera");
        Self {
            lens,
            pixels,
            snr,
            noise: Normal::new(0.0, camera.noise_std_j).expect("a deviation"),
            camera,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// The camera with the spot that a lens makes at a place on the sensor.
    pub fn camera_at(&self, place_m: [f64; 2]) -> Camera {
        Camera {
            spot_shape: spot_shape(&self.lens, &self.camera, place_m),
            ..self.camera.clone()
        }
    }

    /// Position bounds of spots, m².
    pub fn bounds(&self, spots: &Spots) -> Vec<f64> {
        let ground: Vec<_> = spots.places_m.iter().map(|p| self.camera.to_ground(*p)).collect();
        if self.lens.is_uniform {
            return position_bound(&self.camera_at([0.0; 2]), &ground, &spots.energies);
        }
        let of_each =
            |(i, place): (usize, &[f64; 2])| position_bound(&self.camera_at(*place), &ground, &spots.energies)[i];
        spots.places_m.iter().enumerate().map(of_each).collect()
    }

    /// A frame of spots whose peaks are within a quarter of the bench's SNR.
    pub fn frame(&mut self, index: u64, layout: Layout) -> (Frame, Spots) {
        let (n, half) = (self.pixels, self.camera.x.half_width());
        let places = self.places(layout);
        let mut pixels = Array2::from_shape_simple_fn((n, n), || self.noise.sample(&mut self.rng));
        let mut energies = Vec::with_capacity(places.len());
        for place in &places {
            let scale = self.snr * self.rng.random_range(0.75..1.25) * self.camera.noise_std_j;
            let (spot, peak) = self.spot(*place);
            energies.push(spot.sum() / peak * scale);
            pixels.scaled_add(scale / peak, &spot);
        }
        let frame = Frame {
            index,
            time: jiff::Timestamp::UNIX_EPOCH,
            pixels,
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        let places_m = places.iter().map(|p| p.map(|c| c * PITCH_M - half)).collect();
        (frame, Spots { places_m, energies })
    }

    /// What `oapwatch calibrate` learns from frames of spots apart at places that it is not told.
    pub fn learn(&mut self) -> Result<Learned, spot::Error> {
        let frames: Vec<Array2<f64>> = (0..LEARNED_FROM)
            .map(|k| self.frame(k as u64, Layout::Apart).0.pixels)
            .collect();
        let numbered: Vec<(usize, &Array2<f64>)> = frames.iter().enumerate().collect();
        spot::learn(&self.camera, &numbered, &mut |_| {})
    }

    /// The pixels of a spot, and its brightest one.
    pub fn spot(&self, [x, y]: [f64; 2]) -> (Array2<f64>, f64) {
        let u = [x, y].map(|c| 2.0 * c / self.pixels as f64 - 1.0);
        let mut peak = 0.0f64;
        let spot = Array2::from_shape_fn((self.pixels, self.pixels), |(b, a)| {
            let mut sum = 0.0;
            for k in 0..FINE * FINE {
                let [i, j] = [k % FINE, k / FINE].map(|s| (s as f64 + 0.5) / FINE as f64);
                sum += (self.lens.density)(a as f64 + i - x, b as f64 + j - y, u);
            }
            peak = peak.max(sum);
            sum
        });
        (spot, peak)
    }

    /// Centres, pixels from the sensor's corner.
    fn places(&mut self, layout: Layout) -> Vec<[f64; 2]> {
        let (count, edge, apart) = match (self.pixels > 40, layout) {
            (true, Layout::Apart) => (5, 2.5, 6.0),
            (true, Layout::Pairs) => (3, 4.0, 8.0),
            (false, _) => (2, 1.5, 4.0),
        };
        let side = self.pixels as f64;
        let mut places: Vec<[f64; 2]> = Vec::new();
        while places.len() < count {
            let next = [0, 1].map(|_| self.rng.random_range(edge * SIGMA..side - edge * SIGMA));
            if places
                .iter()
                .all(|p| (p[0] - next[0]).hypot(p[1] - next[1]) > apart * SIGMA)
            {
                places.push(next);
            }
        }
        if layout == Layout::Apart {
            return places;
        }
        let halves = places.into_iter().flat_map(|p| {
            let (sin, cos) = self.rng.random_range(0.0..PI).sin_cos();
            [-SIGMA, SIGMA].map(|d| [p[0] + d * cos, p[1] + d * sin])
        });
        halves.collect()
    }
}

/// The spot that a lens makes at a place on a camera's sensor.
pub fn spot_shape(lens: &Lens, camera: &Camera, place_m: [f64; 2]) -> Option<Arc<SpotShape>> {
    let half_sensor_m = [camera.x.half_width(), camera.y.half_width()];
    let u = [0, 1].map(|k| place_m[k] / half_sensor_m[k]);
    let density = |x: f64, y: f64| (lens.density)(x / PITCH_M, y / PITCH_M, u);
    let template = Template::of_density(Field { half_sensor_m }, 0.5 * PITCH_M, REACH * PITCH_M, density);
    SpotShape::from_template(&template, LEFT_OUT).map(Arc::new)
}
