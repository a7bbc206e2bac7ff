use jiff::Timestamp;

use super::Monitor;
use crate::claims::{Store, seconds};
use crate::monitor::users::Asserted;

/// At the start of a run every user's claim has come after this many claim periods.
const FIRST_CLAIMS: f64 = 1.3;
/// Without a second claim of anyone by then there is none to wait for, s.
const NO_CLAIMS_S: f64 = 12.0;
/// Claims that take longer to come in than this are not waited for, s.
const LONGEST_DELAY_S: f64 = 3.0;

impl Monitor {
    /// The log's habits, as medians over users: no single one can slow the monitor down.
    pub(super) fn learn_habits(&mut self, asserted: &[Asserted], claims: &Store, now: Timestamp) {
        if self.first_claim.is_none() && claims.quiet_s(now).is_some() {
            self.first_claim = Some(now);
        }
        if let Some(period) = median(asserted.iter().filter_map(|a| a.period_s)) {
            self.period_s = Some(period);
        }
        let delay = median(asserted.iter().map(|a| seconds(a.claim.time, a.came)));
        self.delay_s = delay.unwrap_or(0.0).clamp(0.0, LONGEST_DELAY_S);
    }

    pub(super) fn claims_settled(&self, now: Timestamp) -> bool {
        let Some(first) = self.first else { return false };
        match (self.first_claim, self.period_s) {
            (Some(t), Some(period)) => seconds(t, now) >= (FIRST_CLAIMS * period + 2.0 * self.delay_s).min(NO_CLAIMS_S),
            _ => seconds(first, now) >= NO_CLAIMS_S,
        }
    }
}

pub(super) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
