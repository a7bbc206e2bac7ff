//! The joint fit of all sources and nuisances to one compressed frame: Levenberg–Marquardt in separable form.
//!
//! A frame is F_y·diag(A)·F_xᵀ, so a residual costs O(m² N) and the normal equations are Hadamard products of small
//! Gram matrices, O(m N²) (Golub and Pereyra, 1973, for separable least squares). Steps carry geodesic acceleration
//! (Transtrum and Sethna, 2012, eq. 14), amplitudes are solved by linear least squares at each trial, and masked pixels are
//! removed by a downdate, which is exact whatever they were filled with.
//!
//! In the pixel bases every component is evaluated only within its reach, and pixels may have weights of their own.

use std::time::Instant;

use crate::estimate::dense_linalg::dot;
use crate::estimate::fit::source_groups;
use crate::estimate::fit::work_budget::OVERRUN;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::{Hypothesis, Nuisances, prior_penalty};
use crate::estimate::model::separable_model::{self, SeparableModel};
use crate::estimate::model::svd_basis::Basis;
use crate::estimate::rules::Rules;
use crate::estimate::uncertainty::posterior_mean::ProfileConstraint;

/// Damping λ: first value, and range.
const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-14;
const LAMBDA_CEILING: f64 = 1e10;
/// Converged after two successive decreases of the deviance below this.
const CONVERGED_DECREASE: f64 = 1e-3;
/// Converged when the predicted decrease of the next step is below this.
const NEGLIGIBLE_DECREASE: f64 = 1e-4;
/// Sources farther apart than this, σ, along either axis need no geodesic acceleration.
const ACCELERATION_DISTANCE: f64 = 3.0;
/// Aborts when this many times the predicted decrease misses the acceptance threshold.
const ABORT_FACTOR: f64 = 5.0;
/// From this many times the expected deviance on, sources are missing and the others need no more digits: stalled steps end the fit.
const POOR_FIT_FACTOR: f64 = 100.0;
/// A poor fit ends after `STALLED_STEPS` successive steps that each decrease the deviance by less than this share.
const STALLED_SHARE: f64 = 1e-2;
const STALLED_STEPS: usize = 3;
/// A fit exceeds its number of steps, up to `MAX_STEP_FACTOR` times, while each decreases the deviance by more than this share.
const FAST_SHARE: f64 = 0.2;
pub(crate) const MAX_STEP_FACTOR: usize = 8;
/// Steps of all sources together before only the groups that still move are fitted, and how often that is tried.
pub(crate) const JOINT_STEPS: usize = 2;
const MAX_REGROUPINGS: usize = 2;

/// The fit's scratch memory. Grows to the largest problem seen and then allocates nothing.
pub(crate) struct Fitter {
    pub bx: Basis,
    pub by: Basis,
    pub rules: Rules,
    pub(crate) backgrounds: [[Vec<f64>; 2]; 2],
    pub(crate) current: SeparableModel,
    pub(crate) trial: SeparableModel,
    /// Weighted residual, (my, mx).
    pub(crate) residual: Vec<f64>,
    trial_residual: Vec<f64>,
    /// The predicted frame's derivatives in the widths and the covariance between the axes, (my, mx), plain and weighted.
    pub(crate) width_derivatives: [Vec<f64>; 3],
    pub(crate) weighted_derivative: Vec<f64>,
    /// Holds the positions near a hyperplane, if set.
    pub profile_constraint: Option<ProfileConstraint>,
    pub(crate) hessian: Vec<f64>,
    pub(crate) factor: Vec<f64>,
    pub(crate) gradient: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) acceleration: Vec<f64>,
    pub(crate) second_derivative: Vec<f64>,
    pub(crate) scratch: Vec<f64>,
    pub(crate) strip: Vec<f64>,
    pub(crate) amplitude_gram: Vec<f64>,
    pub(crate) is_free: Vec<bool>,
    /// Multiplications spent on this frame.
    pub(crate) work: f64,
    /// Limit of the work, whatever the hypotheses.
    pub(crate) work_limit: f64,
    /// Components of the largest hypothesis of this frame.
    pub(crate) max_components: f64,
    /// Steps spent on this frame.
    pub steps: u64,
    pub(crate) deadline: Option<Instant>,
}

impl Fitter {
    pub fn new(bx: Basis, by: Basis, rules: Rules) -> Self {
        let scratch = vec![0.0; 3 * bx.n.max(by.n)];
        Self {
            backgrounds: [separable_model::background(&bx), separable_model::background(&by)],
            bx,
            by,
            rules,
            current: SeparableModel::default(),
            trial: SeparableModel::default(),
            residual: Vec::new(),
            trial_residual: Vec::new(),
            width_derivatives: Default::default(),
            weighted_derivative: Vec::new(),
            profile_constraint: None,
            hessian: Vec::new(),
            factor: Vec::new(),
            gradient: Vec::new(),
            velocity: Vec::new(),
            acceleration: Vec::new(),
            second_derivative: Vec::new(),
            scratch,
            strip: Vec::new(),
            amplitude_gram: Vec::new(),
            is_free: Vec::new(),
            work: 0.0,
            work_limit: f64::INFINITY,
            max_components: 0.0,
            steps: 0,
            deadline: None,
        }
    }

