//! One damped step of the fit, curved by geodesic acceleration.

use crate::estimate::dense_linalg::{cholesky, dot, solve};
use crate::estimate::fit::levenberg_marquardt::Fitter;
use crate::estimate::model::compressed_frame::Reading;
use crate::estimate::model::hypothesis::Nuisances;

/// |acceleration|² over |velocity|² above which a step is not trusted (Transtrum and Sethna, 2012, eq. 15).
const LARGEST_ACCELERATION: f64 = 0.56 / 4.0;

/// Largest correlation between the axes: an ellipse 1.7 times as long as wide.
const MOST_TURN: f64 = 0.5;

/// Damping of a promise: what keeps rounding from promising anything.
const UNDAMPED: f64 = 1e-10;

impl Fitter {
    /// Sets the trial hypothesis one damped, accelerated step away. `false` where no step could be had.
    #[inline(always)]
    pub(crate) fn step(&mut self, reading: &Reading, nuisances: Nuisances, lambda: f64, overlap: bool) -> bool {
        let n = self.now.spots.len();
        let p = 3 * n + nuisances.count();
        // Without a step there is no velocity, nor an earlier fit's.
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
        if overlap {
            self.accelerate(reading, nuisances, p);
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
        let is_trusted = turn <= LARGEST_ACCELERATION * speed;
        let delta = |i: usize| {
            let d = self.velocity[i] + if is_trusted { 0.5 * self.acceleration[i] } else { 0.0 };
            d.clamp(-1.0, 1.0)
        };
        let trial = &mut self.trial;
        trial.spots.clone_from(&self.now.spots);
        for (i, s) in trial.spots.iter_mut().enumerate() {
            s.u[0] = (s.u[0] + delta(3 * i)).clamp(self.bx.lowest(), self.bx.highest());
            s.u[1] = (s.u[1] + delta(3 * i + 1)).clamp(self.by.lowest(), self.by.highest());
        }
        trial.background = self.now.background;
        trial.width = self.now.width;
        let widths = nuisances.widths();
        for w in 0..if widths > 0 { 2 } else { 0 } {
            let d = delta(p - widths + w.min(widths - 1)).clamp(-0.1, 0.1);
            trial.width[w] = (self.now.width[w] * d.exp()).clamp(0.5, 2.0);
        }
        trial.turn = self.now.turn;
        if widths > 2 {
            let room = MOST_TURN * trial.width[0].min(trial.width[1]).powi(2);
            trial.turn = (trial.turn + delta(p - 1).clamp(-0.1, 0.1)).clamp(-room, room);
        }
        true
    }

    /// Drop of the deviance that the quadratic promises, all but undamped. Spoils the factor that a step left.
    #[inline(always)]
    pub(crate) fn promise(&mut self, p: usize) -> f64 {
        self.factor.clear();
        self.factor.extend_from_slice(&self.hessian[..p * p]);
        for i in 0..p {
            self.factor[i * p + i] = self.factor[i * p + i].max(1e-30) * (1.0 + UNDAMPED);
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
    fn accelerate(&mut self, reading: &Reading, nuisances: Nuisances, p: usize) {
        let atoms = &self.now;
        let n = atoms.spots.len();
        let bend = &mut self.bend;
        bend.clear();
        bend.resize(reading.mx * reading.my, 0.0);
        for i in 0..n {
            let a = atoms.spots[i].a;
            let (vx, vy, va) = (self.velocity[3 * i], self.velocity[3 * i + 1], self.velocity[3 * i + 2]);
            atoms.add_bent(
                i,
                [a * vx * vx, 2.0 * va * vx],
                [2.0 * a * vx * vy, 2.0 * va * vy],
                a * vy * vy,
                &mut self.scratch,
                bend,
            );
        }
        // A few pixels more or less make no other step.
        if reading.bad.scattered().is_empty() {
            reading.weight(bend, [&self.bx, &self.by], false, &mut self.scratch);
        }
        self.acceleration.clear();
        self.acceleration.resize(p, 0.0);
        let out = &mut self.acceleration;
        atoms.slopes(bend, &mut self.strip, out);
        let widths = nuisances.widths();
        for w in 0..widths {
            out[p - widths + w] = dot(&self.broadening[w], bend);
        }
        for v in &mut *out {
            *v = -*v;
        }
        solve(&self.factor, p, out);
    }
}
