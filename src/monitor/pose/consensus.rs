//! Our own pose error, from what all beams share against all claims.

use nalgebra::Vector2;

use super::displacement::Displacement;
use super::search::{Pair, agreeing, by_chance, search, search_turned, turn_of};
use super::witness::Witness;
use crate::monitor::stats::claim_consistency::share_after_averaging;
use crate::monitor::stats::robust::{median_vector, variance_of_median};

/// Share of the users in view that must agree: with fewer than a third of them lying no false displacement finds its quorum.
const QUORUM: f64 = 2.0 / 3.0;
/// Users that must agree on a shift, and on a shift with a turn, at least. A shift needs one user and a turn two: two and three
/// more must agree. More ask for larger crowds before anything is corrected.
const MIN_AGREEING: usize = 3;
const MIN_AGREEING_TURNED: usize = 5;
/// Displacements that chance may make, of all those possible, for another one to take the place of one that has held at once: claims that are
/// as far off as users stand apart, with some of the beams dark, agree on one in every few frames. Not tuned.
const BY_CHANCE: f64 = 1e-3;
/// Time for which such a one must be found without the one before having a quorum in between, s. Longer leaves users displaced, shorter takes
/// beams that are dark together for a displacement. Not tuned.
const TAKES_PLACE_AFTER_S: f64 = 1.0;
/// Time over which claims' errors are averaged, s. Longer is more exact, shorter follows a pose that wanders. Not measured; the
/// soaks' pose wanders by 0.5 m within seconds to minutes.
const SMOOTHING_S: f64 = 20.0;
/// Standard deviations from which a turn is applied, and down to which it stays so. Lower turns positions by noise, higher leaves
/// more of a turn uncorrected; the gap keeps it from going to and fro. Not measured.
const APPLY_TURN: f64 = 5.0;
const KEEP_TURN: f64 = 3.0;

/// The displacement that all beams share against all claims, once enough users agree on it.
///
/// One is accepted only where two thirds of the users in view, and three at least (five for one with a turn), have a beam
/// at it, each within its own reach. A liar is one witness whatever they claim: with fewer than a third of the users lying,
/// no false displacement finds its quorum. The shift is the component-wise median over the witnesses that agree (breakdown point
/// one half: Huber, 1981, §1.4) and the turn their repeated median (one half too: Siegel, 1982); both move by a fraction of
/// one claim's error. A turn is applied only where it is significant.
#[derive(Clone, Debug, Default)]
pub struct PoseConsensus {
    /// The best shift alone, and the best displacement with a turn.
    shift: Vector2<f64>,
    turned: Displacement,
    is_turned: bool,
    /// Variance per axis of the shift; of the turn, and of the scale, rad².
    variance: f64,
    turn_variance: f64,
    agreeing: usize,
    witnesses: usize,
    averaged_s: f64,
    /// How long another displacement has been found in its place, s.
    contested_s: f64,
}

impl PoseConsensus {
    pub fn displacement(&self) -> Displacement {
        match self.is_turned {
            true => self.turned,
            false => Displacement::of_shift(self.shift),
        }
    }

    /// Variance per axis of the displacement at `p`, m².
    pub fn variance(&self, p: Vector2<f64>) -> f64 {
        let turned = if self.is_turned { self.turn_variance } else { 0.0 };
        self.variance + turned * p.norm_squared()
    }

    /// Users that agree on the displacement, and all users that are asked.
    pub fn support(&self) -> (usize, usize) {
        (self.agreeing, self.witnesses)
    }

    /// Takes one frame's beams, m, `dt` seconds after the one before; each user claims every `period_s`.
    pub fn update(&mut self, beams: &[Vector2<f64>], witnesses: &[Witness], dt: f64, period_s: f64) {
        self.witnesses = witnesses.len();
        let quorum = ((witnesses.len() as f64 * QUORUM).ceil() as usize).max(MIN_AGREEING);
        if witnesses.len() < quorum || beams.len() < quorum {
            self.agreeing = 0;
            return;
        }
        let mut pairs = agreeing(beams, witnesses, &self.displacement());
        let is_new = pairs.len() < quorum;
        if is_new {
            // The displacement so far no longer holds; another may.
            let turned =
                || search_turned(beams, witnesses).filter(|found| found.1.len() >= quorum.max(MIN_AGREEING_TURNED));
            let found = search(beams, witnesses)
                .filter(|found| found.1.len() >= quorum)
                .map(|found| (found, false))
                .or_else(|| turned().map(|found| (found, true)));
            let Some(((_, found), is_turned)) = found else {
                self.agreeing = pairs.len();
                return;
            };
            self.contested_s += dt;
            let is_likely = by_chance(beams, witnesses, found.len(), 1 + usize::from(is_turned)) < BY_CHANCE
                || self.contested_s > TAKES_PLACE_AFTER_S
                || self.averaged_s == 0.0;
            if !is_likely {
                self.agreeing = pairs.len();
                return;
            }
            (pairs, self.is_turned) = (found, is_turned);
        }
        self.contested_s = 0.0;
        self.agreeing = pairs.len();
        self.average(&pairs, dt, is_new);
        let mean_variance = witnesses.iter().map(|w| w.variance).sum::<f64>() / witnesses.len() as f64;
        self.variance = variance_of_median(mean_variance, pairs.len())
            * share_after_averaging(self.averaged_s.min(SMOOTHING_S), period_s);
        self.decide_turn(&pairs);
    }

