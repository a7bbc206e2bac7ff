//! Frames with known sources, for the unit tests of fits and proposals.

use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::search::SearchSpace;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::frame::Frame;
use crate::optics::{Camera, Config, psf};

/// A frame of 20 × 20 pixels with what a search of it needs.
pub(crate) struct TestFrame {
    pub camera: Camera,
    pub space: SearchSpace,
    pub frame: PreprocessedFrame,
    pub compressed: CompressedFrame,
}

/// What a frame shows.
#[derive(Clone, Default)]
pub(crate) struct Shown<'a> {
    /// Pixels per σ.
    pub pixels_per_sigma: f64,
    /// Position, σ from the centre, and energy, in units of the noise.
    pub sources: &'a [([f64; 2], f64)],
    /// Noise of standard deviation 1 from this seed; without it none.
    pub noise: Option<u64>,
    /// Masked pixels, (x, y).
    pub masked: &'a [(usize, usize)],
    pub rules: Rules,
}

const PIXELS: usize = 20;

impl Shown<'_> {
    pub fn frame(&self) -> TestFrame {
        let mut config = Config {
            pixels: [PIXELS; 2],
            spot_sigma_m: Some(1e-3),
            ..Config::default()
        };
        let pitch_m = config.camera().expect("a camera").x.pitch_m;
        let sigma = self.pixels_per_sigma * pitch_m;
        config.spot_sigma_m = Some(sigma);
        let camera = config.camera().expect("a camera");
        let mut pixels = Array2::<f64>::zeros((PIXELS, PIXELS));
        let (mut fx, mut fy) = ([0.0; PIXELS], [0.0; PIXELS]);
        for (u, a) in self.sources {
            psf::profile(&camera.x, u[0] * sigma, sigma, &mut fx);
            psf::profile(&camera.y, u[1] * sigma, sigma, &mut fy);
            for ((y, x), pixel) in pixels.indexed_iter_mut() {
                *pixel += a * fy[y] * fx[x];
            }
        }
        if let Some(seed) = self.noise {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for pixel in &mut pixels {
                let noise: f64 = StandardNormal.sample(&mut rng);
                *pixel += noise;
            }
        }
        pixels *= camera.noise_std_j;
        for &(x, y) in self.masked {
            pixels[[y, x]] = f64::NAN;
        }
        let frame = Frame {
            index: 0,
            time: jiff::Timestamp::UNIX_EPOCH,
            pixels,
            masked: None,
            exposure_s: None,
            energy_scale: 1.0,
        };
        let mut preprocessed = PreprocessedFrame::default();
        preprocessed.load(&frame, &camera).expect("a usable frame");
        let space = SearchSpace::new([&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma)), self.rules);
        let mut compressed = CompressedFrame::default();
        compressed.load(&preprocessed, &space.bases.x, &space.bases.y);
        TestFrame {
            camera,
            space,
            frame: preprocessed,
            compressed,
        }
    }
}

/// A hypothesis with sources of no energy yet.
pub(crate) fn hypothesis(nuisances: Nuisances, places: &[[f64; 2]]) -> Hypothesis {
    let mut hypothesis = Hypothesis::empty(nuisances);
    hypothesis.sources = places.iter().map(|&u| PointSource::new(u, 0.0)).collect();
    hypothesis
}
