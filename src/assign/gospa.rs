//! The GOSPA metric.

use super::{Matching, assign};

/// Generalised optimal sub-pattern assignment score of one frame, in its parts.
#[derive(Clone, Debug)]
pub struct Gospa {
    /// The metric of order 2 with α = 2, m; 0 when both sets are empty.
    pub distance_m: f64,
    /// Sum over matched pairs of the squared distance, m².
    pub localisation_m2: f64,
    /// Truths without an estimate within the cutoff; each costs cutoff²/2.
    pub missed: usize,
    /// Estimates without a truth within the cutoff; each costs cutoff²/2.
    pub r#false: usize,
    /// Pairs (truth, estimate) nearer than the cutoff.
    pub matching: Matching,
}

/// GOSPA of order 2 with α = 2 and cutoff `cutoff_m` between true and estimated positions, m (Rahmathullah,
/// García-Fernández and Svensson, 2017, proposition 1): unlike OSPA it is not divided by the number of points, and it is
/// the sum of localisation error, missed and false.
pub fn gospa(truth: &[[f64; 2]], estimates: &[[f64; 2]], cutoff_m: f64) -> Gospa {
    let squared = |i: usize, j: usize| {
        let (t, e) = (truth[i], estimates[j]);
        (t[0] - e[0]).powi(2) + (t[1] - e[1]).powi(2)
    };
    // A pair costs its squared distance; leaving both alone costs twice cutoff²/2.
    let c2 = cutoff_m * cutoff_m;
    let matching = assign(truth.len(), estimates.len(), c2, squared);
    let localisation_m2 = matching.pairs.iter().map(|&(i, j)| squared(i, j)).sum();
    let (missed, r#false) = (matching.unmatched_rows.len(), matching.unmatched_columns.len());
    Gospa {
        distance_m: f64::sqrt(localisation_m2 + 0.5 * c2 * (missed + r#false) as f64),
        localisation_m2,
        missed,
        r#false,
        matching,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn falls_apart_into_its_three_causes() {
        let g = gospa(&[[0.0, 0.0], [10.0, 0.0]], &[[3.0, 4.0], [50.0, 0.0], [60.0, 0.0]], 8.0);
        assert_eq!((g.missed, g.r#false), (1, 2));
        assert!((g.localisation_m2 - 25.0).abs() < 1e-9);
        assert!((g.distance_m - (25.0f64 + 3.0 * 32.0).sqrt()).abs() < 1e-9);
        assert_eq!(gospa(&[], &[], 8.0).distance_m, 0.0);
    }

    #[test]
    fn a_pair_beyond_the_cutoff_is_one_missed_and_one_false() {
        let g = gospa(&[[0.0, 0.0]], &[[8.1, 0.0]], 8.0);
        assert_eq!((g.missed, g.r#false, g.localisation_m2), (1, 1, 0.0));
    }

    proptest::proptest! {
        /// It is a metric: symmetric, and the triangle inequality holds.
        #[test]
        fn is_a_metric(
            a in proptest::collection::vec(proptest::array::uniform2(-20.0f64..20.0), 0..5),
            b in proptest::collection::vec(proptest::array::uniform2(-20.0f64..20.0), 0..5),
            c in proptest::collection::vec(proptest::array::uniform2(-20.0f64..20.0), 0..5),
        ) {
            let d = |a: &[[f64; 2]], b: &[[f64; 2]]| gospa(a, b, 8.0).distance_m;
            // Costs are quantised to 2⁻⁴⁰ of the cutoff squared; the sums' roots to better than a micrometre.
            proptest::prop_assert!((d(&a, &b) - d(&b, &a)).abs() < 1e-6);
            proptest::prop_assert!(d(&a, &c) <= d(&a, &b) + d(&b, &c) + 1e-6);
            proptest::prop_assert_eq!(d(&a, &a), 0.0);
        }
    }
}
