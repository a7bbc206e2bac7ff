//! The linear assignment problem with dummies.

use pathfinding::prelude::{Matrix, kuhn_munkres_min};

/// Costs are quantised to this many steps of `c_max`: `pathfinding` wants integers (it never ends on NaN or ∞).
const STEPS: f64 = (1u64 << 40) as f64;

/// An optimal assignment of rows to columns, where leaving an item alone costs `c_max`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Matching {
    /// (row, column), by rising row.
    pub pairs: Vec<(usize, usize)>,
    pub unmatched_rows: Vec<usize>,
    pub unmatched_columns: Vec<usize>,
}

/// Solves the linear assignment problem of `rows × columns` costs with dummies of penalty `c_max` (Kuhn, 1955;
/// Munkres, 1957). A pair is kept only where its cost is below `c_max`; NaN and ∞ count as above it.
/// O(n³) with n = rows + columns. `c_max` must be positive and finite.
pub fn assign(rows: usize, columns: usize, c_max: f64, cost: impl Fn(usize, usize) -> f64) -> Matching {
    assert!(
        c_max > 0.0 && c_max.is_finite(),
        "c_max {c_max}: expected a positive finite penalty"
    );
    let (short, long) = (rows.min(columns), rows.max(columns));
    let transposed = rows > columns;
    let step = |i: usize, j: usize| {
        let c = if transposed { cost(j, i) } else { cost(i, j) };
        // A pair at c_max or beyond is no better than two dummies.
        let clamped = if c < c_max { c.max(0.0) } else { c_max };
        (clamped / c_max * STEPS) as i64
    };
    let steps: Vec<i64> = (0..short)
        .flat_map(|i| (0..long).map(move |j| (i, j)))
        .map(|(i, j)| step(i, j))
        .collect();
    let cost = |i: usize, j: usize| steps[i * long + j];
    let is_pair = |i: usize, j: usize| j < long && cost(i, j) < STEPS as i64;
    let matched_long = uncontested(short, long, is_pair).unwrap_or_else(|| {
        // Every short item may also take a dummy column of its own.
        let costs = Matrix::from_fn(
            short,
            long + short,
            |(i, j)| if j < long { cost(i, j) } else { STEPS as i64 },
        );
        let (_, columns_of) = kuhn_munkres_min(&costs);
        let mut matched_long = vec![None; long];
        for (i, j) in columns_of.into_iter().enumerate().filter(|(i, j)| is_pair(*i, *j)) {
            matched_long[j] = Some(i);
        }
        matched_long
    });
    let mut matching = Matching::default();
    let mut short_used = vec![false; short];
    for (j, m) in matched_long.iter().enumerate() {
        if let Some(i) = *m {
            short_used[i] = true;
            matching.pairs.push(if transposed { (j, i) } else { (i, j) });
        }
    }
    matching.pairs.sort_unstable();
    let alone_long = (0..long).filter(|&j| matched_long[j].is_none()).collect();
    let alone_short = (0..short).filter(|&i| !short_used[i]).collect();
    (matching.unmatched_rows, matching.unmatched_columns) = if transposed {
        (alone_long, alone_short)
    } else {
        (alone_short, alone_long)
    };
    matching
}

/// The row of each column, where nobody has a choice: the only matching there is.
fn uncontested(rows: usize, columns: usize, is_pair: impl Fn(usize, usize) -> bool) -> Option<Vec<Option<usize>>> {
    let mut matched = vec![None; columns];
    for i in 0..rows {
        let mut own = (0..columns).filter(|&j| is_pair(i, j));
        if let Some(j) = own.next()
            && (own.next().is_some() || matched[j].replace(i).is_some())
        {
            return None;
        }
    }
    Some(matched)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn total(costs: &[Vec<f64>], c_max: f64, m: &Matching) -> f64 {
        let matched: f64 = m.pairs.iter().map(|&(i, j)| costs[i][j]).sum();
        // Only the shorter side's dummies are charged beyond the unavoidable ones.
        let short = costs.len().min(costs.first().map_or(0, Vec::len));
        matched + (short - m.pairs.len()) as f64 * c_max
    }

    fn brute(costs: &[Vec<f64>], c_max: f64, row: usize, used: &mut Vec<bool>) -> f64 {
        if row == costs.len() {
            return 0.0;
        }
        let mut best = c_max + brute(costs, c_max, row + 1, used);
        for j in 0..used.len() {
            if !used[j] {
                used[j] = true;
                best = best.min(costs[row][j] + brute(costs, c_max, row + 1, used));
                used[j] = false;
            }
        }
        best
    }

    proptest::proptest! {
        #[test]
        fn matches_exhaustive_search(rows in 1usize..5, extra in 0usize..3, seed in proptest::collection::vec(0.0f64..3.0, 40)) {
            let columns = rows + extra;
            let costs: Vec<Vec<f64>> = (0..rows).map(|i| (0..columns).map(|j| seed[i * columns + j]).collect()).collect();
            let m = assign(rows, columns, 1.5, |i, j| costs[i][j]);
            let best = brute(&costs, 1.5, 0, &mut vec![false; columns]);
            proptest::prop_assert!((total(&costs, 1.5, &m) - best).abs() < 1e-9);
            let flipped = assign(columns, rows, 1.5, |i, j| costs[j][i]);
            proptest::prop_assert_eq!(flipped.pairs.len(), m.pairs.len());
            proptest::prop_assert_eq!(m.pairs.len() + m.unmatched_rows.len(), rows);
            proptest::prop_assert_eq!(m.pairs.len() + m.unmatched_columns.len(), columns);
        }
    }

    #[test]
    fn non_finite_costs_and_empty_sides_leave_items_alone() {
        let m = assign(2, 2, 1.0, |i, j| {
            if i == 0 {
                f64::NAN
            } else if j == 0 {
                f64::INFINITY
            } else {
                0.5
            }
        });
        assert_eq!(m.pairs, vec![(1, 1)]);
        assert_eq!(m.unmatched_rows, vec![0]);
        assert_eq!(m.unmatched_columns, vec![0]);
        assert_eq!(assign(0, 3, 1.0, |_, _| 0.0).unmatched_columns, vec![0, 1, 2]);
        assert_eq!(assign(3, 0, 1.0, |_, _| 0.0).unmatched_rows, vec![0, 1, 2]);
    }
}