    fn average(&mut self, pairs: &[Pair], dt: f64, is_new: bool) {
        self.averaged_s = if is_new { dt } else { self.averaged_s + dt };
        // The plain mean at first, then an exponential one.
        let gain = match is_new {
            true => 1.0,
            false if dt > 0.0 => (dt / self.averaged_s.min(SMOOTHING_S)).clamp(0.0, 1.0),
            false => return,
        };
        self.shift += (median_vector(pairs.iter().map(|p| p.offset)) - self.shift) * gain;
        if pairs.len() >= MIN_AGREEING_TURNED {
            let found = turn_of(pairs);
            let mean = &mut self.turned;
            mean.shift += (found.shift - mean.shift) * gain;
            mean.scale += (found.scale - mean.scale) * gain;
            mean.turn += (found.turn - mean.turn) * gain;
        }
    }

    /// Applies the turn where it is significant.
    fn decide_turn(&mut self, pairs: &[Pair]) {
        if pairs.len() < MIN_AGREEING_TURNED {
            self.is_turned = false;
            return;
        }
        let n = pairs.len() as f64;
        let centre = pairs.iter().map(|p| p.claimed).sum::<Vector2<f64>>() / n;
        let spread = pairs.iter().map(|p| (p.claimed - centre).norm_squared()).sum::<f64>();
        // That of least squares, times π/2 for a median.
        self.turn_variance = self.variance * n / spread.max(1.0) * std::f64::consts::FRAC_PI_2;
        let away = self.turned.scale.hypot(self.turned.turn) / self.turn_variance.sqrt();
        self.is_turned = away > if self.is_turned { KEEP_TURN } else { APPLY_TURN };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(n: usize) -> Vec<Vector2<f64>> {
        (0..n)
            .map(|k| {
                Vector2::new(
                    37.0 * (k % 3) as f64 + 3.0 * k as f64,
                    41.0 * (k / 3) as f64 - 5.0 * k as f64,
                )
            })
            .collect()
    }

    fn witnesses(claims: &[Vector2<f64>]) -> Vec<Witness> {
        claims
            .iter()
            .map(|&claimed| Witness {
                claimed,
                variance: 0.09,
                reach_m: 2.0,
            })
            .collect()
    }

    #[test]
    fn a_shift_of_all_is_found_at_once() {
        let beams = grid(6);
        let shift = Vector2::new(9.0, -4.0);
        let claims: Vec<_> = beams.iter().map(|b| b - shift).collect();
        let mut pose = PoseConsensus::default();
        pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
        assert!((pose.displacement().shift - shift).norm() < 1e-9);
        assert_eq!(pose.support(), (6, 6));
    }

    #[test]
    fn a_turn_of_all_is_found_at_once_and_slowly() {
        let beams = grid(7);
        for (scale, turn) in [(0.05, -0.06), (0.01, 0.015), (0.0, 0.0)] {
            let pose_error = Displacement {
                shift: Vector2::new(2.0, -1.0),
                scale,
                turn,
            };
            let seen: Vec<_> = beams.iter().map(|b| b + pose_error.at(*b)).collect();
            let mut pose = PoseConsensus::default();
            for _ in 0..300 {
                pose.update(&seen, &witnesses(&beams), 0.1, 1.0);
            }
            assert_eq!(pose.is_turned, turn != 0.0);
            for b in &beams {
                assert!((pose.displacement().at(*b) - pose_error.at(*b)).norm() < 0.02);
            }
        }
    }

    #[test]
    fn liars_fewer_than_a_third_move_nothing() {
        let beams = grid(7);
        for lie in [1.5, 5.0, 20.0, 50.0] {
            let mut claims = beams.clone();
            for claim in claims.iter_mut().take(2) {
                *claim += Vector2::new(lie, 0.0);
            }
            let mut pose = PoseConsensus::default();
            for _ in 0..200 {
                pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
            }
            assert!(pose.displacement().shift.norm() < 1e-9, "{lie}: {pose:?}");
            assert!(!pose.is_turned);
        }
    }

    #[test]
    fn what_chance_agrees_on_displaces_nothing_until_it_lasts() {
        let claims = grid(6);
        // Three beams are dark; of the others, those of the second row lie about where the first row claims to be.
        let shift = claims[3] - claims[0];
        let beams: Vec<_> = claims[3..].to_vec();
        let vague = |reach_m: f64| {
            let of = witnesses(&claims[..5]).into_iter();
            of.map(|w| Witness { reach_m, ..w }).collect::<Vec<_>>()
        };
        let mut pose = PoseConsensus::default();
        pose.update(&claims, &vague(12.0), 0.1, 1.0);
        let frames_until = |pose: &mut PoseConsensus, reach_m: f64| {
            (1..100).find(|_| {
                pose.update(&beams, &vague(reach_m)[..3], 0.1, 1.0);
                (pose.displacement().shift - shift).norm() < 1.0
            })
        };
        let mut sure = pose.clone();
        assert_eq!(frames_until(&mut sure, 0.5), Some(1));
        assert_eq!(frames_until(&mut pose.clone(), 12.0), Some(11));
        for _ in 0..100 {
            assert_eq!(frames_until(&mut pose.clone(), 12.0), Some(11));
            pose.update(&beams, &vague(12.0)[..3], 0.1, 1.0);
            pose.update(&claims, &vague(12.0), 0.1, 1.0);
            assert!(pose.displacement().shift.norm() < 1e-9);
        }
    }

    #[test]
    fn a_beam_more_or_less_changes_nothing() {
        let mut beams = grid(6);
        let claims = beams.clone();
        beams.push(Vector2::new(60.0, 60.0));
        beams.remove(1);
        let mut pose = PoseConsensus::default();
        pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
        assert_eq!(pose.displacement().shift, Vector2::zeros());
        assert_eq!(pose.support(), (5, 6));
    }
}
