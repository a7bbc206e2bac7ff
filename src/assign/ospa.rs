//! The OSPA metric.

use super::{Matching, assign};

/// Optimal sub-pattern assignment score of one frame.
#[derive(Clone, Debug)]
pub struct Ospa {
    /// The metric of order 2, m; 0 when both sets are empty.
    pub distance_m: f64,
    /// Pairs (truth, estimate) nearer than the cutoff.
    pub matching: Matching,
}

/// OSPA of order 2 with cutoff `cutoff_m` (Schuhmacher, Vo and Vo, 2008, eq. 3) between true and estimated positions, m.
pub fn ospa(truth: &[[f64; 2]], estimates: &[[f64; 2]], cutoff_m: f64) -> Ospa {
    let squared = |i: usize, j: usize| {
        let (t, e) = (truth[i], estimates[j]);
        (t[0] - e[0]).powi(2) + (t[1] - e[1]).powi(2)
    };
    let c2 = cutoff_m * cutoff_m;
    let matching = assign(truth.len(), estimates.len(), c2, squared);
    let larger = truth.len().max(estimates.len());
    let matched: f64 = matching.pairs.iter().map(|&(i, j)| squared(i, j)).sum();
    let alone = (larger - matching.pairs.len()) as f64;
    let distance_m = if larger == 0 {
        0.0
    } else {
        ((matched + alone * c2) / larger as f64).sqrt()
    };
    Ospa { distance_m, matching }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missed_emitter_costs_the_cutoff() {
        let o = ospa(&[[0.0, 0.0], [10.0, 0.0]], &[[3.0, 4.0]], 25.0);
        assert!((o.distance_m - ((25.0 + 625.0f64) / 2.0).sqrt()).abs() < 1e-6);
        assert_eq!(ospa(&[], &[], 25.0).distance_m, 0.0);
    }
}
