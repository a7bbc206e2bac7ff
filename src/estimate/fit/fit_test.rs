//! The fit on inputs small enough to check: descent, derivatives, reasons to end, masked pixels.

use ndarray::Array2;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::estimate::dense_linalg::dot;
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::levenberg_marquardt::{
    JOINT_STEPS, MAX_STEP_FACTOR, Termination, evaluate, fit, fit_below, linearise,
};
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::bases::Bases;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Background, Hypothesis, Nuisances, PointSource, Width};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::estimate::test_frame::{Shown, TestFrame, hypothesis};
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
        (background, width) in (0u8..3, 0u8..4),
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
        let frame = Frame { index: 0, time: jiff::Timestamp::UNIX_EPOCH, pixels, masked: None, exposure_s: None, energy_scale: 1.0 };
        let mut preprocessed = PreprocessedFrame::default();
        preprocessed.load(&frame, &camera).expect("a usable frame");
        let bases = Bases::new([&camera.x, &camera.y].map(|axis| Basis::new(axis, sigma)));
        let mut compressed = CompressedFrame::default();
        compressed.load(&preprocessed, &bases.x, &bases.y);
        let mut hypothesis = Hypothesis::empty(Nuisances {
            background: [Background::None, Background::Plane, Background::Curved][usize::from(background)],
            width: [Width::Known, Width::Common, Width::PerAxis, Width::RotatedEllipse][usize::from(width)],
        });
        hypothesis.sources = start.iter().map(|(x, y, e)| PointSource::new([x * half / sigma, y * half / sigma], 10f64.powf(*e))).collect();
        let (mut workspace, mut budget) = (Workspace::default(), WorkBudget::new(&|| false));
        let mut context = FitContext {
            bases: &bases,
            compressed: &compressed,
            rules: Rules::default(),
            budget: &mut budget,
            workspace: &mut workspace,
        };
        evaluate(&mut context, &mut hypothesis);
        let before = hypothesis.deviance;
        fit(&mut context, &mut hypothesis, steps);
        let after = hypothesis.deviance;
        prop_assert!(after.is_finite() && after <= before, "{after} after {before}");
        // The reported deviance is that of the reported parameters.
        evaluate(&mut context, &mut hypothesis);
        prop_assert!((hypothesis.deviance - after).abs() <= 1e-9 * (1.0 + before.abs()), "{} is said to be {after}", hypothesis.deviance);
        prop_assert!(budget.steps <= (MAX_STEP_FACTOR * (steps + JOINT_STEPS)) as u64);
    }
}

/// The context of a fit of a test frame, with the given budget.
macro_rules! context {
    ($frame:expr, $budget:expr) => {
        FitContext {
            bases: &$frame.space.bases,
            compressed: &$frame.compressed,
            rules: $frame.space.rules,
            budget: &mut $budget,
            workspace: &mut $frame.space.workspace,
        }
    };
}

/// The predicted frame of `hypothesis` with its amplitudes as they are, as pixels.
fn predict(frame: &TestFrame, hypothesis: &Hypothesis) -> Vec<f64> {
    let (bases, compressed) = (&frame.space.bases, &frame.compressed);
    let mut at = Evaluation::default();
    let context = Problem {
        bases,
        compressed,
        constraint: None,
    };
    at.load(context, hypothesis);
    at.model.place(bases, compressed, hypothesis.nuisances, &mut Vec::new());
    at.residual.resize(compressed.mx * compressed.my, 0.0);
    let mut pixels = Vec::new();
    compressed.expand_matrix(&at.expected_light(), &bases.x, &bases.y, &mut pixels);
    pixels
}

/// Moves parameter `k` of a hypothesis by `step`, in the order of the normal equations.
fn moved(hypothesis: &Hypothesis, k: usize, step: f64) -> Hypothesis {
    let mut next = hypothesis.clone();
    let n = 3 * hypothesis.sources.len();
    let first_width = n + hypothesis.nuisances.background_terms();
    match k {
        _ if k < n && k % 3 < 2 => next.sources[k / 3].u[k % 3] += step,
        _ if k < n => next.sources[k / 3].a += step,
        _ if k < first_width => next.background[k - n] += step,
        _ => match (hypothesis.nuisances.width, k - first_width) {
            (Width::Common, _) => next.width = next.width.map(|w| w * step.exp()),
            (_, 2) => next.covariance_xy += step,
            (_, w) => next.width[w] *= step.exp(),
        },
    }
    next
}

