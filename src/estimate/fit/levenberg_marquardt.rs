//! The joint fit of all sources and nuisances to one compressed frame: Levenberg–Marquardt in separable form.
//!
//! A frame is F_y·diag(A)·F_xᵀ, so a residual costs O(m² N) and the normal equations are Hadamard products of small
//! Gram matrices, O(m N²) (Golub and Pereyra, 1973, for separable least squares). Steps carry geodesic acceleration
//! (Transtrum and Sethna, 2012, eq. 14), amplitudes are solved by linear least squares at each trial, and masked pixels are
//! removed by a downdate, which is exact whatever they were filled with.
//!
//! In the pixel bases every component is evaluated only within its reach, and pixels may have weights of their own.

use crate::estimate::dense_linalg::{dispatch, dot};
use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::damped_step::{predicted_decrease, step};
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::scratch::Scratch;
use crate::estimate::fit::source_groups::{active_set, restrict_frame, restrict_hypothesis, source_groups};
use crate::estimate::fit::work_budget::{WorkBudget, step_cost};
use crate::estimate::fit::workspace::Workspace;
use crate::estimate::model::hypothesis::{Hypothesis, PointSource};
use crate::estimate::rules::Rules;

/// Damping λ: first value, and range. The first trusts the start (undamped steps may leap out of its basin), the floor is rounding's, and
/// at the ceiling a step is below the last digit of a position.
const LAMBDA_START: f64 = 1e-3;
const LAMBDA_FLOOR: f64 = 1e-14;
const LAMBDA_CEILING: f64 = 1e10;
/// Converged after two successive decreases of the deviance below this, which moves a position by 3 % of its standard deviation.
const CONVERGED_DECREASE: f64 = 1e-3;
/// Converged when the predicted decrease of the next step is below this: 1 % of a standard deviation.
const NEGLIGIBLE_DECREASE: f64 = 1e-4;
/// Sources farther apart than this, σ, along either axis need no geodesic acceleration: their profiles overlap by exp(−9/4) and the
/// deviance is no curved valley.
const ACCELERATION_DISTANCE: f64 = 3.0;
/// Aborts when this many times the predicted decrease misses the acceptance threshold: larger loses time on hopeless fits, smaller gives up
/// those that a first step underestimates.
const ABORT_FACTOR: f64 = 5.0;
/// From this many times the expected deviance on, sources are missing and the others need no more digits: stalled steps end the fit. Well
/// above what a wrong width or a background leave.
const POOR_FIT_FACTOR: f64 = 100.0;
/// A poor fit ends after `STALLED_STEPS` successive steps that each decrease the deviance by less than this share; one such step may be the
/// bend of a valley.
const STALLED_SHARE: f64 = 1e-2;
const STALLED_STEPS: usize = 3;
/// Steps of all sources together before only the groups that still move are fitted, and how often that is tried: after the first step every
/// group moves, after many there is nothing left to save.
pub(crate) const JOINT_STEPS: usize = 2;
const MAX_REGROUPINGS: usize = 2;

/// Why a fit ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Termination {
    /// There is no non-linear parameter: the amplitudes are solved.
    NoParameter,
    /// The predicted decrease of the next step is negligible.
    NegligibleDecrease,
    /// Two successive steps decreased the deviance by little.
    SmallDecreases,
    /// Steps so short failed that rounding must be the cause.
    DampingCeiling,
    /// The number of steps is spent.
    StepLimit,
    /// A poor fit no longer improves.
    Stalled,
    /// A deviance below the acceptance threshold is out of reach.
    OutOfReach,
    /// The frame's work is spent.
    OutOfWork,
}

impl Termination {
    /// Whether the fit stands at a minimum of the deviance.
    pub fn is_converged(self) -> bool {
        matches!(
            self,
            Self::NoParameter | Self::NegligibleDecrease | Self::SmallDecreases | Self::DampingCeiling
        )
    }

    /// Whether the fit was given up.
    pub fn is_aborted(self) -> bool {
        matches!(self, Self::OutOfReach | Self::OutOfWork)
    }
}

/// How far a fit may go.
#[derive(Clone, Copy)]
struct Limits {
    steps: usize,
    /// The fit is aborted as soon as a deviance below this is out of reach.
    acceptance_threshold: f64,
}

/// A hypothesis evaluated, with its normal equations; borrowed from the workspace, so that no other fit can come in between.
pub(crate) struct Linearisation<'w> {
    pub evaluation: &'w Evaluation,
    pub equations: &'w NormalEquations,
    pub scratch: &'w mut Scratch,
}

