//! Whether a spot jumps about more than its errors and a user's motion explain: second differences of its positions.

use std::collections::VecDeque;

use jiff::Timestamp;
use nalgebra::{Matrix2, Vector2};

use super::block_history::{BLOCK_FRAMES, MAX_BLOCKS, Recent};
use super::gaussian::mahalanobis2;
use super::window_excess::{WINDOWS, WindowExcess, most_significant};
use crate::time::seconds;

/// Accelerations of honest users, r.m.s., m/s²: half a g is a hard brake. Larger hides a second beam, smaller takes a brake for
/// one. At 10 frames/s it moves a second difference by 5 cm, and two beams a metre apart by four times as much; at
/// 1 frame/s users' own motion hides both.
pub const ACCELERATION: f64 = 5.0;
/// Largest half squared Mahalanobis distance that one frame counts for (winsorised): a sharp turn is one event. Not measured.
const MAX_FRAME: f64 = 8.0;
/// Jitter allowed over the beam's own past. Smaller takes a change of the air for a second beam. Not measured.
const OWN_RATIO: f64 = 1.5;
/// Jitter allowed over the other beams' median where a beam has no past. Not measured.
const OTHERS_RATIO: f64 = 4.0;
/// Smallest mean jitter that a ratio is taken to; white noise of the stated covariance has 1. Smaller lets a beam of exact
/// positions be alerted for little, larger hides one that shakes. Not measured.
const MIN_MEAN: f64 = 0.5;
/// Frames of past from which a beam's own jitter is known. More delay a beam's own comparison, fewer take it from noise: 60
/// second differences give a mean to 18 %.
const MIN_PAST: u32 = 2 * BLOCK_FRAMES;
/// Squared sums of second differences of white noise scatter as if only this share of them were independent:
/// 1/(1 + 2(ρ₁² + ρ₂²)), ρ₁ = −2/3, ρ₂ = 1/6.
const INDEPENDENT: f64 = 0.514;
/// Gaps between frames that differ by less than this share, and are shorter than `LONGEST_GAP_S`, make a second difference.
const EVEN: f64 = 0.2;
const LONGEST_GAP_S: f64 = 0.5;

/// p₂ − 2p₁ + p₀ of three positions in a row, m.
#[derive(Clone, Copy, Debug)]
pub struct SecondDifference {
    /// Time of the first of the three.
    since: Timestamp,
    pub by: Vector2<f64>,
    cov: Matrix2<f64>,
}

/// A beam's second differences: half their squared Mahalanobis distances, whose mean is 1 for white noise.
#[derive(Clone, Debug, Default)]
pub struct Jitter {
    last: VecDeque<(Timestamp, Vector2<f64>, Matrix2<f64>)>,
    /// Each with the time of the first of its three positions.
    recent: Recent<(Timestamp, f64)>,
    past_mean: f64,
    past_frames: u32,
}

impl Jitter {
    /// The second difference of the newest three positions, where they are from frames in a row.
    pub fn second_difference(
        &mut self,
        time: Timestamp,
        position: Vector2<f64>,
        cov: Matrix2<f64>,
    ) -> Option<SecondDifference> {
        self.last.push_back((time, position, cov));
        if self.last.len() > 3 {
            self.last.pop_front();
        }
        let (&(t0, p0, c0), &(t1, p1, c1), &(t2, p2, c2)) = (self.last.front()?, self.last.get(1)?, self.last.get(2)?);
        let (first, second) = (seconds(t0, t1), seconds(t1, t2));
        let even = first > 0.0 && (second / first - 1.0).abs() < EVEN && second < LONGEST_GAP_S;
        let motion = Matrix2::identity() * (ACCELERATION * first * second).powi(2);
        even.then(|| SecondDifference {
            since: t0,
            by: p2 - p1 * 2.0 + p0,
            cov: c2 + c1 * 4.0 + c0 + motion,
        })
    }

    /// The next position follows none of those before.
    pub fn interrupt(&mut self) {
        self.last.clear();
    }

    /// Forgets the newest frames, not the past.
    pub fn restart(&mut self) {
        self.interrupt();
        self.recent = Recent::default();
    }

    /// Takes a second difference, with or without what all beams have in `common`, whichever is less: that may be the noise of
    /// others. With `learn` the one that it pushes out of the newest is added to the past.
    pub fn push(&mut self, difference: SecondDifference, common: Vector2<f64>, learn: bool) {
        let SecondDifference { since, by, cov } = difference;
        let [less, whole] = [common, Vector2::zeros()].map(|common| 0.5 * mahalanobis2(by - common, cov));
        let size = less.min(whole).min(MAX_FRAME);
        if let Some((_, old)) = self.recent.push((since, size))
            && learn
        {
            self.past_frames = (self.past_frames + 1).min(BLOCK_FRAMES * MAX_BLOCKS as u32);
            self.past_mean += (old - self.past_mean) / f64::from(self.past_frames);
        }
    }

    /// How many of the newest began at `time` or later.
    pub fn frames_since(&self, time: Timestamp) -> usize {
        self.recent.count_since(time)
    }

    /// Mean over the second window, once there are enough frames.
    pub fn recent_mean(&self) -> Option<f64> {
        (self.recent.len() >= WINDOWS[1]).then(|| self.recent.mean_of_newest(WINDOWS[1]))
    }