    /// Fits `hypothesis` from where it stands, at most `steps` steps, and up to [`MAX_STEP_FACTOR`] times as many while each is large.
    pub fn fit(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis, steps: usize) {
        self.fit_below(compressed, hypothesis, steps, f64::INFINITY);
    }

    /// [`Self::fit`], aborted as soon as a deviance below `acceptance_threshold` is out of reach.
    pub fn fit_below(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        steps: usize,
        acceptance_threshold: f64,
    ) {
        let last = self.steps + steps as u64;
        for _ in 0..MAX_REGROUPINGS {
            if !self.rules.source_groups || self.profile_constraint.is_some() || self.steps + JOINT_STEPS as u64 >= last
            {
                break;
            }
            let Some(groups) = hypothesis.source_groups() else {
                break;
            };
            if !self.run_dispatched(compressed, hypothesis, JOINT_STEPS, acceptance_threshold) || hypothesis.converged {
                return;
            }
            let Some(active) = self.active_set(&groups) else { break };
            let rest = self.restrict_frame(compressed, &active);
            let mut subset = source_groups::restrict_hypothesis(hypothesis, &active);
            let left = last.saturating_sub(self.steps) as usize;
            let is_completed = self.run_dispatched(&rest, &mut subset, left, acceptance_threshold);
            for (&i, source) in active.iter().zip(&subset.sources) {
                hypothesis.sources[i] = *source;
            }
            if !is_completed {
                hypothesis.deviance = subset.deviance;
                return;
            }
        }
        let left = last.saturating_sub(self.steps) as usize;
        self.run_dispatched(compressed, hypothesis, left, acceptance_threshold);
    }