/// Fits `hypothesis` from where it stands, at most `steps` steps.
pub(crate) fn fit(context: &mut FitContext, hypothesis: &mut Hypothesis, steps: usize) -> Termination {
    fit_below(context, hypothesis, steps, f64::INFINITY)
}

/// [`fit`], aborted as soon as a deviance below `acceptance_threshold` is out of reach.
pub(crate) fn fit_below(
    context: &mut FitContext,
    hypothesis: &mut Hypothesis,
    steps: usize,
    acceptance_threshold: f64,
) -> Termination {
    let problem = context.problem();
    let last = context.budget.steps + steps as u64;
    let within = |steps: usize| Limits {
        steps,
        acceptance_threshold,
    };
    for _ in 0..MAX_REGROUPINGS {
        if !context.rules.source_groups || context.budget.steps + JOINT_STEPS as u64 >= last {
            break;
        }
        let Some(groups) = source_groups(hypothesis) else {
            break;
        };
        let joint = run(context, problem, hypothesis, within(JOINT_STEPS));
        if joint.termination.is_aborted() || hypothesis.converged {
            return joint.termination;
        }
        let Workspace {
            current,
            equations,
            step,
            ..
        } = &*context.workspace;
        let active = if joint.has_step {
            active_set(&groups, step, equations)
        } else {
            None
        };
        let Some(active) = active else { break };
        let rest = restrict_frame(problem.compressed, problem.bases, &current.model, &active);
        let mut subset = restrict_hypothesis(hypothesis, &active);
        let left = last.saturating_sub(context.budget.steps) as usize;
        let of_rest = Problem {
            compressed: &rest,
            ..problem
        };
        let alone = run(context, of_rest, &mut subset, within(left));
        for (&i, source) in active.iter().zip(&subset.sources) {
            hypothesis.sources[i] = *source;
        }
        if alone.termination.is_aborted() {
            hypothesis.deviance = subset.deviance;
            return alone.termination;
        }
    }
    let left = last.saturating_sub(context.budget.steps) as usize;
    run(context, problem, hypothesis, within(left)).termination
}

/// Fits `hypothesis` to `problem`, which may hold a constraint, all sources together.
pub(crate) fn fit_problem(
    context: &mut FitContext,
    problem: Problem,
    hypothesis: &mut Hypothesis,
    steps: usize,
) -> Termination {
    let limits = Limits {
        steps,
        acceptance_threshold: f64::INFINITY,
    };
    run(context, problem, hypothesis, limits).termination
}

/// Evaluates `hypothesis`: solves its amplitudes and sets its deviance.
pub(crate) fn evaluate<'w>(context: &'w mut FitContext, hypothesis: &mut Hypothesis) -> &'w Evaluation {
    fit(context, hypothesis, 0);
    &context.workspace.current
}

/// Evaluates `hypothesis` in `problem` and sets up its normal equations.
pub(crate) fn linearise<'w>(
    problem: Problem,
    hypothesis: &mut Hypothesis,
    budget: &mut WorkBudget,
    workspace: &'w mut Workspace,
) -> Linearisation<'w> {
    dispatch!(<'w, 'a, 'b>
        problem: Problem<'a> = problem,
        hypothesis: &'w mut Hypothesis = hypothesis,
        budget: &'w mut WorkBudget<'b> = budget,
        workspace: &'w mut Workspace = workspace
        => (): evaluate_with_equations(problem, hypothesis, budget, workspace));
    let Workspace {
        current,
        equations,
        scratch,
        ..
    } = workspace;
    Linearisation {
        evaluation: current,
        equations,
        scratch,
    }
}

fn run(context: &mut FitContext, problem: Problem, hypothesis: &mut Hypothesis, limits: Limits) -> Run {
    dispatch!(<'w, 'a, 'b>
        problem: Problem<'a> = problem,
        hypothesis: &'w mut Hypothesis = hypothesis,
        limits: Limits = limits,
        rules: Rules = context.rules,
        budget: &'w mut WorkBudget<'b> = context.budget,
        workspace: &'w mut Workspace = context.workspace
        => Run: iterate(problem, hypothesis, limits, rules, budget, workspace))
}

/// How a run of steps ended, and whether the workspace holds its last step.
struct Run {
    termination: Termination,
    has_step: bool,
}

