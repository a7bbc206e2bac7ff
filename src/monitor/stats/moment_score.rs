//! Second moments of a spot's light beyond one beam's, in information form.

use nalgebra::{Matrix2, Matrix3, Vector3};

use crate::estimate;

/// Second moments (xx, xy, yy) beyond one spot's, σ², in information form: scores and informations of frames add.
#[derive(Clone, Copy, Debug)]
pub struct MomentScore {
    score: Vector3<f64>,
    information: Matrix3<f64>,
}

impl Default for MomentScore {
    fn default() -> Self {
        Self {
            score: Vector3::zeros(),
            information: Matrix3::zeros(),
        }
    }
}

impl MomentScore {
    /// A fit's score, its covariance times `inflation`.
    pub fn of(score: &estimate::SecondMomentScore, inflation: f64) -> Self {
        let s = score.information;
        Self {
            score: Vector3::from(score.score) / inflation,
            information: Matrix3::from_fn(|r, c| 0.5 * (s[r][c] + s[c][r])) / inflation,
        }
    }

    /// Of light spread by `moments`, σ², of that signal-to-noise ratio. A Gaussian spot f of unit norm has
    /// ‖½f_xx‖² = 1/8 and ‖f_xy‖² = 1/4 with its energy adjusted; the three are orthogonal to each other and to its position.
    pub fn of_spread(moments: Matrix2<f64>, snr: f64) -> Self {
        let information = Matrix3::from_diagonal(&Vector3::new(0.125, 0.25, 0.125)) * (snr * snr);
        Self {
            score: information * Vector3::new(moments[(0, 0)], moments[(0, 1)], moments[(1, 1)]),
            information,
        }
    }

    pub fn add(&mut self, other: &Self) {
        self.score += other.score;
        self.information += other.information;
    }

    /// The moments and their covariance.
    pub fn solved(&self) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let cov = self.information.cholesky()?.inverse();
        Some((cov * self.score, cov))
    }

    /// Squared Mahalanobis distance of the moments from `expected`.
    pub fn distance2(&self, expected: Vector3<f64>) -> Option<f64> {
        let off = self.solved()?.0 - expected;
        Some(off.dot(&(self.information * off)))
    }

    /// The same frame, no farther from `expected` than `most2`, a squared Mahalanobis distance (winsorised). `None` where the frame
    /// has no finite moments.
    pub fn within(&self, expected: Vector3<f64>, most2: f64) -> Option<Self> {
        let distance2 = self.distance2(expected).filter(|d| d.is_finite())?;
        let mut frame = *self;
        if distance2 > most2 {
            let usual = self.information * expected;
            frame.score = usual + (self.score - usual) * (most2 / distance2).sqrt();
        }
        Some(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_equal_beams_a_sigma_apart_have_a_quarter_along_their_line() {
        // At ±½ along x: w(1 − w)·d² = ¼; SNR 10.
        let spread = Matrix2::new(0.25, 0.0, 0.0, 0.0);
        let score = MomentScore::of_spread(spread, 10.0);
        let (moments, cov) = score.solved().unwrap();
        assert!((moments - Vector3::new(0.25, 0.0, 0.0)).norm() < 1e-12);
        // Information 100/8: a variance of 0.08.
        assert!((cov[(0, 0)] - 0.08).abs() < 1e-12);
        assert!((score.distance2(Vector3::zeros()).unwrap() - 0.0625 / 0.08).abs() < 1e-9);
    }

    #[test]
    fn scores_of_frames_add() {
        let one = MomentScore::of_spread(Matrix2::new(0.1, 0.0, 0.0, 0.3), 4.0);
        let mut sum = one;
        sum.add(&one);
        let ((a, cov_a), (b, cov_b)) = (one.solved().unwrap(), sum.solved().unwrap());
        assert!((a - b).norm() < 1e-12 && (cov_a - cov_b * 2.0).norm() < 1e-12);
        assert!(MomentScore::default().solved().is_none());
    }

    #[test]
    fn an_inflated_fit_has_the_same_moments_and_less_information() {
        let fit = estimate::SecondMomentScore {
            score: [25.0, 0.0, 0.0],
            information: [[100.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 100.0]],
        };
        let (moments, cov) = MomentScore::of(&fit, 4.0).solved().unwrap();
        assert!((moments.x - 0.25).abs() < 1e-12 && (cov[(0, 0)] - 0.04).abs() < 1e-12);
    }

    #[test]
    fn a_frame_far_from_what_is_expected_counts_for_a_bounded_distance() {
        let frame = MomentScore::of_spread(Matrix2::new(2.0, 0.0, 0.0, 0.0), 10.0);
        let expected = Vector3::new(0.4, 0.0, 0.0);
        // 1.6²/0.08 = 32: two fifths of the standard deviations are left of a bound of 5.12.
        let bounded = frame.within(expected, 5.12).unwrap();
        assert!((bounded.solved().unwrap().0 - Vector3::new(0.4 + 0.4 * 1.6, 0.0, 0.0)).norm() < 1e-12);
        let near = frame.within(expected, 33.0).unwrap();
        assert!((near.solved().unwrap().0.x - 2.0).abs() < 1e-12);
        assert!(MomentScore::default().within(expected, 33.0).is_none());
    }
}
