use super::Config;

/// Mean length of a month, s.
const MONTH_S: f64 = 30.44 * 86_400.0;
/// The budget of false alerts is shared by: unclaimed, blended, mismatch, unseen, pose.
const FAMILIES: f64 = 5.0;

/// Log-likelihood levels that keep the operator's false alerts per month.
#[derive(Clone, Copy, Debug)]
pub(super) struct Thresholds {
    rate_hz: f64,
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
            rate_hz: rate,
            allowed: config.false_alerts_per_month / FAMILIES,
        }
    }

    /// ln(1/α) for one of `each` like tests in every frame: by Bonferroni, `allowed` false ones a month in the mean.
    pub fn level(&self, each: f64) -> f64 {
        self.level_at(self.rate_hz, each)
    }

    /// The same for tests that happen every `period_s` (a claim's), at most once a frame.
    pub fn level_every(&self, period_s: f64, each: f64) -> f64 {
        self.level_at(self.rate_hz.min(1.0 / period_s.max(1e-6)), each)
    }

    fn level_at(&self, hz: f64, each: f64) -> f64 {
        (hz * MONTH_S * each.max(1.0) / self.allowed).ln().max(3.0)
    }
}
