//! The fit never ends worse than it began, wherever it begins.

use ndarray::Array2;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::estimate::fit::levenberg_marquardt::{Fitter, MOST_STEPS, TOGETHER};
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::{Model, Nuisances, Spot, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::screening::Screened;
use crate::frame::Frame;
use crate::optics::{Config, psf};

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(17), ..ProptestConfig::default() })]

    #[test]
    fn the_fit_is_never_worse_than_its_start(
        sigma in 0.3e-3f64..10e-3,
        truth in prop::collection::vec((-1.0f64..1.0, -1.0f64..1.0, 1.0f64..6.0), 1..6),
        start in prop::collection::vec((-1.2f64..1.2, -1.2f64..1.2, 0.0f64..6.0), 1..7),
        steps in 1usize..40,
        holes in prop::collection::vec(0usize..256, 0..20),
        (background, width) in (any::<bool>(), 0u8..4),
        seed in any::<u64>(),
    ) {
        let camera = Config { pixels: [16, 16], spot_sigma_m: Some(sigma), ..Config::default() }.camera().expect("a camera");
        let half = camera.x.half_width();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut pixels = Array2::from_shape_simple_fn((16, 16), || {
            let n: f64 = StandardNormal.sample(&mut rng);
            n * camera.noise_std_j
        });
        let (mut fx, mut fy) = ([0.0; 16], [0.0; 16]);
        for (x, y, exponent) in &truth {
            psf::profile(&camera.x, x * half, sigma, &mut fx);
            psf::profile(&camera.y, y * half, sigma, &mut fy);
            for ((r, c), p) in pixels.indexed_iter_mut() {
                *p += 10f64.powf(*exponent) * camera.noise_std_j * fy[r] * fx[c];
            }
        }
        holes.iter().for_each(|&h| pixels[[h / 16, h % 16]] = f64::NAN);
        let frame = Frame { index: 0, time: jiff::Timestamp::UNIX_EPOCH, pixels, masked: None };
        let mut screened = Screened::default();
        screened.load(&frame, &camera).expect("a usable frame");
        let [bx, by] = [&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma));
        let mut reading = Reading::default();
        reading.load(&screened, &bx, &by);
        let mut fitter = Fitter::new(bx, by);
        let mut model = Model::empty(Nuisances {
            background,
            width: [Width::Known, Width::Common, Width::PerAxis, Width::Turned][usize::from(width)],
        });
        model.spots = start.iter().map(|(x, y, e)| Spot::new([x * half / sigma, y * half / sigma], 10f64.powf(*e))).collect();
        fitter.restart(None);
        fitter.fit(&reading, &mut model, 0);
        let before = model.deviance;
        fitter.fit(&reading, &mut model, steps);
        let after = model.deviance;
        prop_assert!(after.is_finite() && after <= before, "{after} after {before}");
        // What it says of where it ended is what an evaluation there gives.
        fitter.fit(&reading, &mut model, 0);
        prop_assert!((model.deviance - after).abs() <= 1e-9 * (1.0 + before.abs()), "{} is said to be {after}", model.deviance);
        prop_assert!(fitter.steps <= (MOST_STEPS * (steps + TOGETHER)) as u64);
    }
}
