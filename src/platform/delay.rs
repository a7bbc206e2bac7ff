//! The time by which pose stamps are behind the frames', learned from the light: where poses are late by τ, what all beams share
//! against their tracks goes with the platform's rates, −ω·τ.

use nalgebra::{Matrix2, Matrix6, Vector6};

/// Standard deviation of the delay before anything is learned, s: telemetry over a serial port is 10 to 30 ms late. Larger widens
/// positions while the platform turns, smaller alerts users then.
const UNKNOWN_S: f64 = 0.03;
/// Largest delay that is learned, s: beyond it poses are lost rather than late.
const MAX_S: f64 = 0.25;
/// Length of a block, s, in which what is not the delay's is taken for a straight line of time, or a cubic: lasting errors, tracks that began
/// with the sway's velocity and settle over half a minute, and users who drive in bends. Longer blocks tell a slow sway better from these, shorter
/// ones follow their bends.
const BLOCK_S: f64 = 10.0;
/// Ratio of the variances that a line and a cubic leave from which it is a cubic: it takes half of what a slow sway tells of the delay.
const CURVED: f64 = 1.25;
/// Least part of a block that says anything, s: half a sway looks like a line.
const LEAST_BLOCK_S: f64 = 5.0;
/// Time over which frames count, s: clocks drift by milliseconds within minutes.
const MEMORY_S: f64 = 60.0;
/// Least standard deviation of a frame's turn error, rad, and of what is learned, s: a tenth of a pixel, and half of the 0.5 ms that
/// are asked for.
const LEAST_RAD: f64 = 1e-4;
const LEAST_S: f64 = 2.5e-4;

/// A slowly learned delay: τ by least squares over blocks of time, in each of which the error is −ω·τ and a line or a cubic.
#[derive(Clone, Copy, Debug, Default)]
pub struct DelayEstimate {
    /// Of the blocks so far and of the one that is under way.
    closed: Said,
    open: Said,
    block: Block,
}

/// What is known of the delay: its information, 1/s², and that times the delay.
#[derive(Clone, Copy, Debug, Default)]
struct Said {
    information: f64,
    vector: f64,
}

/// Second moments of (1, t, t², t³, rate, rate × delay) of both tilts.
#[derive(Clone, Copy, Debug, Default)]
struct Block {
    seen_s: f64,
    frames: u32,
    moments: [Matrix6<f64>; 2],
}

impl Block {
    /// The delay of this block alone. What is not the delay's is a line, and a cubic where that leaves much less.
    fn said(&self) -> Option<Said> {
        let (line, of_line) = self.said_beside::<2>()?;
        let (cubic, of_cubic) = self.said_beside::<4>()?;
        Some(if of_line > CURVED * of_cubic { cubic } else { line })
    }

    /// The delay beside a polynomial of so many coefficients, which is eliminated (Schur complement), and the variance of what both leave.
    fn said_beside<const N: usize>(&self) -> Option<(Said, f64)> {
        let mut left = Matrix2::zeros();
        for moments in &self.moments {
            let polynomial = moments.view((0, 0), (N, N)).into_owned();
            let cross = moments.view((0, 4), (N, 2)).into_owned();
            let own: Matrix2<f64> = moments.fixed_view::<2, 2>(4, 4).into();
            left += own - cross.transpose() * polynomial.try_inverse()? * &cross;
        }
        let (rates, product, squares) = (left[(0, 0)], left[(0, 1)], left[(1, 1)]);
        // Two polynomials and the delay are fitted.
        let fitted = 2 * N as u32 + 1;
        let freedom = (2 * self.frames).checked_sub(fitted).filter(|f| *f > 0)?;
        if !(self.seen_s >= LEAST_BLOCK_S && rates > 0.0) {
            return None;
        }
        let variance = ((squares - product * product / rates) / f64::from(freedom)).max(LEAST_RAD * LEAST_RAD);
        let said = Said {
            information: rates / variance,
            vector: product / variance,
        };
        Some((said, variance))
    }
}

impl DelayEstimate {
    /// Pose stamps minus frame stamps, s.
    pub fn delay_s(&self) -> f64 {
        let vector = self.closed.vector + self.open.vector;
        (vector / self.information()).clamp(-MAX_S, MAX_S)
    }

    /// Standard deviation of it, s.
    pub fn std_s(&self) -> f64 {
        self.information().sqrt().recip().max(LEAST_S)
    }

    fn information(&self) -> f64 {
        UNKNOWN_S.powi(-2) + self.closed.information + self.open.information
    }

    /// Takes the pose error that a frame's beams share (as a registration gives it) where poses were taken `delay_s` late, the
    /// platform's rates then, and the time since the last frame.
    pub fn learn(&mut self, error: &Vector6<f64>, delay_s: f64, rates: &Vector6<f64>, dt_s: f64) {
        if !(dt_s > 0.0 && dt_s < 1.0) {
            self.close();
            return;
        }
        self.block.seen_s += dt_s;
        self.block.frames += 1;
        // The tilt alone: beams show it best, and a heading's error is not seen near the nadir.
        let t = 2.0 * self.block.seen_s / BLOCK_S - 1.0;
        for axis in 0..2 {
            let (rate, shown) = (rates[axis], rates[axis] * delay_s - error[axis]);
            let row = Vector6::new(1.0, t, t * t, t.powi(3), rate, shown);
            self.block.moments[axis] += row * row.transpose();
        }
        self.open = self.block.said().unwrap_or_default();
        if self.block.seen_s >= BLOCK_S {
            self.close();
        }
    }

    /// Ends a block.
    fn close(&mut self) {
        let keep = (-self.block.seen_s / MEMORY_S).exp();
        self.closed.information = self.closed.information * keep + self.open.information;
        self.closed.vector = self.closed.vector * keep + self.open.vector;
        self.open = Said::default();
        self.block = Block::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_who_drive_in_bends_are_no_delay() {
        let mut estimate = DelayEstimate::default();
        for k in 0..600 {
            let t = 0.1 * f64::from(k);
            let rates = Vector6::new(0.04 * (2.8 * t).cos(), 0.04 * (3.7 * t).sin(), 0.0, 0.0, 0.0, 0.0);
            let mut error = rates * (estimate.delay_s() - 0.03);
            // The tracks lag behind by metres, as their users' bends take 20 s.
            error[0] += 0.01 * (0.31 * t).sin();
            error[1] += 0.01 * (0.27 * t).cos();
            estimate.learn(&error, estimate.delay_s(), &rates, 0.1);
        }
        assert!((estimate.delay_s() - 0.03).abs() < 2e-3, "{}", estimate.delay_s());
        assert!(estimate.std_s() < 2e-3, "{}", estimate.std_s());
    }

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
            estimate.learn(&error, estimate.delay_s(), &rates, 0.1);
        }
        assert!((estimate.delay_s() - 0.03).abs() < 1e-3, "{estimate:?}");
        assert!(estimate.std_s() < 2e-3, "{}", estimate.std_s());
    }
}
