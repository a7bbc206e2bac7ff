//! Small statistics that several modules need.

/// The median, the upper of the two middle values where their number is even; none of an empty list.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Squared Mahalanobis distance dᵀC⁻¹d; 0 for d = 0, ∞ where C has no variance along an axis.
pub fn mahalanobis2(cov: [[f64; 2]; 2], d: [f64; 2]) -> f64 {
    if d == [0.0, 0.0] {
        return 0.0;
    }
    // Whitened axis by axis, so that covariances of 1e-300 do not underflow in a determinant.
    let (sx, sy) = (cov[0][0].sqrt(), cov[1][1].sqrt());
    if sx == 0.0 || sy == 0.0 {
        return f64::INFINITY;
    }
    let rho = cov[0][1] / sx / sy;
    let (u, v) = (d[0] / sx, d[1] / sy);
    let across = (v - rho * u).powi(2) / ((1.0 - rho) * (1.0 + rho)).max(f64::EPSILON);
    u * u + across
}

/// Share of a frame's values at the lowest one from which on a camera has cut off what is darker: of counts up to six times as coarse as
/// the noise a fortieth at most is there.
const CUT_OFF: f64 = 0.1;

/// Whether values are cut off at the lowest: half of the noise about a camera's black level then lies on it.
pub fn is_cut_off(values: impl Iterator<Item = f64> + Clone) -> bool {
    let lowest = values.clone().fold(f64::INFINITY, f64::min);
    let (at_lowest, all) = values.fold((0.0, 0.0), |(at, all), v| {
        (at + f64::from(u8::from(v == lowest)), all + 1.0)
    });
    at_lowest > CUT_OFF * all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_a_middle_value() {
        assert_eq!(median(vec![]), None);
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![4.0, 1.0, 3.0, 2.0]), Some(3.0));
    }

    #[test]
    fn distances_of_known_covariances() {
        assert_eq!(mahalanobis2([[4.0, 0.0], [0.0, 9.0]], [2.0, 3.0]), 2.0);
        // C = [[2, 1], [1, 2]]: C⁻¹ = [[2, −1], [−1, 2]]/3.
        assert!((mahalanobis2([[2.0, 1.0], [1.0, 2.0]], [1.0, 1.0]) - 2.0 / 3.0).abs() < 1e-15);
        assert_eq!(mahalanobis2([[0.0; 2]; 2], [0.0, 0.0]), 0.0);
        assert_eq!(mahalanobis2([[0.0; 2]; 2], [1.0, 0.0]), f64::INFINITY);
        assert_eq!(mahalanobis2([[1e-300, 0.0], [0.0, 1e-300]], [1e-150, 0.0]), 1.0);
    }
}
