use nalgebra::Vector2;

use crate::monitor::stats::claim_consistency::COMMON_SHARE;

/// What one user's claims tell of the log's clock: the claim of a mover stamped τ too late lies τ·v behind the beam.
/// Sums of a weighted regression of offset on velocity, older claims counting less.
#[derive(Clone, Copy, Debug, Default)]
pub struct ClockOffset {
    information: f64,
    offset: f64,
    claims: f64,
}

/// Claims that the evidence remembers, by and large.
const MEMORY: f64 = 64.0;
/// Movers that must tell of the clock, and how well each must, s.
const FEWEST: usize = 3;
const CLEAR_S: f64 = 0.25;

impl ClockOffset {
    /// Takes a claim of variance `variance` per axis that lies `offset` from where its beam, at `velocity`, was.
    pub fn push(&mut self, offset: Vector2<f64>, velocity: Vector2<f64>, variance: f64) {
        let keep = 1.0 - 1.0 / MEMORY;
        let weight = 1.0 / (variance + 0.01);
        self.information = keep * self.information + weight * velocity.norm_squared();
        self.offset = keep * self.offset + weight * offset.dot(&velocity);
        self.claims = keep * self.claims + 1.0;
    }

    /// Seconds by which the clock is ahead of ours, where this user's way tells.
    fn ahead_s(&self) -> Option<f64> {
        // The common share of the claims' errors does not average out.
        let variance = (1.0 + COMMON_SHARE * self.claims) / self.information;
        (variance < CLEAR_S * CLEAR_S).then(|| self.offset / self.information)
    }
}

/// Seconds by which the log's clock is ahead of ours: the median over those who move, within `limit_s`. Fewer than half of
/// the movers cannot shift it, and whoever does gains `limit_s` of each user's own way and no more.
pub fn ahead_s<'a>(users: impl Iterator<Item = &'a ClockOffset>, limit_s: f64) -> f64 {
    let mut told: Vec<f64> = users.filter_map(ClockOffset::ahead_s).collect();
    if told.len() < FEWEST {
        return 0.0;
    }
    told.sort_by(f64::total_cmp);
    let n = told.len();
    let ahead = 0.5 * (told[(n - 1) / 2] + told[n / 2]);
    // What cannot be told from none is none.
    if ahead.abs() < CLEAR_S {
        0.0
    } else {
        ahead.clamp(-limit_s, limit_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mover(ahead: f64, speed: f64) -> ClockOffset {
        let mut evidence = ClockOffset::default();
        for k in 0..30 {
            let (sin, cos) = f64::from(k).sin_cos();
            let v = Vector2::new(speed * cos, speed * sin);
            evidence.push(v * ahead, v, 0.09);
        }
        evidence
    }

    #[test]
    fn movers_tell_what_the_clock_is_off() {
        let users: Vec<_> = (0..4).map(|_| mover(0.8, 5.0)).collect();
        assert!((ahead_s(users.iter(), 1.0) - 0.8).abs() < 1e-9);
        assert_eq!(ahead_s(users.iter(), 0.5), 0.5);
        assert_eq!(ahead_s(users[..2].iter(), 1.0), 0.0);
    }

    #[test]
    fn neither_those_who_stand_nor_a_few_liars_move_the_clock() {
        let slow: Vec<_> = (0..9).map(|_| mover(0.8, 0.2)).collect();
        assert_eq!(ahead_s(slow.iter(), 1.0), 0.0);
        let mut users: Vec<_> = (0..5).map(|_| mover(0.0, 5.0)).collect();
        users.extend((0..4).map(|_| mover(1.0, 5.0)));
        assert_eq!(ahead_s(users.iter(), 1.0), 0.0);
    }
}