/// Gradient and information against central differences of the predicted pixels, with the masked ones deleted.
fn check_derivatives(nuisances: Nuisances, masked: &[(usize, usize)]) {
    let mut frame = Shown {
        pixels_per_sigma: 2.5,
        sources: &[([-0.6, 0.3], 900.0), ([0.9, -0.4], 500.0)],
        noise: Some(3),
        masked,
        ..Shown::default()
    }
    .frame();
    let mut at = hypothesis(nuisances, &[[-0.4, 0.2], [1.0, -0.6]]);
    if nuisances.width != Width::Known {
        at.width = match nuisances.width {
            Width::Common => [1.1; 2],
            _ => [1.1, 0.9],
        };
    }
    if nuisances.width == Width::RotatedEllipse {
        at.covariance_xy = 0.2;
    }
    let mut budget = WorkBudget::new(&|| false);
    let context = context!(frame, budget);
    let equations = linearise(context.problem(), &mut at, context.budget, context.workspace).equations;
    let p = equations.parameters;
    let (information, gradient) = (equations.information.clone(), equations.gradient.clone());
    assert_eq!(p, at.parameters());
    let pixels = frame.frame.pixels.iter();
    let mut left: Vec<f64> = pixels.zip(predict(&frame, &at)).map(|(f, m)| f - m).collect();
    let delete = |image: &mut Vec<f64>| masked.iter().for_each(|&(x, y)| image[20 * y + x] = 0.0);
    delete(&mut left);
    let columns: Vec<Vec<f64>> = (0..p)
        .map(|k| {
            let step = 1e-5;
            let [low, high] = [-step, step].map(|s| predict(&frame, &moved(&at, k, s)));
            let mut column: Vec<f64> = high.iter().zip(&low).map(|(h, l)| (h - l) / (2.0 * step)).collect();
            delete(&mut column);
            column
        })
        .collect();
    for i in 0..p {
        let expected = dot(&columns[i], &left);
        let scale = dot(&columns[i], &columns[i]).sqrt();
        assert!(
            (gradient[i] - expected).abs() < 1e-6 * scale * dot(&left, &left).sqrt().max(1.0),
            "gradient {i}: {} {expected}",
            gradient[i]
        );
        for j in i..p {
            let expected = dot(&columns[i], &columns[j]);
            let both = scale * dot(&columns[j], &columns[j]).sqrt();
            assert!(
                (information[i * p + j] - expected).abs() < 1e-6 * both,
                "information {i} {j}: {} {expected}",
                information[i * p + j]
            );
        }
    }
}

#[test]
fn derivatives_agree_with_finite_differences() {
    for width in [Width::Known, Width::Common, Width::PerAxis] {
        let nuisances = Nuisances {
            background: Background::None,
            width,
        };
        check_derivatives(nuisances, &[]);
    }
}

#[test]
fn masked_pixels_count_as_deleted() {
    let scattered = [(8, 9), (11, 10), (12, 10), (3, 17)];
    // Rows of six, so many that they are summed run by run.
    let runs: Vec<(usize, usize)> = (4..16).flat_map(|y| (9..15).map(move |x| (x, y))).collect();
    for masked in [&scattered[..], &runs] {
        for width in [Width::Known, Width::Common] {
            check_derivatives(
                Nuisances {
                    background: Background::Curved,
                    width,
                },
                masked,
            );
        }
    }
}

/// Two sources so bright that one of them leaves a poor fit.
const BRIGHT_PAIR: [([f64; 2], f64); 2] = [([-1.5, 0.0], 1e5), ([1.5, 0.5], 1e5)];

/// How a fit of a frame of `sources` ends that starts at `places`.
fn end_of(
    sources: &[([f64; 2], f64)],
    places: &[[f64; 2]],
    steps: usize,
    threshold: f64,
    spent: f64,
    rules: Rules,
) -> (Termination, Hypothesis, u64) {
    let mut frame = Shown {
        pixels_per_sigma: 2.0,
        sources,
        noise: Some(1),
        rules,
        ..Shown::default()
    }
    .frame();
    let mut budget = WorkBudget::new(&|| false);
    budget.charge(spent);
    let mut at = hypothesis(Nuisances::default(), places);
    let termination = fit_below(&mut context!(frame, budget), &mut at, steps, threshold);
    (termination, at, budget.steps)
}

