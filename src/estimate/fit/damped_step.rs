//! One damped Levenberg–Marquardt step with geodesic acceleration.

use crate::estimate::dense_linalg::{cholesky, dot, solve};
use crate::estimate::fit::evaluation::Evaluation;
use crate::estimate::fit::normal_equations::NormalEquations;
use crate::estimate::fit::problem::Problem;
use crate::estimate::fit::scratch::Scratch;
use crate::estimate::model::separable_model::SeparableModel;

/// |acceleration|² over |velocity|² above which the acceleration is dropped (Transtrum and Sethna, 2012, eq. 15).
const MAX_ACCELERATION: f64 = 0.56 / 4.0;

/// Largest correlation between the axes: an ellipse with an axis ratio of 1.7. Beyond, a source would take the place of a pair.
const MAX_CORRELATION: f64 = 0.5;

/// Damping of the predicted decrease, only against rounding.
const PREDICTION_DAMPING: f64 = 1e-10;

/// A step in all parameters: velocity + ½ acceleration.
#[derive(Default)]
pub(crate) struct Step {
    pub velocity: Vec<f64>,
    /// Zero where it is not computed, or too large against the velocity to be trusted.
    pub acceleration: Vec<f64>,
}

/// Sets the step's velocity (JᵀJ + λD)⁻¹ Jᵀr and leaves the system's factor in `factor`. `false` where the damped system is singular.
#[inline(always)]
pub(crate) fn step(equations: &NormalEquations, lambda: f64, factor: &mut Vec<f64>, step: &mut Step) -> bool {
    let p = equations.parameters;
    step.acceleration.clear();
    step.acceleration.resize(p, 0.0);
    if !factorise(equations, 1.0 + lambda + 1e-14, factor) {
        return false;
    }
    step.velocity.clone_from(&equations.gradient);
    solve(factor, p, &mut step.velocity);
    // A system singular to rounding may overflow.
    step.velocity.iter().all(|v| v.is_finite())
}

/// The Cholesky factor of the information with its diagonal times `diagonal`.
#[inline(always)]
fn factorise(equations: &NormalEquations, diagonal: f64, factor: &mut Vec<f64>) -> bool {
    let p = equations.parameters;
    factor.clone_from(&equations.information);
    for i in 0..p {
        factor[i * p + i] = factor[i * p + i].max(1e-30) * diagonal;
    }
    cholesky(factor, p)
}

impl Step {
    /// Sets the geodesic acceleration a = −(JᵀJ + λD)⁻¹ Jᵀ M_vv, with M_vv the model's second derivative along the velocity; zero where it
    /// is too large to be trusted. `scratch.factor` is the system's that the velocity solved.
    #[inline(always)]
    pub fn accelerate(
        &mut self,
        problem: Problem,
        at: &Evaluation,
        equations: &NormalEquations,
        scratch: &mut Scratch,
    ) {
        let (compressed, model) = (problem.compressed, &at.model);
        let p = equations.parameters;
        let second = &mut scratch.matrix;
        second.clear();
        second.resize(compressed.mx * compressed.my, 0.0);
        for (i, source) in model.sources.iter().enumerate() {
            let a = source.a;
            let (vx, vy, va) = (self.velocity[3 * i], self.velocity[3 * i + 1], self.velocity[3 * i + 2]);
            model.accumulate_second_derivative(
                i,
                [a * vx * vx, 2.0 * va * vx],
                [2.0 * a * vx * vy, 2.0 * va * vy],
                a * vy * vy,
                &mut scratch.profiles,
                second,
            );
        }
        // The acceleration need not be exact: a few masked pixels are ignored.
        if compressed.masked.scattered().is_empty() {
            compressed.apply_weights(second, problem.bases.axes(), false, &mut scratch.profiles);
        }
        let out = &mut self.acceleration;
        model.transposed_jacobian_times(second, &mut scratch.strip, out);
        let widths = equations.widths();
        for (w, derivative) in widths.iter().enumerate() {
            out[p - widths.len() + w] = dot(derivative, second);
        }
        for v in &mut *out {
            *v = -*v;
        }
        solve(&scratch.factor, p, out);
        let (mut speed, mut turn) = (0.0, 0.0);
        for i in 0..p {
            let scale = equations.information[i * p + i];
            speed += scale * self.velocity[i].powi(2);
            turn += scale * self.acceleration[i].powi(2);
        }
        if !(turn <= MAX_ACCELERATION * speed) {
            self.acceleration.fill(0.0);
        }
    }

    /// Sets `to` one step away from `from`; parameters stay within their ranges.
    #[inline(always)]
    pub fn take(&self, problem: Problem, widths: usize, from: &SeparableModel, to: &mut SeparableModel) {
        let p = self.velocity.len();
        let (bx, by) = (&problem.bases.x, &problem.bases.y);
        let delta = |i: usize| (self.velocity[i] + 0.5 * self.acceleration[i]).clamp(-1.0, 1.0);
        to.sources.clone_from(&from.sources);
        for (i, s) in to.sources.iter_mut().enumerate() {
            s.u[0] = (s.u[0] + delta(3 * i)).clamp(bx.min_position(), bx.max_position());
            s.u[1] = (s.u[1] + delta(3 * i + 1)).clamp(by.min_position(), by.max_position());
        }
        to.background = from.background;
        to.width = from.width;
        for w in 0..if widths > 0 { 2 } else { 0 } {
            let d = delta(p - widths + w.min(widths - 1)).clamp(-0.1, 0.1);
            to.width[w] = (from.width[w] * d.exp()).clamp(0.5, 2.0);
        }
        to.covariance_xy = from.covariance_xy;
        to.has_signed_energies = from.has_signed_energies;
        if widths > 2 {
            let room = MAX_CORRELATION * to.width[0].min(to.width[1]).powi(2);
            to.covariance_xy = (to.covariance_xy + delta(p - 1).clamp(-0.1, 0.1)).clamp(-room, room);
        }
    }
}

/// Decrease of the deviance that the nearly undamped quadratic model predicts. Overwrites the step's factor.
#[inline(always)]
pub(crate) fn predicted_decrease(equations: &NormalEquations, scratch: &mut Scratch) -> f64 {
    if !factorise(equations, 1.0 + PREDICTION_DAMPING, &mut scratch.factor) {
        return 0.0;
    }
    scratch.vector.clone_from(&equations.gradient);
    solve(&scratch.factor, equations.parameters, &mut scratch.vector);
    dot(&scratch.vector, &equations.gradient)
}