/// Levenberg–Marquardt steps within the limits.
#[inline(always)]
fn iterate(
    problem: Problem,
    hypothesis: &mut Hypothesis,
    limits: Limits,
    rules: Rules,
    budget: &mut WorkBudget,
    workspace: &mut Workspace,
) -> Run {
    let Workspace {
        current,
        trial,
        equations,
        step: last_step,
        scratch,
    } = workspace;
    let nuisances = hypothesis.nuisances;
    current.load(problem, hypothesis);
    let mut deviance = current.evaluate(problem, nuisances, scratch);
    let has_overlap = has_overlap(&current.model.sources);
    let mut lambda = LAMBDA_START;
    let mut small_decreases = 0;
    let mut is_linearised = false;
    let mut stalled = 0;
    let mut has_step = false;
    let mut steps_taken = 0;
    let mut end = (hypothesis.parameters() == nuisances.background_terms()).then_some(Termination::NoParameter);
    let termination = loop {
        if let Some(reason) = end {
            break reason;
        }
        if steps_taken >= limits.steps {
            break Termination::StepLimit;
        }
        if stalled >= STALLED_STEPS {
            break Termination::Stalled;
        }
        if budget.is_overrun() {
            break Termination::OutOfWork;
        }
        steps_taken += 1;
        budget.charge_step(
            current.model.components(),
            step_cost(problem.bases, problem.compressed, &current.model),
        );
        if !is_linearised {
            equations.compute(problem, nuisances, current, scratch);
            is_linearised = true;
        }
        has_step = step(equations, lambda, &mut scratch.factor, last_step);
        if has_step && has_overlap {
            last_step.accelerate(problem, current, equations, scratch);
        }
        if has_step && lambda <= LAMBDA_START {
            let expected = dot(&last_step.velocity, &equations.gradient);
            if expected < NEGLIGIBLE_DECREASE {
                break Termination::NegligibleDecrease;
            }
            let is_unreachable = |decrease: f64| deviance - ABORT_FACTOR * decrease > limits.acceptance_threshold;
            // Damping hides the decrease along ill-determined directions.
            if rules.abort_fits && is_unreachable(expected) && is_unreachable(predicted_decrease(equations, scratch)) {
                break Termination::OutOfReach;
            }
        }
        let mut is_accepted = false;
        if has_step {
            last_step.take(problem, nuisances.widths(), &current.model, &mut trial.model);
            let next = trial.evaluate(problem, nuisances, scratch);
            let decrease = deviance - next;
            is_accepted = decrease >= 0.0;
            if is_accepted {
                small_decreases = if decrease < CONVERGED_DECREASE && lambda < 1e-3 {
                    small_decreases + 1
                } else {
                    0
                };
                let is_poor_fit = rules.stop_stalled_fits && next > POOR_FIT_FACTOR * problem.compressed.data_count;
                stalled = if is_poor_fit && decrease < STALLED_SHARE * deviance {
                    stalled + 1
                } else {
                    0
                };
                deviance = next;
            }
        }
        if is_accepted {
            std::mem::swap(current, trial);
            lambda = (lambda * 0.15).max(LAMBDA_FLOOR);
            is_linearised = false;
            end = (small_decreases >= 2).then_some(Termination::SmallDecreases);
        } else {
            lambda *= 4.0;
            end = (lambda > LAMBDA_CEILING).then_some(Termination::DampingCeiling);
        }
    };
    current.store(problem, deviance, hypothesis);
    // A fit of no steps only evaluates the deviance.
    hypothesis.converged = termination.is_converged() || limits.steps == 0 && hypothesis.converged;
    Run { termination, has_step }
}

/// Whether two sources are so near that a step needs acceleration.
fn has_overlap(sources: &[PointSource]) -> bool {
    sources.iter().enumerate().any(|(i, s)| {
        sources[..i]
            .iter()
            .any(|t| (s.u[0] - t.u[0]).abs() < ACCELERATION_DISTANCE && (s.u[1] - t.u[1]).abs() < ACCELERATION_DISTANCE)
    })
}

#[inline(always)]
fn evaluate_with_equations(
    problem: Problem,
    hypothesis: &mut Hypothesis,
    budget: &mut WorkBudget,
    workspace: &mut Workspace,
) {
    let Workspace {
        current,
        equations,
        scratch,
        ..
    } = workspace;
    let nuisances = hypothesis.nuisances;
    current.load(problem, hypothesis);
    let deviance = current.evaluate(problem, nuisances, scratch);
    current.store(problem, deviance, hypothesis);
    hypothesis.converged |= hypothesis.parameters() == nuisances.background_terms();
    budget.charge(step_cost(problem.bases, problem.compressed, &current.model));
    equations.compute(problem, nuisances, current, scratch);
}
