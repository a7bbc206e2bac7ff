//! Noise that grows with the light (shot noise, gain scatter): measured from what a model leaves of a frame, after which
//! every pixel weighs as much as it says and an emitter must stand out of the noise where it stands.

use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Model;
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::model_order::search::Search;
use crate::estimate::preprocess::noise_variance::Growth;
use crate::estimate::preprocess::screening::Screened;
use crate::optics::Camera;

/// Times that the weights follow the model they were made from.
const PASSES: usize = 2;
/// Rounds of moves under weights.
const ROUNDS: usize = 3;

/// The search in pixels, each with its own weight.
pub(crate) struct Weighing {
    pub search: Search,
    pub reading: Reading,
}

impl Weighing {
    pub fn new(camera: &Camera) -> Self {
        let basis = |axis| Basis::pixels(axis, camera.spot_sigma_m);
        Self {
            search: Search::new([&camera.x, &camera.y].map(basis)),
            reading: Reading::default(),
        }
    }

    /// Refits `model` under weights that follow `growth`, or what the model leaves where that is not known. `false`,
    /// with `model` untouched, where even noise explains the frame as well.
    pub fn run(&mut self, frame: &Screened, growth: Option<Growth>, model: &mut Model) -> bool {
        let Self { search, reading } = self;
        let nx = search.fitter.bx.n;
        reading.load(frame, &search.fitter.bx, &search.fitter.by);
        let mut next = model.clone();
        let residual = search.fitter.residual_of(reading, &mut next).to_vec();
        let even = search.score(&next);
        let signal = search.fitter.expectation(reading, &mut next);
        let mut growth = growth.unwrap_or_else(|| {
            Growth::fit(
                frame,
                [reading.rank[0], reading.mx],
                &residual,
                &signal,
                next.spots.len(),
            )
        });
        if growth.is_flat() {
            return false;
        }
        let mut signal = signal;
        for _ in 0..PASSES {
            let mx = reading.mx;
            let at = |k: usize| k / nx * mx + k % nx;
            let fitter = &search.fitter;
            reading.weigh(frame, [&fitter.bx, &fitter.by], |k| growth.at(signal[at(k)]));
            search.settle(reading, &mut next, ROUNDS);
            signal = search.fitter.expectation(reading, &mut next);
            let mut residual = search.fitter.residual_of(reading, &mut next).to_vec();
            for (r, w) in residual.iter_mut().zip(&reading.weights) {
                *r /= w.max(1e-300);
            }
            growth = Growth::fit(
                frame,
                [reading.rank[0], reading.mx],
                &residual,
                &signal,
                next.spots.len(),
            );
        }
        let is_better = search.score(&next) + reading.log_det + Growth::PRICE < even;
        if is_better {
            *model = next;
        }
        is_better
    }
}
