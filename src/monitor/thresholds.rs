use super::Config;

/// Mean length of a month, s.
const MONTH_S: f64 = 30.44 * 86_400.0;
/// The budget of false alerts is shared by: unclaimed, mismatch, unseen, pose.
const FAMILIES: f64 = 4.0;

/// Log-likelihood levels that keep the operator's false alerts per month.
#[derive(Clone, Copy, Debug)]
pub(super) struct Thresholds {
    tests_per_month: f64,
    allowed: f64,
}

impl Thresholds {
    pub fn new(config: &Config, rate_hz: f64) -> Self {
        let rate = if rate_hz.is_finite() {
            rate_hz.clamp(0.01, 1e4)
        } else {
            10.0
        };
        Self {
            tests_per_month: rate * MONTH_S,
            allowed: config.false_alerts_per_month / FAMILIES,
        }
    }

    /// ln(1/α) for one of `each` like tests in every frame: by Bonferroni, `allowed` false ones a month in the mean.
    pub fn level(&self, each: f64) -> f64 {
        (self.tests_per_month * each.max(1.0) / self.allowed).ln().max(3.0)
    }
}
