//! Pixels that are hot, on a sensor whose pixels are too wide for the part of a frame outside the basis to show them.

use ndarray::Array2;
use oapwatch::optics::{self, add_spot};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::frames::{estimator, frame};
use crate::lens::FIVE;

#[test]
fn a_hot_pixel_is_no_emitter_where_pixels_are_wide() {
    let config = optics::Config {
        pixels: [40, 40],
        spot_sigma_m: Some(1e-3),
        ..optics::Config::default()
    };
    let camera = config.camera().unwrap();
    let mut estimator = estimator(None, &camera);
    let mut rng = ChaCha8Rng::seed_from_u64(36);
    let noise = Normal::new(0.0, camera.noise_std_j).unwrap();
    for _ in 0..40 {
        let mut pixels = vec![0.0; 40 * 40];
        // An SNR of fifty.
        FIVE.iter()
            .for_each(|at| add_spot(&camera, *at, 560.0 * camera.noise_std_j, &mut pixels));
        pixels.iter_mut().for_each(|pixel| *pixel += noise.sample(&mut rng));
        pixels[20 * 40 + 8] += 30.0 * camera.noise_std_j;
        let frame = frame(Array2::from_shape_vec((40, 40), pixels).unwrap());
        assert_eq!(estimator.estimate(&frame).unwrap().emitters.len(), FIVE.len());
    }
}
