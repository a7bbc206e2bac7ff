//! The time by which pose stamps are behind the frames', learned from the light: where poses are late by τ, what all beams share
//! against their tracks goes with the platform's rates, −ω·τ.

use nalgebra::Vector6;

/// Standard deviation of the delay before anything is learned, s: telemetry over a serial port is 10 to 30 ms late. Larger widens
/// positions while the platform turns, smaller alerts users then.
const UNKNOWN_S: f64 = 0.03;
/// Largest delay that is learned, s: beyond it poses are lost rather than late.
const MAX_S: f64 = 0.25;
/// Time over which a steady turn, and a steady error, are taken for what they are, s: they do not show a delay. Longer takes a slow
/// turn for a sway.
const STEADY_S: f64 = 5.0;
/// Time over which frames count, s: clocks drift by milliseconds within minutes.
const MEMORY_S: f64 = 60.0;
/// Least standard deviation of a frame's turn error, rad, and of what is learned, s: a tenth of a pixel, and half of the 0.5 ms that
/// are asked for.
const LEAST_RAD: f64 = 1e-4;
const LEAST_S: f64 = 2.5e-4;

/// A slowly learned delay.
#[derive(Clone, Copy, Debug, Default)]
pub struct DelayEstimate {
    delay_s: f64,
    /// Of the frames so far, 1/s².
    information: f64,
    mean_rates: Vector6<f64>,
    mean_error: Vector6<f64>,
    /// Mean square of a frame's turn error about its mean, rad², and the time over which it was taken, s.
    scatter: f64,
    seen_s: f64,
}

impl DelayEstimate {
    /// Pose stamps minus frame stamps, s.
    pub fn delay_s(&self) -> f64 {
        self.delay_s
    }

    /// Standard deviation of it, s.
    pub fn std_s(&self) -> f64 {
        (UNKNOWN_S.powi(-2) + self.information).sqrt().recip().max(LEAST_S)
    }

    /// Takes the pose error that a frame's beams share (as a registration gives it), the platform's rates then, and the time since
    /// the last frame.
    pub fn learn(&mut self, error: &Vector6<f64>, rates: &Vector6<f64>, dt_s: f64) {
        if !(dt_s > 0.0 && dt_s < 1.0) {
            return;
        }
        self.seen_s += dt_s;
        let blend = (dt_s / self.seen_s.min(STEADY_S)).min(1.0);
        self.mean_rates += (rates - self.mean_rates) * blend;
        self.mean_error += (error - self.mean_error) * blend;
        let (rate, off) = (rates - self.mean_rates, error - self.mean_error);
        // The tilt alone: beams show it best, and a heading's error is not seen near the nadir.
        let (rate, off) = (rate.fixed_rows::<2>(0), off.fixed_rows::<2>(0));
        self.scatter += (0.5 * off.norm_squared() - self.scatter) * blend;
        self.information *= (-dt_s / MEMORY_S).exp();
        if self.seen_s < STEADY_S {
            return;
        }
        let variance = self.scatter.max(LEAST_RAD * LEAST_RAD);
        self.information += rate.norm_squared() / variance;
        let gain = 1.0 / (UNKNOWN_S.powi(-2) + self.information) / variance;
        self.delay_s = (self.delay_s - gain * rate.dot(&off)).clamp(-MAX_S, MAX_S);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_delay_is_found_from_the_error_that_goes_with_the_rate() {
        let mut estimate = DelayEstimate::default();
        assert_eq!(estimate.std_s(), UNKNOWN_S);
        for k in 0..600 {
            let t = 0.1 * f64::from(k);
            let rates = Vector6::new(0.04 * (0.8 * t).cos(), 0.04 * (0.7 * t).sin(), 0.0175, 0.0, 0.0, 0.0);
            // Poses are 30 ms late; a tilt of 3 mrad lasts.
            let mut error = rates * (estimate.delay_s() - 0.03);
            error[0] += 0.003 + 1e-4 * (37.0 * t).sin();
            estimate.learn(&error, &rates, 0.1);
        }
        assert!((estimate.delay_s() - 0.03).abs() < 1e-3, "{estimate:?}");
        assert!(estimate.std_s() < 2e-3, "{}", estimate.std_s());
    }
}
