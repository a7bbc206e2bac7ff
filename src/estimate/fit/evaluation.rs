//! Evaluates a hypothesis: its predicted frame with the amplitudes solved, the weighted residual, and the deviance.

use crate::estimate::fit::amplitudes::solve_amplitudes;
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::scratch::Scratch;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, PointSource, prior_penalty};
use crate::estimate::model::separable_model::SeparableModel;

/// A hypothesis as it predicts a frame.
#[derive(Default)]
pub(crate) struct Evaluation {
    pub model: SeparableModel,
    /// Weighted residual, (my, mx).
    pub residual: Vec<f64>,
}

impl Evaluation {
    /// Takes over a hypothesis's parameters, with the positions kept within reach of the sensor.
    pub fn load(&mut self, problem: Problem, hypothesis: &Hypothesis) {
        let model = &mut self.model;
        model.sources.clone_from(&hypothesis.sources);
        model.background = hypothesis.background;
        model.width = hypothesis.width;
        model.covariance_xy = hypothesis.covariance_xy;
        model.has_signed_energies = hypothesis.has_signed_energies;
        let (bx, by) = (&problem.bases.x, &problem.bases.y);
        for s in &mut model.sources {
            s.u[0] = s.u[0].clamp(bx.min_position(), bx.max_position());
            s.u[1] = s.u[1].clamp(by.min_position(), by.max_position());
        }
    }

    /// Hands the parameters to a hypothesis whose penalised deviance is `deviance`.
    pub fn store(&self, problem: Problem, deviance: f64, hypothesis: &mut Hypothesis) {
        let model = &self.model;
        hypothesis.sources.clone_from(&model.sources);
        hypothesis.background = model.background;
        hypothesis.width = model.width;
        hypothesis.covariance_xy = model.covariance_xy;
        hypothesis.deviance =
            deviance - prior_penalty(&hypothesis.sources) - constraint_deviance(problem, &hypothesis.sources);
    }

    /// Places the model's components, solves their amplitudes, and sets the residual. Returns the penalised deviance.
    #[inline(always)]
    pub fn evaluate(&mut self, problem: Problem, nuisances: Nuisances, scratch: &mut Scratch) -> f64 {
        let compressed = problem.compressed;
        self.model
            .place(problem.bases, compressed, nuisances, &mut scratch.profiles);
        solve_amplitudes(&mut self.model, compressed, &mut scratch.amplitudes, &mut scratch.strip);
        let sources = &self.model.sources;
        let penalty = prior_penalty(sources) + constraint_deviance(problem, sources);
        self.residual.clear();
        self.residual.extend_from_slice(&compressed.coefficients);
        for i in 0..self.model.components() {
            self.model
                .accumulate(i, 0, 0, -self.model.amplitude(i), &mut self.residual);
        }
        penalty + compressed.apply_weights(&mut self.residual, problem.bases.axes(), true, &mut scratch.profiles)
    }

    /// The light that the model predicts, (my, mx).
    pub fn expected_light(&self) -> Vec<f64> {
        let mut sum = vec![0.0; self.residual.len()];
        for i in 0..self.model.components() {
            self.model.accumulate(i, 0, 0, self.model.amplitude(i), &mut sum);
        }
        sum
    }
}

fn constraint_deviance(problem: Problem, sources: &[PointSource]) -> f64 {
    problem.constraint.map_or(0.0, |c| c.deviance(sources))
}
