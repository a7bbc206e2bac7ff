//! Where the residuals of a window's frames leave light for one more emitter.

use std::borrow::Cow;
use std::sync::Arc;

use nalgebra::DMatrix;

use crate::estimate::detect::matched_filter::MatchedFilter;
use crate::estimate::model::bases::Bases;
use crate::estimate::sequence::local_quadratic::{Energies, Engine, residual};
use crate::estimate::sequence::outlook::Outlook;
use crate::estimate::sequence::reprojection::reprojected;
use crate::estimate::sequence::snapshot::Snapshot;
use crate::estimate::sequence::window::Window;

/// Least share of a spot that lies outside the emitters' span for a birth there: nearer, it is the same emitter.
const LEAST_OUTSIDE: f64 = 1e-6;
/// Square of the overlap with all emitters below which a spot counts as outside their span: neglecting it underestimates a peak by as much.
/// Half of it may be of emitters that are neglected in a whole row.
const NEGLIGIBLE_OVERLAP: f64 = 1e-3;

/// Work of seeing a point of a map from elsewhere, in operations.
const REPROJECTION_WORK: f64 = 40.0;

/// A spot of unit norm: its profiles along x and y in the coefficients of a snapshot.
struct UnitSpot {
    profiles: [Vec<f64>; 2],
}

impl UnitSpot {
    fn new(bases: &Bases, snapshot: &Snapshot, u: [f64; 2]) -> Self {
        let axes = bases.axes();
        let sizes = [snapshot.compressed.mx, snapshot.compressed.my];
        let profiles = [0, 1].map(|k| {
            let (m, mut scratch) = (sizes[k], vec![0.0; 3 * axes[k].n]);
            let mut out = vec![0.0; 3 * m];
            axes[k].profile(u[k], 1.0, snapshot.compressed.reach, m, &mut scratch, &mut out);
            out.truncate(m);
            let norm = out.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
            out.iter_mut().for_each(|v| *v /= norm);
            out
        });
        Self { profiles }
    }

    fn overlap(&self, other: &Self) -> f64 {
        let along = |k: usize| -> f64 {
            let pairs = self.profiles[k].iter().zip(&other.profiles[k]);
            pairs.map(|(a, b)| a * b).sum()
        };
        along(0) * along(1)
    }
}

/// A map of the sensor `from` one outlook as it is seen `to` another; the same where the platform stands still.
fn seen<'m>(
    filter: &MatchedFilter,
    map: &'m [f64],
    from: Option<&Arc<Outlook>>,
    to: Option<&Arc<Outlook>>,
) -> Cow<'m, [f64]> {
    match (from, to) {
        (Some(from), Some(to)) if !Arc::ptr_eq(from, to) => reprojected(filter, map, from, to).into(),
        _ => map.into(),
    }
}

/// What the residuals of all frames leave for one more emitter at each point of the matched filter's grid over the newest frame, Σ (fᵀr)²/‖P⊥f‖²;
/// what it would be below zero counts as nothing.
pub(crate) fn residual_map(engine: &mut Engine, filter: &mut MatchedFilter, window: &Window) -> Vec<f64> {
    let Some(newest) = window.snapshots.last() else {
        return Vec::new();
    };
    let mut sum: Vec<f64> = Vec::new();
    for s in &window.snapshots {
        let positions = s.positions(engine.bases, window.places(&window.state, s.time_s));
        let (left, _) = residual(engine, &s.compressed, window.energies, s.nuisances, &positions);
        filter.respond(left, s.compressed.mx, s.compressed.my);
        if s.outlook.is_some() {
            engine.budget.charge(REPROJECTION_WORK * filter.map().len() as f64);
        }
        let map = seen(filter, filter.map(), s.outlook.as_ref(), newest.outlook.as_ref());
        sum.resize(map.len(), 0.0);
        for (total, v) in sum.iter_mut().zip(map.iter()) {
            *total += match window.energies {
                Energies::NonNegative => v.max(0.0).powi(2),
                Energies::Signed => v * v,
            };
        }
    }
    let positions = window.positions(engine.bases);
    let spots = positions.as_slice().chunks_exact(2);
    let spots: Vec<UnitSpot> = spots
        .map(|u| UnitSpot::new(engine.bases, newest, [u[0], u[1]]))
        .collect();
    divide_by_outside(filter, &spots, &mut sum);
    sum
}

/// The residual maps of single frames added up, as long as they are of the same emitters: light that no frame shows alone.
#[derive(Default)]
pub(crate) struct ResidualSum {
    /// As the last of them sees it.
    pub sum: Vec<f64>,
    pub frames: f64,
    outlook: Option<Arc<Outlook>>,
}

