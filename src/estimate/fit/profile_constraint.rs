//! Profile constraint: holds the positions near a hyperplane, so that all else can be fitted at each point of a profile.

use crate::estimate::model::hypothesis::PointSource;

/// Σ direction·u = `at` with a precision.
#[derive(Clone, Debug)]
pub(crate) struct ProfileConstraint {
    pub direction: Vec<f64>,
    pub at: f64,
    pub precision: f64,
}

impl ProfileConstraint {
    /// Distance of the sources' positions from the hyperplane.
    pub fn beyond(&self, sources: &[PointSource]) -> f64 {
        let places = sources.iter().flat_map(|s| s.u);
        self.direction.iter().zip(places).map(|(d, u)| d * u).sum::<f64>() - self.at
    }

    /// The constraint's part of the deviance.
    pub fn deviance(&self, sources: &[PointSource]) -> f64 {
        self.precision * self.beyond(sources).powi(2)
    }

    /// Adds the constraint to the normal equations of `p` parameters.
    pub fn add_normal_equations(
        &self,
        sources: &[PointSource],
        gradient: &mut [f64],
        information: &mut [f64],
        p: usize,
    ) {
        let beyond = self.beyond(sources);
        let at = |k: usize| 3 * (k / 2) + k % 2;
        for (k, d) in self.direction.iter().enumerate() {
            gradient[at(k)] -= self.precision * d * beyond;
            for (l, e) in self.direction.iter().enumerate().skip(k) {
                information[at(k) * p + at(l)] += self.precision * d * e;
            }
        }
    }
}