#[test]
fn a_fit_says_why_it_ended() {
    let all = Rules::default();
    let open = f64::INFINITY;
    let (end, dark, steps) = end_of(&[], &[], 10, open, 0.0, all);
    assert_eq!((end, dark.converged, steps), (Termination::NoParameter, true, 0));
    let one = [([0.3, -0.2], 1e3)];
    let (end, at, steps) = end_of(&one, &[[0.0, 0.0]], 20, open, 0.0, all);
    assert_eq!(end, Termination::NegligibleDecrease);
    assert!(at.converged && steps < 8, "{steps}");
    // Five standard deviations of 1/(energy/noise) of a σ or so.
    assert!(
        (at.sources[0].u[0] - 0.3).abs() < 0.02 && (at.sources[0].a - 1e3).abs() < 20.0,
        "{at:?}"
    );
    let (end, at, steps) = end_of(
        &one,
        &[[2.0, 1.0]],
        1,
        open,
        0.0,
        Rules::without("extend_fast_fits").expect("a rule"),
    );
    assert_eq!((end, at.converged, steps), (Termination::StepLimit, false, 1));
    let (end, _, steps) = end_of(&one, &[[2.0, 1.0]], 1, open, 0.0, all);
    assert!(
        end != Termination::StepLimit || steps > 1,
        "each step is large: {end:?} after {steps}"
    );
    let (end, at, _) = end_of(&one, &[[1.0, 0.0]], 20, -1e9, 0.0, all);
    assert_eq!((end, at.converged), (Termination::OutOfReach, false));
    let (end, at, steps) = end_of(&one, &[[1.0, 0.0]], 20, open, 1e12, all);
    assert_eq!((end, at.converged, steps), (Termination::OutOfWork, false, 0));
    assert!(end.is_aborted() && at.deviance.is_finite(), "the start is evaluated");
}

#[test]
fn a_poor_fit_ends_when_it_stalls_and_rounding_ends_one_by_small_decreases() {
    let patient = Rules::without("stop_stalled_fits").expect("a rule");
    let place = [[0.3, 2.0]];
    let (end, at, steps) = end_of(&BRIGHT_PAIR, &place, 40, f64::INFINITY, 0.0, Rules::default());
    let (other, _, more) = end_of(&BRIGHT_PAIR, &place, 40, f64::INFINITY, 0.0, patient);
    assert_eq!((end, at.converged), (Termination::Stalled, false));
    assert!(
        steps < more && other != Termination::Stalled,
        "{steps}, {other:?} after {more}"
    );
    // Squares of 1e12 leave rounding errors far above the negligible decrease.
    let huge = [([0.3, -0.2], 1e12), ([0.5, 0.1], 1e12)];
    let (end, ..) = end_of(&huge, &[[0.2, -0.2], [0.6, 0.0]], 200, f64::INFINITY, 0.0, patient);
    assert_eq!(end, Termination::SmallDecreases);
}

#[test]
fn steps_that_fail_at_any_damping_end_at_its_ceiling() {
    // A source that starts on darkness walks along a curved valley to a noise peak beyond the edge: the damping is high when it gets
    // there, and near a minimum no step decreases the deviance by more than rounding. From which places is rounding's.
    let ends = [2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0].map(|v| {
        end_of(
            &[([v, 0.3], -1e3)],
            &[[6.0, 0.0]],
            300,
            f64::INFINITY,
            0.0,
            Rules::default(),
        )
    });
    let at_ceiling = ends.iter().filter(|(end, ..)| *end == Termination::DampingCeiling);
    let places: Vec<_> = at_ceiling
        .map(|(_, at, steps)| (at.converged, at.sources[0].u, *steps))
        .collect();
    assert!(!places.is_empty(), "{ends:?}");
    assert!(
        places.iter().all(|(converged, _, steps)| *converged && *steps < 300),
        "{places:?}"
    );
}
