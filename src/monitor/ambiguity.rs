use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Vector2};

use crate::estimate::Flags;
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::input::claim_timing::median;
use crate::monitor::monitor::Monitor;
use crate::monitor::track::detection::snr;
use crate::monitor::track::tracker::Track;

/// Spot widths σ within which two spots overlap by a tenth.
const OVERLAP: f64 = 3.0;
/// Gain in deviance that a beam must bring over what its neighbours can take of its light: with less it is not told apart from
/// one neighbour nearer than 0.4 σ, nor from two a σ away on either side (signal-to-noise ratio 200).
const TOLD_APART: f64 = 100.0;
/// Neighbours that are asked, nearest first.
const MOST_NEIGHBOURS: usize = 4;

impl Monitor {
    /// How far apart two beams disturb each other, m.
    pub fn overlap_m(&self) -> f64 {
        OVERLAP * self.spot_m()
    }

    /// How far from its own place the beam of `track` may be taken for, m: where another user's beam overlaps it and has melted, was
    /// missed, or is fitted by a fit that doubts itself, which of them is where is a guess. Nothing where it stands alone.
    pub fn confusion_m(&self, track: &Track, association: &[Option<u64>]) -> f64 {
        let doubtful = |t: &Track| t.detection.flags.intersects(Flags::UNRESOLVED | Flags::NON_GAUSSIAN);
        let (here, overlap) = (track.motion.position(), self.overlap_m());
        let others = self.tracks.all.iter().filter(|t| t.id != track.id);
        others
            .filter_map(|t| {
                let away = (t.motion.position() - here).norm();
                let together = t.merged_into == Some(track.id) || track.merged_into == Some(t.id);
                let unsure = !t.hit || !track.hit || doubtful(t) || doubtful(track);
                let may_be = together || (away < overlap && unsure);
                (may_be && association.contains(&Some(t.id))).then_some(away)
            })
            .fold(0.0, f64::max)
    }

    /// Notes which unanswered claims put a beam where it would not be told apart from those that are seen.
    pub fn mark_unresolvable(&self, active: &mut [ActiveClaim], association: &[Option<u64>]) {
        for (a, _) in active
            .iter_mut()
            .zip(association)
            .filter(|(_, answer)| answer.is_none())
        {
            a.is_unresolvable = self.is_unresolvable(a);
        }
    }

    /// Those that are seen beside it can take its light by moving and by brightening, up to what is left over.
    fn is_unresolvable(&self, a: &ActiveClaim) -> bool {
        let spot_m = self.spot_m();
        let seen = || self.tracks.all.iter().filter(|t| t.hit).map(|t| &t.detection);
        let mut near: Vec<Vector2<f64>> = seen().map(|d| (d.position - a.position) / spot_m).collect();
        near.retain(|p| p.norm() < OVERLAP);
        near.sort_by(|p, q| p.norm().total_cmp(&q.norm()));
        near.truncate(MOST_NEIGHBOURS);
        let Some(neighbours) = Neighbours::new(&near) else {
            return false;
        };
        let past = self.users.get(&a.claim.user).and_then(|u| u.co_location.past_energy());
        let usual = past
            .map(|(ln, _)| ln.exp())
            .or_else(|| median(seen().map(|d| d.energy_j)));
        let snr = snr(&self.camera, usual.unwrap_or(0.0));
        let off = 2.0 * a.variance.sqrt() / spot_m;
        [[0.0, 0.0], [off, 0.0], [-off, 0.0], [0.0, off], [0.0, -off]]
            .into_iter()
            .any(|p| snr * snr * neighbours.leave_of(Vector2::from(p)) < TOLD_APART)
    }
}

/// Spots and their derivatives along both axes; places in σ.
#[derive(Debug)]
struct Neighbours {
    columns: Vec<(Vector2<f64>, usize)>,
    gram: Cholesky<f64, Dyn>,
}

impl Neighbours {
    /// `None` without any.
    fn new(places: &[Vector2<f64>]) -> Option<Self> {
        const RIDGE: f64 = 1e-9;
        let columns: Vec<_> = places.iter().flat_map(|p| (0..3).map(|k| (*p, k))).collect();
        let n = columns.len();
        let gram = DMatrix::from_fn(n, n, |r, c| product(columns[r], columns[c])) + DMatrix::identity(n, n) * RIDGE;
        let gram = gram.cholesky().filter(|_| n > 0)?;
        Some(Self { columns, gram })
    }

    /// Share of the squared norm of a spot at `p` that the neighbours cannot take by their energies and places.
    fn leave_of(&self, p: Vector2<f64>) -> f64 {
        let shared = DVector::from_iterator(self.columns.len(), self.columns.iter().map(|c| product((p, 0), *c)));
        1.0 - shared.dot(&self.gram.solve(&shared))
    }
}

/// Inner product of two Gaussian spots of unit norm (0) or their derivatives (1, 2): d apart they overlap by e^(−d²/4).
fn product((a, i): (Vector2<f64>, usize), (b, j): (Vector2<f64>, usize)) -> f64 {
    let d = a - b;
    let derived = match (i, j) {
        (0, 0) => 1.0,
        (0, j) => 0.5 * d[j - 1],
        (i, 0) => -0.5 * d[i - 1],
        (i, j) => (if i == j { 0.5 } else { 0.0 }) - 0.25 * d[i - 1] * d[j - 1],
    };
    derived * (-0.25 * d.norm_squared()).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_neighbours_take_of_a_spot() {
        let left = |others: &[[f64; 2]]| {
            let others: Vec<_> = others.iter().map(|o| Vector2::from(*o)).collect();
            Neighbours::new(&others).unwrap().leave_of(Vector2::zeros())
        };
        assert!(left(&[[0.0, 0.0]]).abs() < 1e-6);
        let d = 0.1;
        assert!(
            (left(&[[d, 0.0]]) / (d.powi(4) / 8.0) - 1.0).abs() < 0.05,
            "{}",
            left(&[[d, 0.0]])
        );
        assert!(left(&[[8.0, 0.0]]) > 0.999);
        // Two on either side take more than the sum of what each takes alone.
        assert!(left(&[[0.9, 0.0], [-0.9, 0.0]]) < 0.1 * left(&[[0.9, 0.0]]));
    }
}
