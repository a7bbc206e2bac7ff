//! Which beam is whose is a guess where spots overlap: how wide the guess is, and which claims no frame could show.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Vector2};

use super::input::claim_state::ActiveClaim;
use super::stats::robust::median_high;
use super::track::association::Association;
use super::track::beam_track::Track;
use super::track::detection::{OVERLAP, snr, spot_m};
use super::track::tracker::Tracker;
use crate::estimate::Flags;
use crate::geo::View;

/// Gain in deviance that a beam must bring over what its neighbours can take of its light. With less it is not resolved from
/// one neighbour nearer than 0.4 σ, nor from two a σ away on either side (signal-to-noise ratio 200). Larger excuses users
/// who are really absent, smaller raises `user_unseen` in crowds.
const MIN_DEVIANCE: f64 = 100.0;
/// Neighbours that are considered, nearest first; bounds the cost where many stand together.
const MAX_NEIGHBOURS: usize = 4;
/// Spot widths over which the halo of a spot falls to a half, as a frame's spot error takes it.
const HALO: f64 = 3.0;
/// Standard deviations of a claim about its place that are considered too. Larger excuses users who are really absent, smaller
/// alerts those whose claim is a little off. Not measured.
const CLAIM_REACH: f64 = 2.0;

/// How far from its own place the beam of `track` may be taken for, m: the distance of the farthest other associated beam that
/// overlaps it and has merged, was missed, or is fitted by a fit that doubts itself. Zero where it stands alone.
pub(super) fn confusion_m(track: &Track, tracker: &Tracker, association: &Association, overlap_m: f64) -> f64 {
    let is_doubtful = |t: &Track| t.detection.flags.intersects(Flags::UNRESOLVED | Flags::NON_GAUSSIAN);
    let here = track.filter.position();
    let others = tracker.tracks.iter().filter(|t| t.id != track.id);
    others
        .filter_map(|t| {
            let away = (t.filter.position() - here).norm();
            let is_together = t.merged_into == Some(track.id) || track.merged_into == Some(t.id);
            let is_unsure = !t.hit || !track.hit || is_doubtful(t) || is_doubtful(track);
            let may_be = is_together || (away < overlap_m && is_unsure);
            (may_be && association.contains(t.id)).then_some(away)
        })
        .fold(0.0, f64::max)
}

/// Marks the claims whose user's own beam is not seen whose beam, of the user's usual energy (`usual_energy_j`), would not be resolved
/// from those that are; `spot_error` is the share of a spot's light by which it may differ from its model.
pub(super) fn mark_unresolvable(
    claims: &mut [ActiveClaim],
    tracker: &Tracker,
    view: &View,
    spot_error: f64,
    usual_energy_j: impl Fn(&str) -> Option<f64>,
) {
    for claim in claims {
        let own = claim.before.current().and_then(|id| tracker.get(id));
        claim.is_unresolvable =
            !own.is_some_and(|track| track.hit) && is_unresolvable(claim, tracker, view, spot_error, &usual_energy_j);
    }
}

