//! How the operator's false alerts per month are shared among the tests, and the threshold of each.

use crate::monitor::config::Config;

/// Mean length of a month, s.
const MONTH_S: f64 = 30.44 * 86_400.0;
/// Smallest threshold, nats: a budget however generous lets no test pass on p > 0.05.
const MIN_THRESHOLD: f64 = 3.0;
/// Frame rate assumed where the source states none, Hz.
const DEFAULT_RATE_HZ: f64 = 10.0;

/// Families of tests that share the budget.
#[derive(Clone, Copy, Debug)]
pub enum TestFamily {
    Unclaimed,
    CoLocated,
    Mismatch,
    Unseen,
    Pose,
}

impl TestFamily {
    /// Share of the budget. More for tests whose evidence comes slowly, where each nat costs seconds; the others lose a frame.
    fn share(self) -> f64 {
        match self {
            Self::Mismatch => 0.5,
            Self::CoLocated => 0.3,
            Self::Unclaimed => 0.1,
            Self::Unseen | Self::Pose => 0.05,
        }
    }
}

/// Thresholds on −ln p that keep the false alerts within the operator's budget.
#[derive(Clone, Copy, Debug)]
pub struct ErrorBudget {
    rate_hz: f64,
    allowed_per_month: f64,
}

impl ErrorBudget {
    pub fn new(config: &Config, rate_hz: f64) -> Self {
        let rate_hz = if rate_hz.is_finite() {
            rate_hz.clamp(0.01, 1e4)
        } else {
            DEFAULT_RATE_HZ
        };
        Self {
            rate_hz,
            allowed_per_month: config.false_alerts_per_month,
        }
    }

    /// The same frame rate with other settings.
    pub fn reconfigured(self, config: &Config) -> Self {
        Self {
            allowed_per_month: config.false_alerts_per_month,
            ..self
        }
    }

    /// Frames per second.
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// ln(1/α) for each of `tests` like tests in every frame: Bonferroni's share of the family's false alerts.
    pub fn threshold(&self, family: TestFamily, tests: f64) -> f64 {
        self.threshold_at(self.rate_hz, family, tests)
    }

    /// The same for tests that happen every `period_s` (at each claim), at most once a frame.
    pub fn threshold_every(&self, period_s: f64, family: TestFamily, tests: f64) -> f64 {
        self.threshold_at(self.rate_hz.min(1.0 / period_s.max(1e-6)), family, tests)
    }

    fn threshold_at(&self, hz: f64, family: TestFamily, tests: f64) -> f64 {
        let allowed = family.share() * self.allowed_per_month;
        (hz * MONTH_S * tests.max(1.0) / allowed).ln().max(MIN_THRESHOLD)
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
        let false_alerts = frames * (-budget.threshold(TestFamily::Unclaimed, 1.0)).exp()
            + frames * users * (-budget.threshold(TestFamily::CoLocated, users)).exp()
            + claims * 6.0 * users * (-budget.threshold_every(1.0, TestFamily::Mismatch, 6.0 * users)).exp()
            + frames * users * (-budget.threshold(TestFamily::Unseen, users)).exp()
            + frames * (-budget.threshold(TestFamily::Pose, 1.0)).exp();
        assert!((false_alerts - Config::default().false_alerts_per_month).abs() < 1e-9);
    }

    #[test]
    fn thresholds_by_hand() {
        let budget = ErrorBudget::new(&Config::default(), 10.0);
        // 10 Hz · 2,630,016 s / 0.1 = 263,001,600 tests for one false alert.
        assert!((budget.threshold(TestFamily::Unclaimed, 1.0) - 263_001_600f64.ln()).abs() < 1e-9);
        // Claims come no more often than frames.
        let fast = budget.threshold_every(0.0, TestFamily::Mismatch, 1.0);
        assert_eq!(fast, budget.threshold(TestFamily::Mismatch, 1.0));
        let generous = Config {
            false_alerts_per_month: 1e12,
            ..Config::default()
        };
        assert_eq!(
            ErrorBudget::new(&generous, f64::NAN).threshold(TestFamily::Pose, 1.0),
            3.0
        );
    }
}
