//! Heteroscedastic reweighting: noise that grows with the light (shot noise, gain scatter) is estimated from a fit's residual, every
//! pixel is weighted by its inverse variance, and the hypothesis is refitted.

use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::search::Search;
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
    pub search: Search,
    pub compressed: CompressedFrame,
}

impl Reweighting {
    pub fn new(camera: &Camera, rules: Rules) -> Self {
        let basis = |axis| Basis::pixels(axis, camera.spot_sigma_m);
        Self {
            search: Search::new([&camera.x, &camera.y].map(basis), rules),
            compressed: CompressedFrame::default(),
        }
    }

    /// Refits `hypothesis` under the weights of a variance function, which is estimated from the residual if not given. Returns `false`
    /// and leaves `hypothesis` unchanged where constant noise explains the frame as well.
    pub fn run(
        &mut self,
        frame: &PreprocessedFrame,
        variance: Option<VarianceFunction>,
        hypothesis: &mut Hypothesis,
    ) -> bool {
        let Self { search, compressed } = self;
        let nx = search.fitter.bx.n;
        compressed.load(frame, &search.fitter.bx, &search.fitter.by);
        let mut next = hypothesis.clone();
        let residual = search.fitter.weighted_residual(compressed, &mut next).to_vec();
        let even = search.score(&next);
        let signal = search.fitter.expected_light(compressed, &mut next);
        let mut variance = variance.unwrap_or_else(|| {
            VarianceFunction::fit(
                frame,
                [compressed.rank[0], compressed.mx],
                &residual,
                &signal,
                next.sources.len(),
            )
        });
        if variance.is_constant() {
            return false;
        }
        let mut signal = signal;
        for _ in 0..PASSES {
            let mx = compressed.mx;
            let at = |k: usize| k / nx * mx + k % nx;
            let fitter = &search.fitter;
            compressed.set_weights(frame, [&fitter.bx, &fitter.by], |k| variance.at(signal[at(k)]));
            search.refit_reweighted(compressed, &mut next, ROUNDS);
            signal = search.fitter.expected_light(compressed, &mut next);
            let mut residual = search.fitter.weighted_residual(compressed, &mut next).to_vec();
            for (r, w) in residual.iter_mut().zip(&compressed.weights) {
                *r /= w.max(1e-300);
            }
            variance = VarianceFunction::fit(
                frame,
                [compressed.rank[0], compressed.mx],
                &residual,
                &signal,
                next.sources.len(),
            );
        }
        let is_better = search.score(&next) + compressed.log_det + VarianceFunction::PENALTY < even;
        if is_better {
            *hypothesis = next;
        }
        is_better
    }
}
