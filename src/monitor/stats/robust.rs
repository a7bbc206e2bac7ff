//! Order statistics: medians and quantiles, none of which a minority of liars can move far.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Vector2;

/// The median; of an even number of values the mean of the two in the middle. `None` of none.
pub fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let values = sorted(values);
    let upper = values.get(values.len() / 2)?;
    Some(0.5 * (values[(values.len() - 1) / 2] + upper))
}

/// The median; of an even number of values the upper of the two in the middle, so that it is always one of them.
pub fn median_high(values: impl Iterator<Item = f64>) -> Option<f64> {
    order_statistic(values, |n| n / 2)
}

/// The value below which nine tenths of all values lie. `None` of none.
pub fn ninth_decile(values: impl Iterator<Item = f64>) -> Option<f64> {
    order_statistic(values, |n| n * 9 / 10)
}

/// Component-wise median; zero of none.
pub fn median_vector(values: impl Iterator<Item = Vector2<f64>> + Clone) -> Vector2<f64> {
    let axis = |k: usize| median(values.clone().map(|v| v[k])).unwrap_or(0.0);
    Vector2::new(axis(0), axis(1))
}

/// Variance of the median of `count` Gaussian values: π/2 times that of their mean.
pub fn variance_of_median(variance: f64, count: usize) -> f64 {
    FRAC_PI_2 * variance / count as f64
}

/// What displacements have in common: their component-wise upper median where there are more than `others`, else nothing.
pub fn common_displacement(others: usize, displacements: impl Iterator<Item = Vector2<f64>>) -> Vector2<f64> {
    let known: Vec<_> = displacements.collect();
    let axis = |k: usize| median_high(known.iter().map(|d| d[k])).unwrap_or(0.0);
    match known.len() > others {
        true => Vector2::new(axis(0), axis(1)),
        false => Vector2::zeros(),
    }
}

/// The value of that rank, of so many; `None` of none.
fn order_statistic(values: impl Iterator<Item = f64>, rank: impl FnOnce(usize) -> usize) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let rank = rank(values.len());
    (rank < values.len()).then(|| *values.select_nth_unstable_by(rank, f64::total_cmp).1)
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_odd_and_even_numbers() {
        let of = |values: &[f64]| (median(values.iter().copied()), median_high(values.iter().copied()));
        assert_eq!(of(&[]), (None, None));
        assert_eq!(of(&[3.0, 1.0, 2.0]), (Some(2.0), Some(2.0)));
        assert_eq!(of(&[4.0, 1.0, 2.0, 9.0]), (Some(3.0), Some(4.0)));
    }

    #[test]
    fn fewer_than_half_of_the_values_move_the_median_no_further_than_the_rest_spread() {
        let honest = [1.0, 1.1, 1.2];
        let lies = [1e9, -1e9, f64::INFINITY];
        let median = median(honest.iter().chain(&lies[..2]).copied());
        assert_eq!(median, Some(1.1));
    }

    #[test]
    fn the_ninth_decile_of_ten_values_is_the_largest() {
        assert_eq!(ninth_decile((1..=10).rev().map(f64::from)), Some(10.0));
        assert_eq!(ninth_decile((1..=20).map(f64::from)), Some(19.0));
        assert_eq!(ninth_decile(std::iter::empty()), None);
    }

    #[test]
    fn a_median_vector_is_taken_by_component() {
        let values = [[0.0, 5.0], [1.0, 3.0], [9.0, 4.0]].map(Vector2::from);
        assert_eq!(median_vector(values.into_iter()), Vector2::new(1.0, 4.0));
        assert_eq!(median_vector(std::iter::empty()), Vector2::zeros());
    }

    #[test]
    fn what_is_common_needs_more_than_two() {
        let of = |xs: &[f64]| common_displacement(2, xs.iter().map(|x| Vector2::new(*x, 0.0))).x;
        assert_eq!((of(&[1.0, 1.0]), of(&[1.0, 5.0, 2.0])), (0.0, 2.0));
    }
}
