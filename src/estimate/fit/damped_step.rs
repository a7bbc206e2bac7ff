//! One damped Levenberg–Marquardt step with geodesic acceleration.

use crate::estimate::dense_linalg::{cholesky, dot, solve};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::CompressedFrame;
use crate::estimate::model::hypothesis::Nuisances;

/// |acceleration|² over |velocity|² above which the acceleration is dropped (Transtrum and Sethna, 2012, eq. 15).
const MAX_ACCELERATION: f64 = 0.56 / 4.0;

/// Largest correlation between the axes: an ellipse with an axis ratio of 1.7.
const MAX_CORRELATION: f64 = 0.5;

/// Damping of the predicted decrease, only against rounding.
const PREDICTION_DAMPING: f64 = 1e-10;

impl Fitter {
    /// Sets the trial model one damped, accelerated step away. `false` where the damped system is singular.
    #[inline(always)]
    pub(crate) fn step(
        &mut self,
        compressed: &CompressedFrame,
        nuisances: Nuisances,
        lambda: f64,
        has_overlap: bool,
    ) -> bool {
        let n = self.current.sources.len();
        let p = 3 * n + nuisances.count();
        // An empty velocity says that no step was taken.
        self.velocity.clear();
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..p * p]);
        for i in 0..p {
            self.factor[i * p + i] = self.factor[i * p + i].max(1e-30) * (1.0 + lambda + 1e-14);
        }
        if !cholesky(&mut self.factor, p) {
            return false;
        }
        self.velocity.extend_from_slice(&self.gradient[..p]);
        solve(&self.factor, p, &mut self.velocity);
        // A system singular to rounding may overflow.
        if !self.velocity.iter().all(|v| v.is_finite()) {
            self.velocity.clear();
            return false;
        }
        if has_overlap {
            self.accelerate(compressed, nuisances, p);
        } else {
            self.acceleration.clear();
            self.acceleration.resize(p, 0.0);
        }
        let (mut speed, mut turn) = (0.0, 0.0);
        for i in 0..p {
            let scale = self.hessian[i * p + i];
            speed += scale * self.velocity[i].powi(2);
            turn += scale * self.acceleration[i].powi(2);
        }
        let is_trusted = turn <= MAX_ACCELERATION * speed;
        let delta = |i: usize| {
            let d = self.velocity[i] + if is_trusted { 0.5 * self.acceleration[i] } else { 0.0 };
            d.clamp(-1.0, 1.0)
        };
        let trial = &mut self.trial;
        trial.sources.clone_from(&self.current.sources);
        for (i, s) in trial.sources.iter_mut().enumerate() {
            s.u[0] = (s.u[0] + delta(3 * i)).clamp(self.bx.min_position(), self.bx.max_position());
            s.u[1] = (s.u[1] + delta(3 * i + 1)).clamp(self.by.min_position(), self.by.max_position());
        }
        trial.background = self.current.background;
        trial.width = self.current.width;
        let widths = nuisances.widths();
        for w in 0..if widths > 0 { 2 } else { 0 } {
            let d = delta(p - widths + w.min(widths - 1)).clamp(-0.1, 0.1);
            trial.width[w] = (self.current.width[w] * d.exp()).clamp(0.5, 2.0);
        }
        trial.covariance_xy = self.current.covariance_xy;
        if widths > 2 {
            let room = MAX_CORRELATION * trial.width[0].min(trial.width[1]).powi(2);
            trial.covariance_xy = (trial.covariance_xy + delta(p - 1).clamp(-0.1, 0.1)).clamp(-room, room);
        }
        true
    }

    /// Decrease of the deviance that the nearly undamped quadratic model predicts. Overwrites the step's factor.
    #[inline(always)]
    pub(crate) fn predicted_decrease(&mut self, p: usize) -> f64 {
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..p * p]);
        for i in 0..p {
            self.factor[i * p + i] = self.factor[i * p + i].max(1e-30) * (1.0 + PREDICTION_DAMPING);
        }
        if !cholesky(&mut self.factor, p) {
            return 0.0;
        }
        self.acceleration.clear();
        self.acceleration.extend_from_slice(&self.gradient[..p]);
        solve(&self.factor, p, &mut self.acceleration);
        dot(&self.acceleration, &self.gradient[..p])
    }

    /// Geodesic acceleration a = −(JᵀJ + λD)⁻¹ Jᵀ M_vv, with M_vv the model's second derivative along the velocity.
    #[inline(always)]
    fn accelerate(&mut self, compressed: &CompressedFrame, nuisances: Nuisances, p: usize) {
        let separable = &self.current;
        let n = separable.sources.len();
        let second_derivative = &mut self.second_derivative;
        second_derivative.clear();
        second_derivative.resize(compressed.mx * compressed.my, 0.0);
        for i in 0..n {
            let a = separable.sources[i].a;
            let (vx, vy, va) = (self.velocity[3 * i], self.velocity[3 * i + 1], self.velocity[3 * i + 2]);
            separable.accumulate_second_derivative(
                i,
                [a * vx * vx, 2.0 * va * vx],
                [2.0 * a * vx * vy, 2.0 * va * vy],
                a * vy * vy,
                &mut self.scratch,
                second_derivative,
            );
        }
        // The acceleration need not be exact: a few masked pixels are ignored.
        if compressed.masked.scattered().is_empty() {
            compressed.apply_weights(second_derivative, [&self.bx, &self.by], false, &mut self.scratch);
        }
        self.acceleration.clear();
        self.acceleration.resize(p, 0.0);
        let out = &mut self.acceleration;
        separable.transposed_jacobian_times(second_derivative, &mut self.strip, out);
        let widths = nuisances.widths();
        for w in 0..widths {
            out[p - widths + w] = dot(&self.width_derivatives[w], second_derivative);
        }
        for v in &mut *out {
            *v = -*v;
        }
        solve(&self.factor, p, out);
    }
}
