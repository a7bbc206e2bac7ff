use crate::monitor::config::Config;

/// Mean length of a month, s.
const MONTH_S: f64 = 30.44 * 86_400.0;
/// What the budget of false alerts is shared by.
#[derive(Clone, Copy, Debug)]
pub enum TestFamily {
    Unclaimed,
    Blended,
    Mismatch,
    Unseen,
    PoseConsensus,
}

impl TestFamily {
    /// More for those whose evidence comes slowly; for the others a frame more or less decides.
    fn share(self) -> f64 {
        match self {
            Self::Mismatch => 0.5,
            Self::Blended => 0.3,
            Self::Unclaimed => 0.1,
            Self::Unseen | Self::PoseConsensus => 0.05,
        }
    }
}

/// Log-likelihood levels that keep the operator's false alerts per month.
#[derive(Clone, Copy, Debug)]
pub struct ErrorBudget {
    rate_hz: f64,
    allowed_a_month: f64,
}

impl ErrorBudget {
    pub fn new(config: &Config, rate_hz: f64) -> Self {
        let rate = if rate_hz.is_finite() {
            rate_hz.clamp(0.01, 1e4)
        } else {
            10.0
        };
        Self {
            rate_hz: rate,
            allowed_a_month: config.false_alerts_per_month,
        }
    }

    /// ln(1/α) for one of `each` like tests in every frame: by Bonferroni, the family's share of the false alerts allowed.
    pub fn level(&self, family: TestFamily, each: f64) -> f64 {
        self.level_at(self.rate_hz, family, each)
    }

    /// The same for tests that happen every `period_s` (a claim's), at most once a frame.
    pub fn level_every(&self, period_s: f64, family: TestFamily, each: f64) -> f64 {
        self.level_at(self.rate_hz.min(1.0 / period_s.max(1e-6)), family, each)
    }

    fn level_at(&self, hz: f64, family: TestFamily, each: f64) -> f64 {
        let allowed = family.share() * self.allowed_a_month;
        (hz * MONTH_S * each.max(1.0) / allowed).ln().max(3.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_tests_together_keep_the_budget() {
        let budget = ErrorBudget::new(&Config::default(), 10.0);
        let users = 6.0;
        let (frames, claims) = (10.0 * MONTH_S, MONTH_S);
        let false_alerts = frames * (-budget.level(TestFamily::Unclaimed, 1.0)).exp()
            + frames * users * (-budget.level(TestFamily::Blended, users)).exp()
            + claims * 6.0 * users * (-budget.level_every(1.0, TestFamily::Mismatch, 6.0 * users)).exp()
            + frames * users * (-budget.level(TestFamily::Unseen, users)).exp()
            + frames * (-budget.level(TestFamily::PoseConsensus, 1.0)).exp();
        assert!((false_alerts - Config::default().false_alerts_per_month).abs() < 1e-9);
    }
}