/// Those that are seen beside it can take its light by moving and by brightening, up to what is left over.
fn is_unresolvable(
    claim: &ActiveClaim,
    tracker: &Tracker,
    view: &View,
    spot_error: f64,
    usual_energy_j: impl Fn(&str) -> Option<f64>,
) -> bool {
    let spot_m = spot_m(view);
    let seen = || tracker.tracks.iter().filter(|t| t.hit).map(|t| &t.detection);
    let mut near: Vec<Vector2<f64>> = Vec::new();
    // What the lens may add to a pixel there, in units of the noise.
    let mut halo = 0.0;
    for d in seen() {
        let away = (d.position - claim.position) / spot_m;
        if away.norm() < OVERLAP {
            halo += spot_error * snr(&view.camera, d.energy_j) / (1.0 + away.norm_squared() / (HALO * HALO));
            near.push(away);
        }
    }
    near.sort_by(|p, q| p.norm().total_cmp(&q.norm()));
    near.truncate(MAX_NEIGHBOURS);
    let Some(neighbours) = Neighbours::new(&near) else {
        return false;
    };
    let usual = usual_energy_j(&claim.claim.user).or_else(|| median_high(seen().map(|d| d.energy_j)));
    let snr = snr(&view.camera, usual.unwrap_or(0.0)) / (1.0 + halo * halo).sqrt();
    let off = CLAIM_REACH * claim.variance.sqrt() / spot_m;
    [[0.0, 0.0], [off, 0.0], [-off, 0.0], [0.0, off], [0.0, -off]]
        .into_iter()
        .any(|p| snr * snr * neighbours.unexplained(Vector2::from(p)) < MIN_DEVIANCE)
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
        // Keeps coincident neighbours from a singular matrix.
        const RIDGE: f64 = 1e-9;
        let columns: Vec<_> = places.iter().flat_map(|p| (0..3).map(|k| (*p, k))).collect();
        let n = columns.len();
        let gram = DMatrix::from_fn(n, n, |r, c| product(columns[r], columns[c])) + DMatrix::identity(n, n) * RIDGE;
        let gram = gram.cholesky().filter(|_| n > 0)?;
        Some(Self { columns, gram })
    }

    /// Share of the squared norm of a spot at `p` that the neighbours cannot take by their energies and places.
    fn unexplained(&self, p: Vector2<f64>) -> f64 {
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
    use jiff::Timestamp;

    use super::*;
    use crate::monitor::input::claim_state::fixture::active_claim;
    use crate::monitor::track::detection::fixture::detection;
    use crate::optics;

    #[test]
    fn what_neighbours_take_of_a_spot() {
        let left = |others: &[[f64; 2]]| {
            let others: Vec<_> = others.iter().map(|o| Vector2::from(*o)).collect();
            Neighbours::new(&others).unwrap().unexplained(Vector2::zeros())
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

    #[test]
    fn derivatives_of_the_overlap_are_those_of_its_formula() {
        let (a, b) = (Vector2::new(0.3, -0.4), Vector2::new(-0.5, 0.2));
        let step = 1e-5;
        for j in 1..3 {
            let mut moved = [b, b];
            moved[0][j - 1] += step;
            moved[1][j - 1] -= step;
            for i in 0..3 {
                let slope = (product((a, i), (moved[0], 0)) - product((a, i), (moved[1], 0))) / (2.0 * step);
                assert!((slope - product((a, i), (b, j))).abs() < 1e-9, "{i} {j}");
            }
        }
    }

    fn two_beams(away: f64, flags: Flags) -> (Tracker, Association) {
        let mut tracker = Tracker::new(50.0);
        let mut beams = [detection(0.0, 0.0), detection(away, 0.0)];
        beams[1].flags = flags;
        tracker.step(Timestamp::UNIX_EPOCH, &beams, 0.1);
        let mut association = Association::none(2);
        association.assign(0, 1);
        association.assign(1, 2);
        (tracker, association)
    }

    #[test]
    fn a_beam_may_be_taken_for_a_doubtful_neighbours() {
        let confusion = |away: f64, flags: Flags| {
            let (tracker, association) = two_beams(away, flags);
            confusion_m(&tracker.tracks[0], &tracker, &association, 25.0)
        };
        assert_eq!(confusion(20.0, Flags::empty()), 0.0);
        assert_eq!(confusion(20.0, Flags::UNRESOLVED), 20.0);
        assert_eq!(confusion(30.0, Flags::UNRESOLVED), 0.0);
        // A beam without a claim is nobody's.
        let (tracker, _) = two_beams(20.0, Flags::UNRESOLVED);
        assert_eq!(
            confusion_m(&tracker.tracks[0], &tracker, &Association::none(2), 25.0),
            0.0
        );
    }

    #[test]
    fn a_claim_on_top_of_a_seen_beam_cannot_be_resolved() {
        let view = View::level(&optics::Config::default().camera().unwrap());
        let (tracker, _) = two_beams(60.0, Flags::empty());
        let mark = |x: f64, spot_error: f64| {
            let mut claims = [active_claim("a", x, 0.0)];
            // Half a millijoule: a signal-to-noise ratio of some 66.
            mark_unresolvable(&mut claims, &tracker, &view, spot_error, |_| Some(5e-4));
            claims[0].is_unresolvable
        };
        assert!(mark(0.5, 0.0));
        assert!(!mark(30.0, 0.0) && !mark(8.0, 0.0));
        // A lens that may differ from its model by a twentieth hides who is a σ beside another.
        assert!(mark(8.0, 0.05) && !mark(30.0, 0.05));
    }
}
