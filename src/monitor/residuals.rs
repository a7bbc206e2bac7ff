use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::motion::largest_eigenvalue;

/// Window lengths of the sequential test, in claims.
pub(super) const WINDOWS: [usize; 6] = [1, 2, 4, 8, 16, 32];
/// Share of a claim's variance that is common to its neighbours in time (satellite errors wander over minutes) and so
/// does not average out.
const COMMON_SHARE: f64 = 0.25;

/// One claim held against where its beam was at the claim's own time.
#[derive(Clone, Copy, Debug)]
struct Residual {
    time: Timestamp,
    offset: Vector2<f64>,
    /// Covariance of the beam's position.
    beam: Matrix2<f64>,
    /// Variance per axis of the claim.
    claim: f64,
}

/// The residuals of one user, newest last; each claim counts once.
#[derive(Clone, Debug, Default)]
pub(super) struct Residuals {
    kept: VecDeque<Residual>,
    newest: Option<Timestamp>,
}

/// How far a mean residual lies outside what is tolerated.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Excess {
    /// Half the squared distance from the tolerated disc, in standard deviations: −ln of the bound on its probability.
    pub surprise: f64,
    pub distance_m: f64,
    pub window: usize,
}

/// Surprise of an offset whose mean must lie within `radius_m` of zero. If it does, the chance of a surprise above s is at
/// most e⁻ˢ: the distance from a convex set is no more than the distance from the point of it that is true, whose square
/// is χ² of two degrees.
pub(super) fn surprise(offset: Vector2<f64>, cov: &Matrix2<f64>, radius_m: f64) -> f64 {
    let outside = (offset.norm() - radius_m).max(0.0);
    0.5 * outside * outside / largest_eigenvalue(cov).max(1e-12)
}

impl Residuals {
    /// Time of the newest claim that counted.
    pub fn newest(&self) -> Option<Timestamp> {
        self.newest
    }

    pub fn push(&mut self, time: Timestamp, offset: Vector2<f64>, beam: Matrix2<f64>, claim: f64) {
        self.newest = Some(time);
        self.kept.push_back(Residual {
            time,
            offset,
            beam,
            claim,
        });
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
            let of = |f: &dyn Fn(&Residual) -> f64| self.kept.iter().rev().take(m).map(f).sum::<f64>() / m as f64;
            let mean = Vector2::new(of(&|r| r.offset.x), of(&|r| r.offset.y));
            let beam = Matrix2::from_fn(|i, j| of(&|r| r.beam[(i, j)]));
            let claim = of(&|r| r.claim) * (COMMON_SHARE + (1.0 - COMMON_SHARE) / m as f64);
            let cov = beam + Matrix2::identity() * claim + floor;
            let s = surprise(mean, &cov, radius_m);
            if s > worst.surprise || m == 1 {
                worst = Excess {
                    surprise: s,
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

    /// Time of the oldest kept claim.
    pub fn since(&self) -> Option<Timestamp> {
        self.kept.front().map(|r| r.time)
    }
}
