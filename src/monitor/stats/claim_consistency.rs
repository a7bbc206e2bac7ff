//! Position against claim over several claims: a window-limited sequential likelihood-ratio test.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::gaussian::{largest_eigenvalue, neg_log_p_outside};

/// Window lengths of the sequential test, in claims (Willsky and Jones, 1976; Lai, 1995): 1 is the instantaneous gate, 32 finds a
/// slow drift. More windows cost ln of their number in threshold.
pub const WINDOWS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Share of a claim's variance that is common to its neighbours in time and does not average out: satellite errors wander over
/// minutes. Larger delays a drift's alert, smaller raises false ones. Not measured on a receiver; the soaks of
/// docs/verdicts.md, whose claims have half of their variance wandering over a minute, raise nothing with it.
pub const COMMON_SHARE: f64 = 0.25;

/// Share of a claim's variance that is left in an exponential mean over `memory_s`, which averages twice that time, of one claim every
/// `period_s`.
pub fn share_after_averaging(memory_s: f64, period_s: f64) -> f64 {
    let claims = (2.0 * memory_s / period_s.max(0.01)).max(1.0);
    COMMON_SHARE + (1.0 - COMMON_SHARE) / claims
}

/// One claim against where its beam was at the claim's own time.
#[derive(Clone, Copy, Debug)]
struct Residual {
    offset: Vector2<f64>,
    /// Covariance of the beam's position.
    beam: Matrix2<f64>,
    /// Covariance of the claim.
    claim: Matrix2<f64>,
}

/// The residuals of one user, newest last; each claim counts once.
#[derive(Clone, Debug, Default)]
pub struct ClaimConsistency {
    residuals: VecDeque<Residual>,
    newest: Option<Timestamp>,
}

/// How far a weighted mean of residuals lies outside what is tolerated.
#[derive(Clone, Copy, Debug, Default)]
pub struct Excess {
    pub neg_log_p: f64,
    pub distance_m: f64,
    /// Claims in the window.
    pub window: usize,
}

impl ClaimConsistency {
    /// Time of the newest claim that counted.
    pub fn newest(&self) -> Option<Timestamp> {
        self.newest
    }

    /// Takes a claim of covariance `claim`, m², that its beam was `offset` away from, m.
    pub fn push(&mut self, time: Timestamp, offset: Vector2<f64>, beam: Matrix2<f64>, claim: Matrix2<f64>) {
        self.newest = Some(time);
        self.residuals.push_back(Residual { offset, beam, claim });
        if self.residuals.len() > WINDOWS[WINDOWS.len() - 1] {
            self.residuals.pop_front();
        }
    }

    /// Counts a claim without a residual: its beam's track does not reach to its time.
    pub fn skip(&mut self, time: Timestamp) {
        self.newest = Some(time);
    }

    pub fn forget(&mut self) {
        self.residuals.clear();
    }

    /// The most significant of the windows that end now. `systematic` is the covariance of what all residuals share.
    pub fn excess(&self, radius_m: f64, systematic: &Matrix2<f64>) -> Excess {
        let mut worst = Excess::default();
        for m in WINDOWS.into_iter().take_while(|&m| m <= self.residuals.len()) {
            // Newer residuals weigh more, m : m − 1 : … : 1: a user who drifts away is farther now.
            let all = (m * (m + 1) / 2) as f64;
            let (mut mean, mut cov) = (Vector2::zeros(), *systematic);
            for (k, r) in (1..=m).rev().zip(self.residuals.iter().rev()) {
                let weight = k as f64 / all;
                mean += r.offset * weight;
                cov += (r.beam + r.claim * (COMMON_SHARE + (1.0 - COMMON_SHARE) * weight)) * weight;
            }
            let neg_log_p = neg_log_p_outside(mean, &cov, radius_m);
            if neg_log_p > worst.neg_log_p || m == 1 {
                worst = Excess {
                    neg_log_p,
                    distance_m: mean.norm(),
                    window: m,
                };
            }
        }
        worst
    }

    /// Whether the newest `n` claims all agree with the beam to within `radius_m` and a standard deviation.
    pub fn agree(&self, n: usize, radius_m: f64) -> bool {
        self.residuals.len() >= n
            && self.residuals.iter().rev().take(n).all(|r| {
                r.offset.norm() <= radius_m + (largest_eigenvalue(&r.claim) + largest_eigenvalue(&r.beam)).sqrt()
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pushed(offsets: &[f64], claim: f64) -> ClaimConsistency {
        let mut consistency = ClaimConsistency::default();
        for x in offsets {
            consistency.push(
                Timestamp::UNIX_EPOCH,
                Vector2::new(*x, 0.0),
                Matrix2::zeros(),
                Matrix2::identity() * claim,
            );
        }
        consistency
    }

    #[test]
    fn one_claim_by_hand() {
        // Two standard deviations of 10 m outside a radius of 1 m: the edge is curved, so that t²/2 holds.
        let excess = pushed(&[21.0], 100.0).excess(1.0, &Matrix2::zeros());
        assert_eq!((excess.neg_log_p, excess.distance_m, excess.window), (2.0, 21.0, 1));
    }

    #[test]
    fn two_claims_weigh_two_to_one() {
        // Weights ⅔ and ⅓: mean ⅔·9 + ⅓·6 = 8, variance 100·(¼ + ¾·5/9).
        let excess = pushed(&[6.0, 9.0], 100.0).excess(0.5, &Matrix2::zeros());
        let variance = 100.0 * (0.25 + 0.75 * 5.0 / 9.0);
        assert_eq!(excess.window, 2);
        assert!((excess.distance_m - 8.0).abs() < 1e-12);
        assert!((excess.neg_log_p - 0.5 * 7.5 * 7.5 / variance).abs() < 1e-9);
    }

    #[test]
    fn a_sudden_offset_is_found_by_the_shortest_window() {
        let excess = pushed(&[0.0, 12.0], 1.0).excess(0.5, &Matrix2::zeros());
        assert_eq!((excess.window, excess.distance_m), (1, 12.0));
    }

    #[test]
    fn many_small_offsets_weigh_what_one_cannot() {
        let one = pushed(&[6.0], 0.25).excess(5.0, &Matrix2::zeros()).neg_log_p;
        let many = pushed(&[6.0; 16], 0.25).excess(5.0, &Matrix2::zeros());
        assert!(many.neg_log_p > 2.0 * one && many.window == 16, "{one} {many:?}");
        // But not without limit: a common error does not average out.
        assert!(many.neg_log_p < 16.0 * one / 3.0);
    }

    #[test]
    fn claims_agree_when_the_newest_are_within_reach() {
        let consistency = pushed(&[9.0, 5.4, 5.5], 0.25);
        assert!(consistency.agree(2, 5.0));
        assert!(!consistency.agree(3, 5.0));
        assert!(!consistency.agree(4, 50.0));
    }

    #[test]
    fn a_skipped_claim_counts_as_seen_and_changes_nothing() {
        let mut consistency = pushed(&[6.0], 0.25);
        let later = Timestamp::from_second(9).unwrap();
        consistency.skip(later);
        assert_eq!(consistency.newest(), Some(later));
        assert!(consistency.agree(1, 6.0) && !consistency.agree(2, 6.0));
        consistency.forget();
        assert_eq!(consistency.excess(5.0, &Matrix2::zeros()).window, 0);
    }
}
