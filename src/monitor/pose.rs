use nalgebra::Vector2;

/// A claim and how far from it an honest user's beam may be found now, m.
#[derive(Clone, Copy, Debug)]
pub(super) struct Witness {
    pub claimed: Vector2<f64>,
    pub variance: f64,
    pub reach_m: f64,
}

/// The offset that all beams share against all claims: our own pose error, once enough users agree on it.
///
/// A shift is believed only where two thirds of the users in view, and three at least, have a beam at it, each within its
/// own reach. A liar is one witness whatever they claim: with fewer than a third of the users lying, no false shift finds
/// its quorum, and the component-wise median over the witnesses that agree (breakdown point one half: Huber, 1981, §1.4)
/// moves by a fraction of one claim's error.
#[derive(Clone, Debug)]
pub(super) struct Pose {
    shift: Vector2<f64>,
    /// Variance per axis of the shift.
    variance: f64,
    agreeing: usize,
    witnesses: usize,
    averaged_s: f64,
}

const QUORUM: f64 = 2.0 / 3.0;
const FEWEST: usize = 3;
/// Shifts are searched for up to this, m.
const SEARCH_M: f64 = 60.0;
/// Witnesses that take part in a search, which costs their fourth power.
const MOST_SEARCHED: usize = 16;
/// Claims' errors are averaged over this time, s.
const SMOOTHING_S: f64 = 20.0;
/// Share of the variance of claims that is common to neighbours in time, and so outlives the averaging.
const COMMON_SHARE: f64 = super::residuals::COMMON_SHARE;

impl Default for Pose {
    fn default() -> Self {
        Self {
            shift: Vector2::zeros(),
            variance: 0.0,
            agreeing: 0,
            witnesses: 0,
            averaged_s: 0.0,
        }
    }
}

impl Pose {
    pub fn shift(&self) -> Vector2<f64> {
        self.shift
    }

    /// Variance per axis of the shift, m².
    pub fn variance(&self) -> f64 {
        self.variance
    }

    /// Users that agree on the shift, of how many.
    pub fn support(&self) -> (usize, usize) {
        (self.agreeing, self.witnesses)
    }

    /// Takes one frame's beams, m, after `dt` seconds; each user claims every `period_s`.
    pub fn update(&mut self, beams: &[Vector2<f64>], witnesses: &[Witness], dt: f64, period_s: f64) {
        self.witnesses = witnesses.len();
        let quorum = ((witnesses.len() as f64 * QUORUM).ceil() as usize).max(FEWEST);
        if witnesses.len() < quorum || beams.len() < quorum {
            self.agreeing = 0;
            return;
        }
        let mut offsets = agreeing(beams, witnesses, self.shift);
        let mut is_new = false;
        if offsets.len() < quorum {
            // What we believe is no longer so: perhaps another shift is.
            match search(beams, witnesses) {
                Some(found) if agreeing(beams, witnesses, found).len() >= quorum => {
                    offsets = agreeing(beams, witnesses, found);
                    is_new = true;
                }
                _ => {
                    self.agreeing = offsets.len();
                    return;
                }
            }
        }
        self.agreeing = offsets.len();
        let n = offsets.len() as f64;
        let target = median(&offsets);
        self.averaged_s = if is_new { dt } else { self.averaged_s + dt };
        // The plain mean at first, then an exponential one.
        let gain = (dt / self.averaged_s.min(SMOOTHING_S)).clamp(0.0, 1.0);
        if dt > 0.0 || is_new {
            self.shift += (target - self.shift) * if is_new { 1.0 } else { gain };
        }
        // The median's variance is π/2 times the mean's; an exponential mean over τ averages 2τ worth of claims.
        let mean_variance = witnesses.iter().map(|w| w.variance).sum::<f64>() / witnesses.len() as f64;
        let claims = (2.0 * self.averaged_s.min(SMOOTHING_S) / period_s.max(0.01)).max(1.0);
        let kept = COMMON_SHARE + (1.0 - COMMON_SHARE) / claims;
        self.variance = std::f64::consts::FRAC_PI_2 * mean_variance / n * kept;
    }
}

/// Offsets of the witnesses that find a beam of their own at `shift`.
fn agreeing(beams: &[Vector2<f64>], witnesses: &[Witness], shift: Vector2<f64>) -> Vec<Vector2<f64>> {
    let mut free: Vec<bool> = vec![true; beams.len()];
    let mut offsets = Vec::with_capacity(witnesses.len());
    for w in witnesses {
        let nearest = (0..beams.len())
            .filter(|&i| free[i])
            .map(|i| (i, (beams[i] - w.claimed - shift).norm()))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((i, distance)) = nearest
            && distance <= w.reach_m
        {
            free[i] = false;
            offsets.push(beams[i] - w.claimed);
        }
    }
    offsets
}

/// The shift between some beam and some claim that most witnesses agree on; the smallest of equals.
fn search(beams: &[Vector2<f64>], witnesses: &[Witness]) -> Option<Vector2<f64>> {
    let witnesses = &witnesses[..witnesses.len().min(MOST_SEARCHED)];
    let candidates = witnesses
        .iter()
        .flat_map(|w| beams.iter().map(move |b| b - w.claimed))
        .filter(|s| s.norm() <= SEARCH_M);
    let mut best: Option<(usize, Vector2<f64>)> = None;
    for s in candidates {
        let count = agreeing(beams, witnesses, s).len();
        let is_better = best.is_none_or(|(n, b)| count > n || (count == n && s.norm() < b.norm()));
        if is_better {
            best = Some((count, s));
        }
    }
    // The candidate carries one claim's error; the median of those that agree with it does not.
    best.map(|(_, s)| median(&agreeing(beams, witnesses, s)))
}

fn median(offsets: &[Vector2<f64>]) -> Vector2<f64> {
    let middle = |axis: usize| {
        let mut values: Vec<f64> = offsets.iter().map(|o| o[axis]).collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        match n {
            0 => 0.0,
            _ if n % 2 == 1 => values[n / 2],
            _ => 0.5 * (values[n / 2 - 1] + values[n / 2]),
        }
    };
    Vector2::new(middle(0), middle(1))
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
        let mut pose = Pose::default();
        pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
        assert!((pose.shift() - shift).norm() < 1e-9);
        assert_eq!(pose.support(), (6, 6));
    }

    #[test]
    fn liars_fewer_than_a_third_move_nothing() {
        let beams = grid(7);
        for lie in [1.5, 5.0, 20.0, 50.0] {
            let mut claims = beams.clone();
            for claim in claims.iter_mut().take(2) {
                *claim += Vector2::new(lie, 0.0);
            }
            let mut pose = Pose::default();
            for _ in 0..200 {
                pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
            }
            assert!(pose.shift().norm() < 1e-9, "{lie}: {:?}", pose.shift());
        }
    }

    #[test]
    fn a_beam_more_or_less_changes_nothing() {
        let mut beams = grid(6);
        let claims = beams.clone();
        beams.push(Vector2::new(60.0, 60.0));
        beams.remove(1);
        let mut pose = Pose::default();
        pose.update(&beams, &witnesses(&claims), 0.1, 1.0);
        assert_eq!(pose.shift(), Vector2::zeros());
        assert_eq!(pose.support(), (5, 6));
    }
}
