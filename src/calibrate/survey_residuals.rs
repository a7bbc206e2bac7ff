//! Residuals of the surveyed positions: fitted minus predicted spot positions, and the variance that the survey itself adds.

use faer::Mat;

use crate::stats::{mahalanobis2, median};

use super::exposure::{Exposure, NormalEquations, ScaledCholesky};

/// Fitted position of a spot without the survey prior, minus the predicted one, m on the sensor.
#[derive(Clone, Copy)]
pub(super) struct Displacement {
    pub offset: [f64; 2],
    pub cov: [[f64; 2]; 2],
}

impl Displacement {
    pub fn mahalanobis2(&self, survey_var_m2: f64) -> f64 {
        let [[a, b], [_, c]] = self.cov;
        mahalanobis2([[a + survey_var_m2, b], [b, c + survey_var_m2]], self.offset)
    }
}

/// The displacement of each spot: one Newton step without the survey prior, from the fitted state.
pub(super) fn displacements(exposure: &Exposure, normal: &NormalEquations) -> Vec<Option<Displacement>> {
    let local = exposure.local_columns();
    let h = Mat::from_fn(local.len(), local.len(), |a, b| normal.gram[(local[a], local[b])]);
    let g: Vec<f64> = local.iter().map(|&c| normal.rhs[c]).collect();
    let Some(solver) = ScaledCholesky::new(&h, 0.0) else {
        return vec![None; exposure.spots.len()];
    };
    let (step, inverse) = (
        solver.solve(&g),
        solver.solve_many(&Mat::identity(local.len(), local.len())),
    );
    let spots = exposure.spots.iter().enumerate();
    spots
        .map(|(i, spot)| {
            spot.beacon?;
            let at = |a: usize, b: usize| inverse[(3 * i + a, 3 * i + b)];
            Some(Displacement {
                offset: std::array::from_fn(|k| spot.sensor_m[k] + step[3 * i + k] - spot.predicted_m[k]),
                cov: std::array::from_fn(|a| std::array::from_fn(|b| at(a, b))),
            })
        })
        .collect()
}

/// The variance T that makes the median of offset²/(cov + T) that of χ² with one degree of freedom.
pub(super) fn excess_variance(axes: &[(f64, f64)]) -> f64 {
    const MEDIAN_CHI2: f64 = 0.454_936;
    let ratio = |t: f64| median(axes.iter().map(|(o2, c)| o2 / (c + t)).collect()).unwrap_or(0.0);
    if ratio(0.0) <= MEDIAN_CHI2 {
        return 0.0;
    }
    let (mut low, mut high) = (0.0, axes.iter().map(|a| a.0).fold(0.0, f64::max).max(1e-30) * 10.0);
    // Bisection of the logarithm: the root may lie many orders of magnitude below the largest offset.
    for _ in 0..200 {
        let middle = if low == 0.0 { high * 0.1 } else { (low * high).sqrt() };
        if ratio(middle) > MEDIAN_CHI2 {
            low = middle
        } else {
            high = middle
        }
        if low > 0.0 && high / low < 1.001 {
            break;
        }
    }
    (low * high).sqrt().max(low)
}
