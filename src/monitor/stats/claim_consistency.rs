use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use crate::monitor::track::kalman::largest_eigenvalue;

/// Window lengths of the sequential test, in claims.
pub const WINDOWS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Share of a claim's variance that is common to its neighbours in time (satellite errors wander over minutes) and so
/// does not average out.
pub const COMMON_SHARE: f64 = 0.25;

/// One claim held against where its beam was at the claim's own time.
#[derive(Clone, Copy, Debug)]
struct Residual {
    offset: Vector2<f64>,
    /// Covariance of the beam's position.
    beam: Matrix2<f64>,
    /// Variance per axis of the claim.
    claim: f64,
}

/// The residuals of one user, newest last; each claim counts once.
#[derive(Clone, Debug, Default)]
pub struct ClaimConsistency {
    kept: VecDeque<Residual>,
    newest: Option<Timestamp>,
}

/// How far a weighted mean of residuals lies outside what is tolerated.
#[derive(Clone, Copy, Debug, Default)]
pub struct Excess {
    /// Half the squared distance from the tolerated disc, in standard deviations: −ln of the bound on its probability.
    pub neg_log_p: f64,
    pub distance_m: f64,
    pub window: usize,
}

/// Surprise of an offset whose mean must lie within `radius_m` of zero: if it does, the chance of a surprise above s is at
/// most e⁻ˢ. Two bounds, of which the sharper holds. The distance from a convex set is no more than the distance from the
/// point of it that is true, whose square is χ² of two degrees: s = t²/2, t in standard deviations beyond the disc. And
/// where the disc is wide against the error, its edge is nearly straight: the worst honest offset lies on the edge, and
/// averaging the one-sided tail Q over the transverse error (Laplace's method) gives Q(t)/√(1 − t·σ/radius).
pub fn neg_log_p(offset: Vector2<f64>, cov: &Matrix2<f64>, radius_m: f64) -> f64 {
    let sigma = largest_eigenvalue(cov).max(1e-12).sqrt();
    let t = (offset.norm() - radius_m).max(0.0) / sigma;
    let whole = 0.5 * t * t;
    // Far out Q underflows; there the general bound is plenty.
    if !(1.0..=30.0).contains(&t) {
        return whole;
    }
    let curvature = 1.0 - t * sigma / radius_m;
    if curvature < 0.5 {
        return whole;
    }
    let tail = 0.5 * libm::erfc(t * std::f64::consts::FRAC_1_SQRT_2);
    whole.max(-tail.ln() + 0.5 * curvature.ln())
}

impl ClaimConsistency {
    /// Time of the newest claim that counted.
    pub fn newest(&self) -> Option<Timestamp> {
        self.newest
    }

    pub fn push(&mut self, time: Timestamp, offset: Vector2<f64>, beam: Matrix2<f64>, claim: f64) {
        self.newest = Some(time);
        self.kept.push_back(Residual { offset, beam, claim });
        if self.kept.len() > WINDOWS[WINDOWS.len() - 1] {
            self.kept.pop_front();
        }
    }

    /// Marks a claim as seen without a residual (its beam was not where the track reaches).
    pub fn skip(&mut self, time: Timestamp) {
        self.newest = Some(time);
    }

    pub fn forget(&mut self) {
        self.kept.clear();
    }

    /// The most surprising of the windows that end now.
    pub fn excess(&self, radius_m: f64, floor: &Matrix2<f64>) -> Excess {
        let mut worst = Excess::default();
        for m in WINDOWS.into_iter().take_while(|&m| m <= self.kept.len()) {
            // Newer residuals weigh more, m : m − 1 : … : 1, since who drifts away is farther now.
            let all = (m * (m + 1) / 2) as f64;
            let weighted = || (0..m).rev().map(|k| (k + 1) as f64 / all).zip(self.kept.iter().rev());
            let of = |f: &dyn Fn(&Residual) -> f64| weighted().map(|(w, r)| w * f(r)).sum::<f64>();
            let mean = Vector2::new(of(&|r| r.offset.x), of(&|r| r.offset.y));
            let beam = Matrix2::from_fn(|i, j| of(&|r| r.beam[(i, j)]));
            let own: f64 = weighted().map(|(w, r)| w * w * r.claim).sum();
            let claim = COMMON_SHARE * of(&|r| r.claim) + (1.0 - COMMON_SHARE) * own;
            let cov = beam + Matrix2::identity() * claim + floor;
            let s = neg_log_p(mean, &cov, radius_m);
            if s > worst.neg_log_p || m == 1 {
                worst = Excess {
                    neg_log_p: s,
                    distance_m: mean.norm(),
                    window: m,
                };
            }
        }
        worst
    }

    /// Whether the newest `n` claims all agree with the beam to within `radius_m` and a standard deviation.
    pub fn agree(&self, n: usize, radius_m: f64) -> bool {
        self.kept.len() >= n
            && self
                .kept
                .iter()
                .rev()
                .take(n)
                .all(|r| r.offset.norm() <= radius_m + (r.claim + largest_eigenvalue(&r.beam)).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// P(|r| > radius + t·σ) for r ~ N((radius, 0), σ²) by the midpoint rule over the transverse error.
    fn exact(t: f64, sigma: f64, radius: f64) -> f64 {
        let reach = radius + t * sigma;
        let upper = |x: f64| 0.5 * libm::erfc(x * std::f64::consts::FRAC_1_SQRT_2);
        let (n, span) = (20_000, 10.0);
        (0..n)
            .map(|k| {
                let y = -span + (f64::from(k) + 0.5) * 2.0 * span / f64::from(n);
                let density = (-0.5 * y * y).exp() / std::f64::consts::TAU.sqrt();
                let inside = (reach * reach - (sigma * y).powi(2)).max(0.0).sqrt();
                density * (upper((inside - radius) / sigma) + upper((inside + radius) / sigma)) * 2.0 * span
                    / f64::from(n)
            })
            .sum()
    }

    #[test]
    fn a_surprise_bounds_its_own_probability() {
        for sigma in [0.05, 0.2, 0.4, 1.0, 5.0] {
            for t in [1.5, 3.0, 5.0, 7.0] {
                let s = neg_log_p(
                    Vector2::new(5.0 + t * sigma, 0.0),
                    &(Matrix2::identity() * sigma * sigma),
                    5.0,
                );
                let p = exact(t, sigma, 5.0);
                // Laplace's method drops terms of relative order (t·σ/radius)²: a few per cent here.
                assert!(p <= 1.1 * (-s).exp(), "σ {sigma}, t {t}: {p} above e^-{s}");
                assert!(s >= 0.5 * t * t);
            }
        }
    }

    #[test]
    fn many_small_offsets_weigh_what_one_cannot() {
        let stamp = Timestamp::UNIX_EPOCH;
        let mut r = ClaimConsistency::default();
        let none = Matrix2::zeros();
        r.push(stamp, Vector2::new(6.0, 0.0), none, 0.25);
        let one = r.excess(5.0, &none).neg_log_p;
        for _ in 0..15 {
            r.push(stamp, Vector2::new(6.0, 0.0), none, 0.25);
        }
        let many = r.excess(5.0, &none);
        assert!(many.neg_log_p > 2.0 * one && many.window == 16, "{one} {many:?}");
        // But not without limit: a common error does not average out.
        assert!(many.neg_log_p < 16.0 * one / 3.0);
    }
}
