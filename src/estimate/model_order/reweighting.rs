//! Heteroscedastic reweighting: noise that grows with the light (shot noise, gain scatter) is estimated from a fit's residual, every
//! pixel is weighted by its inverse variance, and the hypothesis is refitted.

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::evaluate;
use crate::estimate::fit::work_budget::WorkBudget;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::maximum_likelihood::refit_reweighted;
use crate::estimate::model_order::search::SearchSpace;
use crate::estimate::preprocess::noise_variance::VarianceFunction;
use crate::estimate::preprocess::screening::PreprocessedFrame;
use crate::estimate::rules::Rules;
use crate::optics::Camera;

/// Alternations of weighting and fitting.
const PASSES: usize = 2;
/// Rounds of proposals under weights.
const ROUNDS: usize = 3;

/// A search in the pixel bases, where each pixel has a weight.
pub(crate) struct Reweighting {
    pub space: SearchSpace,
    pub compressed: CompressedFrame,
}

impl Reweighting {
    pub fn new(camera: &Camera, rules: Rules) -> Self {
        let basis = |axis| Basis::pixels(axis, camera.spot_sigma_m);
        Self {
            space: SearchSpace::new([&camera.x, &camera.y].map(basis), rules).with_shape(camera),
            compressed: CompressedFrame::of_camera(camera),
        }
    }

    /// Refits `hypothesis` under the weights of a variance function, which is estimated from the residual if not given. Returns `false`
    /// and leaves `hypothesis` unchanged where constant noise explains the frame as well.
    pub fn run(
        &mut self,
        frame: &PreprocessedFrame,
        variance: Option<VarianceFunction>,
        hypothesis: &mut Hypothesis,
        budget: &mut WorkBudget,
    ) -> bool {
        let Self { space, compressed } = self;
        compressed.load(frame, &space.bases.x, &space.bases.y);
        let mut next = hypothesis.clone();
        let mut search = space.search(compressed, frame, budget);
        let (residual, mut signal) = predict(&mut search.context, &mut next);
        let even = search.score(&next);
        let sources = next.sources.len();
        let mut variance = variance.unwrap_or_else(|| fit_variance(frame, compressed, &residual, &signal, sources));
        if variance.is_constant() {
            return false;
        }
        for _ in 0..PASSES {
            let (nx, mx) = (space.bases.x.n, compressed.mx);
            let at = |k: usize| k / nx * mx + k % nx;
            compressed.set_weights(frame, space.bases.axes(), |k| variance.at(signal[at(k)]));
            let mut search = space.search(compressed, frame, budget);
            next = refit_reweighted(&mut search, next, ROUNDS);
            let (mut residual, light) = predict(&mut search.context, &mut next);
            for (r, w) in residual.iter_mut().zip(&compressed.weights) {
                *r /= w.max(1e-300);
            }
            variance = fit_variance(frame, compressed, &residual, &light, next.sources.len());
            signal = light;
        }
        let score = space.search(compressed, frame, budget).score(&next);
        let is_better = score + compressed.log_det + VarianceFunction::PENALTY < even;
        if is_better {
            *hypothesis = next;
        }
        is_better
    }
}

/// The weighted residual of `hypothesis` and the light that it predicts, (my, mx).
fn predict(context: &mut FitContext, hypothesis: &mut Hypothesis) -> (Vec<f64>, Vec<f64>) {
    let at = evaluate(context, hypothesis);
    (at.residual.clone(), at.expected_light())
}

fn fit_variance(
    frame: &PreprocessedFrame,
    compressed: &CompressedFrame,
    residual: &[f64],
    signal: &[f64],
    sources: usize,
) -> VarianceFunction {
    VarianceFunction::fit(
        &frame.is_masked,
        [compressed.rank[0], compressed.mx],
        residual,
        signal,
        sources,
    )
}