    /// The most significant of all windows; `others` is the median jitter of the other beams.
    pub fn most_significant(&self, others: Option<f64>) -> WindowExcess {
        most_significant(|n| self.test(n, others))
    }

    /// Chernoff's bound on the mean of k independent χ² of two degrees, halved: P(mean ≥ r) ≤ exp(−k(r − 1 − ln r)).
    pub fn test(&self, n: usize, others: Option<f64>) -> Option<WindowExcess> {
        if self.recent.len() < n {
            return None;
        }
        let mean = self.recent.mean_of_newest(n);
        let own = (self.past_frames >= MIN_PAST).then(|| OWN_RATIO * self.past_mean.max(MIN_MEAN));
        let theirs = others.map(|o| OTHERS_RATIO * o.max(MIN_MEAN));
        // Jitter that all beams share is no evidence of a second one.
        let own = own.map(|own| own.max(OWN_RATIO * others.unwrap_or(0.0)));
        let expected = match (own, theirs) {
            (Some(a), Some(b)) => a.min(b),
            (one, other) => one.or(other)?,
        };
        let ratio = mean / expected;
        let neg_log_p = if ratio > 1.0 {
            INDEPENDENT * n as f64 * (ratio - 1.0 - ratio.ln())
        } else {
            0.0
        };
        Some(WindowExcess { ratio, neg_log_p })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(k: i64) -> Timestamp {
        Timestamp::from_millisecond(100 * k).unwrap()
    }

    /// A spot that is at `x(k)` in frame k, errors 0.05 m.
    fn watched(frames: i64, x: impl Fn(i64) -> f64) -> Jitter {
        let mut jitter = Jitter::default();
        for k in 0..frames {
            let place = Vector2::new(x(k), 0.0);
            if let Some(d) = jitter.second_difference(at(k), place, Matrix2::identity() * 0.0025) {
                jitter.push(d, Vector2::zeros(), true);
            }
        }
        jitter
    }

    #[test]
    fn the_second_difference_of_three_positions() {
        let mut jitter = Jitter::default();
        let cov = Matrix2::identity();
        let mut look = |k: i64, x: f64| jitter.second_difference(at(k), Vector2::new(x, 0.0), cov);
        assert!(look(0, 1.0).is_none() && look(1, 2.0).is_none());
        let found = look(2, 5.0).unwrap();
        assert_eq!(found.by, Vector2::new(2.0, 0.0));
        // Variances 1 + 4 + 1, and (5 m/s² · 0.01 s²)².
        assert!((found.cov[(0, 0)] - 6.0025).abs() < 1e-12);
        // A frame is missing: 0.1 s and then 0.2 s are not even.
        assert!(look(4, 9.0).is_none());
    }

    #[test]
    fn positions_before_an_interruption_do_not_count() {
        let mut jitter = Jitter::default();
        for k in 0..3 {
            jitter.second_difference(at(k), Vector2::zeros(), Matrix2::identity());
        }
        jitter.interrupt();
        assert!(
            jitter
                .second_difference(at(3), Vector2::zeros(), Matrix2::identity())
                .is_none()
        );
    }

    #[test]
    fn a_walk_has_no_jitter_and_a_spot_between_two_places_has() {
        let walk = watched(40, |k| 0.15 * k as f64);
        assert!(walk.recent_mean().unwrap() < 1e-9);
        assert_eq!(walk.most_significant(Some(1.0)).neg_log_p, 0.0);
        // To and fro by a metre: every frame counts for the most that one may.
        let torn = watched(40, |k| (k % 2) as f64);
        assert_eq!(torn.recent_mean(), Some(MAX_FRAME));
        // r = 8/4 against others of mean 1, in 20 frames.
        let found = torn.test(20, Some(1.0)).unwrap();
        assert_eq!(found.ratio, 2.0);
        assert!((found.neg_log_p - INDEPENDENT * 20.0 * (1.0 - 2f64.ln())).abs() < 1e-12);
    }

    #[test]
    fn what_others_have_in_common_never_adds() {
        let smallest = |common: f64| {
            let mut jitter = Jitter::default();
            for (k, x) in [0.0, 0.0, 0.5].into_iter().enumerate() {
                let place = Vector2::new(x, 0.0);
                if let Some(d) = jitter.second_difference(at(k as i64), place, Matrix2::identity() * 0.0025) {
                    jitter.push(d, Vector2::new(common, 0.0), true);
                }
            }
            jitter.recent.mean_of_newest(1)
        };
        let whole = smallest(0.0);
        assert!(whole > 1.0);
        assert!(smallest(0.5) < 1e-12);
        assert_eq!((smallest(-1.0), smallest(2.0)), (whole, whole));
    }

    #[test]
    fn without_a_past_and_without_others_nothing_is_expected() {
        assert_eq!(watched(30, |k| (k % 2) as f64).test(20, None), None);
    }

    #[test]
    fn what_all_beams_do_is_no_evidence() {
        let torn = watched(40, |k| (k % 2) as f64);
        assert_eq!(torn.test(20, Some(MAX_FRAME)).unwrap().neg_log_p, 0.0);
    }
}
