//! Property: a fit never ends with a larger deviance than it began with.

use ndarray::Array2;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::estimate::fit::levenberg_marquardt::{Fitter, JOINT_STEPS, MAX_STEP_FACTOR};
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
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
        let mut preprocessed = PreprocessedFrame::default();
        preprocessed.load(&frame, &camera).expect("a usable frame");
        let [bx, by] = [&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma));
        let mut compressed = CompressedFrame::default();
        compressed.load(&preprocessed, &bx, &by);
        let mut fitter = Fitter::new(bx, by, Rules::default());
        let mut hypothesis = Hypothesis::empty(Nuisances {
            background,
            width: [Width::Known, Width::Common, Width::PerAxis, Width::RotatedEllipse][usize::from(width)],
        });
        hypothesis.sources = start.iter().map(|(x, y, e)| PointSource::new([x * half / sigma, y * half / sigma], 10f64.powf(*e))).collect();
        fitter.reset(None);
        fitter.fit(&compressed, &mut hypothesis, 0);
        let before = hypothesis.deviance;
        fitter.fit(&compressed, &mut hypothesis, steps);
        let after = hypothesis.deviance;
        prop_assert!(after.is_finite() && after <= before, "{after} after {before}");
        // The reported deviance is that of the reported parameters.
        fitter.fit(&compressed, &mut hypothesis, 0);
        prop_assert!((hypothesis.deviance - after).abs() <= 1e-9 * (1.0 + before.abs()), "{} is said to be {after}", hypothesis.deviance);
        prop_assert!(fitter.steps <= (MAX_STEP_FACTOR * (steps + JOINT_STEPS)) as u64);
    }
}
