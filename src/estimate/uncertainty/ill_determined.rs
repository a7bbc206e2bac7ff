//! Directions in the space of all positions that a frame hardly determines.

use crate::estimate::fit::context::FitContext;
use crate::estimate::fit::levenberg_marquardt::linearise;
use crate::estimate::model::hypothesis::Hypothesis;
use crate::estimate::uncertainty::covariance::Covariance;

/// A direction is ill-determined from this standard deviation on, σ: below it the deviance is a parabola and has one minimum.
const MIN_DEVIATION: f64 = 0.02;
/// Rounds of the power iteration: the direction need not be exact, only ill-determined.
const ITERATIONS: usize = 20;
/// Precision added to each position, 1/σ², so that a singular information has directions too.
const POSITION_PRIOR: f64 = 1.0;

/// Covariance of all positions, σ², (2 N, 2 N); empty where the information is singular.
pub(crate) fn position_covariance(context: &mut FitContext, hypothesis: &Hypothesis) -> Vec<f64> {
    let n = 2 * hypothesis.sources.len();
    let at = linearise(
        context.problem(),
        &mut hypothesis.clone(),
        context.budget,
        context.workspace,
    );
    if n == 0 {
        return Vec::new();
    }
    let Some(covariance) = Covariance::new(at.equations, POSITION_PRIOR) else {
        return Vec::new();
    };
    (0..n * n)
        .map(|k| covariance.at(k / n / 2, k / n % 2, k % n / 2, k % n % 2))
        .collect()
}

/// Standard deviation along the least determined direction, and the direction, which is removed from the covariance; `None` where all
/// are well determined.
pub(crate) fn ill_determined_direction(places: &mut [f64]) -> Option<(f64, Vec<f64>)> {
    let (variance, direction) = deflate_leading_eigenpair(places);
    (variance > MIN_DEVIATION * MIN_DEVIATION).then(|| (variance.sqrt(), direction))
}

/// The largest eigenvalue of a symmetric matrix and its eigenvector by power iteration; both are removed from the matrix.
fn deflate_leading_eigenpair(matrix: &mut [f64]) -> (f64, Vec<f64>) {
    let n = matrix.len().isqrt();
    let widest = (0..n)
        .max_by(|&i, &j| matrix[i * (n + 1)].total_cmp(&matrix[j * (n + 1)]))
        .unwrap_or(0);
    let mut vector = matrix[widest * n..(widest + 1) * n].to_vec();
    let mut value = 0.0;
    for _ in 0..ITERATIONS {
        let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(length > 0.0) {
            return (0.0, vector);
        }
        for v in &mut vector {
            *v /= length;
        }
        let next: Vec<f64> = matrix
            .chunks_exact(n)
            .map(|row| row.iter().zip(&vector).map(|(m, v)| m * v).sum())
            .collect();
        value = next.iter().zip(&vector).map(|(a, b)| a * b).sum();
        vector = next;
    }
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    for v in &mut vector {
        *v /= length;
    }
    for (i, row) in matrix.chunks_exact_mut(n).enumerate() {
        for (m, v) in row.iter_mut().zip(&vector) {
            *m -= value * vector[i] * v;
        }
    }
    (value, vector)
}

#[cfg(test)]
mod tests {
    use super::deflate_leading_eigenpair;

    #[test]
    fn the_leading_directions_come_one_after_the_other() {
        // 9 along (1, 2, 2)/3 and 4 along (2, 1, -2)/3.
        let (u, v) = ([1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0], [2.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]);
        let mut matrix: Vec<f64> = (0..9)
            .map(|k| 9.0 * u[k / 3] * u[k % 3] + 4.0 * v[k / 3] * v[k % 3])
            .collect();
        for (expected, axis) in [(9.0, u), (4.0, v)] {
            let (value, direction) = deflate_leading_eigenpair(&mut matrix);
            let along: f64 = direction.iter().zip(axis).map(|(a, b)| a * b).sum();
            assert!((value - expected).abs() < 1e-6, "{value}");
            assert!((along.abs() - 1.0).abs() < 1e-6, "{direction:?}");
        }
    }
}