impl ResidualSum {
    /// Adds a frame's map; older ones fade, so that about `most` count. One that is empty, since its frame's work was used up, adds nothing.
    pub fn add(&mut self, filter: &MatchedFilter, map: &[f64], outlook: Option<Arc<Outlook>>, most: f64) {
        if map.is_empty() {
            return;
        }
        let kept = 1.0 - 1.0 / most;
        self.frames = kept * self.frames + 1.0;
        self.sum.resize(map.len(), 0.0);
        if let Cow::Owned(sum) = seen(filter, &self.sum, self.outlook.as_ref(), outlook.as_ref()) {
            self.sum = sum;
        }
        self.outlook = outlook;
        for (sum, v) in self.sum.iter_mut().zip(map) {
            *sum = kept * *sum + v;
        }
    }

    pub fn clear(&mut self) {
        self.sum.clear();
        (self.frames, self.outlook) = (0.0, None);
    }
}

/// Divides by the share of a spot that lies outside the emitters' span: one minus cᵀG⁻¹c with c its overlaps with them and G theirs. In each
/// row of the map only emitters near it count.
fn divide_by_outside(filter: &MatchedFilter, spots: &[UnitSpot], sum: &mut [f64]) {
    let n = spots.len();
    let along = |k: usize| -> Vec<Vec<f64>> { spots.iter().map(|s| filter.respond_along(k, &s.profiles[k])).collect() };
    let [x, y] = [along(0), along(1)];
    let mut gram = DMatrix::from_diagonal_element(n, n, 1.0 + 1e-12);
    for c in 0..n {
        for r in 0..c {
            (gram[(r, c)], gram[(c, r)]) = [spots[r].overlap(&spots[c]); 2].into();
        }
    }
    let (mut near, mut factor) = (Vec::new(), Vec::new());
    let mut overlaps = vec![0.0; n];
    let mut squares = vec![0.0; filter.width()];
    for (j, row) in sum.chunks_exact_mut(filter.width()).enumerate() {
        let is_near = |k: &usize| y[*k][j] * y[*k][j] > NEGLIGIBLE_OVERLAP / (2 * n) as f64;
        let nearest: Vec<usize> = (0..n).filter(is_near).collect();
        if nearest != near {
            near = nearest;
            let Some(next) = factor_of(&gram, &near) else {
                sum.fill(0.0);
                return;
            };
            factor = next;
        }
        squares.fill(0.0);
        for k in &near {
            let across = y[*k][j] * y[*k][j];
            let along = squares.iter_mut().zip(&x[*k]);
            along.for_each(|(square, x)| *square += across * x * x);
        }
        for (i, total) in row.iter_mut().enumerate() {
            if squares[i] < 0.5 * NEGLIGIBLE_OVERLAP {
                continue;
            }
            let mut outside = 1.0;
            for (r, k) in near.iter().enumerate() {
                let (row, scale) = &factor[r];
                let known: f64 = row.iter().zip(&overlaps).map(|(l, c)| l * c).sum();
                overlaps[r] = (x[*k][i] * y[*k][j] - known) * scale;
                outside -= overlaps[r] * overlaps[r];
            }
            *total = if outside > LEAST_OUTSIDE { *total / outside } else { 0.0 };
        }
    }
}

/// The rows of the Cholesky factor of the overlaps of these spots: what is left of the diagonal, and one over that.
fn factor_of(gram: &DMatrix<f64>, spots: &[usize]) -> Option<Vec<(Vec<f64>, f64)>> {
    let factor = gram.select_rows(spots).select_columns(spots).cholesky()?.l();
    let rows = factor.row_iter().enumerate();
    Some(
        rows.map(|(r, row)| (row.columns(0, r).iter().copied().collect(), 1.0 / row[r]))
            .collect(),
    )
}

/// Points of at least `least` that are above all their neighbours, the highest first, with their positions, σ.
pub(crate) fn peaks(filter: &MatchedFilter, sum: &[f64], least: f64) -> Vec<(f64, [f64; 2])> {
    let width = filter.width();
    let height = sum.len() / width;
    let mut found = Vec::new();
    for (k, &value) in sum.iter().enumerate().filter(|(_, v)| **v >= least) {
        let (i, j) = (k % width, k / width);
        let mut around = (j.saturating_sub(1)..(j + 2).min(height))
            .flat_map(|b| (i.saturating_sub(1)..(i + 2).min(width)).map(move |a| b * width + a))
            .filter(|o| *o != k);
        if around.all(|o| sum[o] < value) {
            found.push((value, filter.position(k)));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::test_frame::Shown;

    #[test]
    fn a_frame_that_was_not_searched_leaves_the_sum_of_residuals_as_it_is() {
        let test = Shown {
            pixels_per_sigma: 2.0,
            sources: &[([0.0, 0.0], 1.0)],
            ..Shown::default()
        }
        .frame();
        let filter = &test.space.matched_filter;
        let mut sum = ResidualSum::default();
        sum.add(filter, &[], None, 128.0);
        sum.add(filter, &[1.0, 2.0], None, 128.0);
        sum.add(filter, &[], None, 128.0);
        assert_eq!((sum.sum.as_slice(), sum.frames), ([1.0, 2.0].as_slice(), 1.0));
    }
}