    /// `false` where the fit was aborted.
    fn run_dispatched(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        steps: usize,
        acceptance_threshold: f64,
    ) -> bool {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            compressed,
            hypothesis,
            steps,
            acceptance_threshold,
            wants_information: false,
        })
    }

    /// Sets the information matrix at `hypothesis` over (x, y, energy) of each source, then nuisances; units σ and noise. Row-major,
    /// upper triangle; see `Hypothesis::parameters`.
    pub fn compute_information(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) {
        pulp::Arch::new().dispatch(Job {
            fitter: self,
            compressed,
            hypothesis,
            steps: 0,
            acceptance_threshold: f64::INFINITY,
            wants_information: true,
        });
    }

    /// Weighted residual of `hypothesis` in the bases, (my, mx), with the deviance set.
    pub fn weighted_residual(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> &[f64] {
        self.fit(compressed, hypothesis, 0);
        &self.residual
    }

    /// The light that `hypothesis` predicts, (my, mx).
    pub fn expected_light(&mut self, compressed: &CompressedFrame, hypothesis: &mut Hypothesis) -> Vec<f64> {
        self.fit(compressed, hypothesis, 0);
        let mut sum = vec![0.0; compressed.mx * compressed.my];
        for i in 0..self.current.components() {
            self.current.accumulate(i, 0, 0, self.current.amplitude(i), &mut sum);
        }
        sum
    }

    /// `false` where the fit was aborted.
    #[inline(always)]
    fn iterate(
        &mut self,
        compressed: &CompressedFrame,
        hypothesis: &mut Hypothesis,
        steps: usize,
        acceptance_threshold: f64,
    ) -> bool {
        let nuisances = hypothesis.nuisances;
        self.current.sources.clone_from(&hypothesis.sources);
        self.current.background = hypothesis.background;
        self.current.width = hypothesis.width;
        self.current.covariance_xy = hypothesis.covariance_xy;
        for s in &mut self.current.sources {
            s.u[0] = s.u[0].clamp(self.bx.min_position(), self.bx.max_position());
            s.u[1] = s.u[1].clamp(self.by.min_position(), self.by.max_position());
        }
        let mut deviance = self.evaluate(compressed, nuisances, false);
        let parameters = hypothesis.parameters();
        let mut lambda = LAMBDA_START;
        let mut small_decreases = 0;
        let mut converged = parameters == nuisances.background_terms();
        let mut is_linearised = false;
        let has_overlap = self.current.sources.iter().enumerate().any(|(i, s)| {
            self.current.sources[..i].iter().any(|t| {
                (s.u[0] - t.u[0]).abs() < ACCELERATION_DISTANCE && (s.u[1] - t.u[1]).abs() < ACCELERATION_DISTANCE
            })
        });
        let mut is_completed = true;
        let mut is_fast = false;
        let mut stalled = 0;
        for k in 0..MAX_STEP_FACTOR * steps {
            if converged || k >= steps && !is_fast || stalled >= STALLED_STEPS {
                break;
            }
            if self.work > OVERRUN * self.max_work() {
                is_completed = false;
                break;
            }
            self.max_components = self.max_components.max(self.current.components() as f64);
            self.work += self.step_cost(compressed);
            self.steps += 1;
            if !is_linearised {
                self.compute_normal_equations(compressed, nuisances);
                is_linearised = true;
            }
            let moved = self.step(compressed, nuisances, lambda, has_overlap);
            if moved && lambda <= LAMBDA_START {
                let expected = dot(&self.velocity[..parameters], &self.gradient[..parameters]);
                if expected < NEGLIGIBLE_DECREASE {
                    converged = true;
                    break;
                }
                let is_unreachable = |decrease: f64| deviance - ABORT_FACTOR * decrease > acceptance_threshold;
                // Damping hides the decrease along ill-determined directions.
                if self.rules.abort_fits
                    && is_unreachable(expected)
                    && is_unreachable(self.predicted_decrease(parameters))
                {
                    is_completed = false;
                    break;
                }
            }
            let accepted = moved && {
                let next = self.evaluate(compressed, nuisances, true);
                let decrease = deviance - next;
                if decrease >= 0.0 {
                    small_decreases = if decrease < CONVERGED_DECREASE && lambda < 1e-3 {
                        small_decreases + 1
                    } else {
                        0
                    };
                    let is_poor_fit = self.rules.stop_stalled_fits && next > POOR_FIT_FACTOR * compressed.data_count;
                    is_fast = self.rules.extend_fast_fits && decrease > FAST_SHARE * deviance;
                    stalled = if is_poor_fit && decrease < STALLED_SHARE * deviance {
                        stalled + 1
                    } else {
                        0
                    };
                    deviance = next;
                }
                decrease >= 0.0
            };
            if accepted {
                std::mem::swap(&mut self.current, &mut self.trial);
                std::mem::swap(&mut self.residual, &mut self.trial_residual);
                lambda = (lambda * 0.15).max(LAMBDA_FLOOR);
                is_linearised = false;
                converged = small_decreases >= 2;
            } else {
                lambda *= 4.0;
                // Steps this short fail by rounding, not by curvature.
                if lambda > LAMBDA_CEILING {
                    converged = true;
                }
            }
        }
        hypothesis.sources.clone_from(&self.current.sources);
        hypothesis.background = self.current.background;
        hypothesis.width = self.current.width;
        hypothesis.covariance_xy = self.current.covariance_xy;
        hypothesis.deviance =
            deviance - prior_penalty(&hypothesis.sources) - self.constraint_deviance(&hypothesis.sources);
        // A fit of no steps only evaluates the deviance.
        hypothesis.converged = converged || steps == 0 && hypothesis.converged;
        is_completed
    }

    /// Evaluates the current or the trial model, solves its amplitudes, and returns the penalised deviance.
    #[inline(always)]
    fn evaluate(&mut self, compressed: &CompressedFrame, nuisances: Nuisances, is_trial: bool) -> f64 {
        let separable = if is_trial { &mut self.trial } else { &mut self.current };
        let backgrounds = [&self.backgrounds[0], &self.backgrounds[1]];
        separable.place(
            [&self.bx, &self.by],
            backgrounds,
            compressed,
            nuisances,
            &mut self.scratch,
        );
        self.solve_amplitudes(compressed, is_trial);
        let sources = if is_trial {
            &self.trial.sources
        } else {
            &self.current.sources
        };
        prior_penalty(sources) + self.constraint_deviance(sources) + self.compute_residual(compressed, is_trial)
    }

    /// Sets the weighted residual of the current or the trial model and returns its deviance.
    #[inline(always)]
    fn compute_residual(&mut self, compressed: &CompressedFrame, is_trial: bool) -> f64 {
        let (separable, residual) = if is_trial {
            (&self.trial, &mut self.trial_residual)
        } else {
            (&self.current, &mut self.residual)
        };
        residual.clear();
        residual.extend_from_slice(&compressed.coefficients);
        for i in 0..separable.components() {
            separable.accumulate(i, 0, 0, -separable.amplitude(i), residual);
        }
        compressed.apply_weights(residual, [&self.bx, &self.by], true, &mut self.scratch)
    }
}

struct Job<'a> {
    fitter: &'a mut Fitter,
    compressed: &'a CompressedFrame,
    hypothesis: &'a mut Hypothesis,
    steps: usize,
    acceptance_threshold: f64,
    wants_information: bool,
}

impl pulp::NullaryFnOnce for Job<'_> {
    /// `false` where the fit was aborted.
    type Output = bool;

    #[inline(always)]
    fn call(self) -> bool {
        let is_completed = self
            .fitter
            .iterate(self.compressed, self.hypothesis, self.steps, self.acceptance_threshold);
        if self.wants_information {
            self.fitter.work += self.fitter.step_cost(self.compressed);
            self.fitter
                .compute_normal_equations(self.compressed, self.hypothesis.nuisances);
        }
        is_completed
    }
}
