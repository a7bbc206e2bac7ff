use jiff::Timestamp;

use crate::claims::{Store, seconds};
use crate::monitor::input::claim_state::ActiveClaim;
use crate::monitor::input::clock_offset::ahead_s;
use crate::monitor::monitor::Monitor;

/// At the start of a run every user's claim has come after this many claim periods.
const FIRST_CLAIMS: f64 = 1.3;
/// Steps in which the log's clock is followed, s.
const CLOCK_STEP_S: f64 = 0.1;
/// And has told what they can of the log's clock after this many.
const CLOCK_CLAIMS: f64 = 3.0;
/// Without a second claim of anyone by then there is none to wait for, s.
const NO_CLAIMS_S: f64 = 12.0;
/// Claims that take longer to come in than this are not waited for, s.
const LONGEST_DELAY_S: f64 = 3.0;

impl Monitor {
    /// The log's habits, as medians over users: no single one can slow the monitor down.
    pub fn learn_timing(&mut self, active: &[ActiveClaim], claims: &Store, now: Timestamp) {
        if self.first_claim.is_none() && claims.quiet_s(now).is_some() {
            self.first_claim = Some(now);
        }
        // Names without a beam say nothing of the log while they are many.
        let crowded = self.crowding.is_crowded();
        let telling = || active.iter().filter(|a| !crowded || a.is_established);
        if let Some(period) = median(telling().filter_map(|a| a.period_s)) {
            self.period_s = Some(period);
        }
        let delay = median(telling().map(|a| seconds(a.claim.time, a.came)));
        self.delay_s = delay.unwrap_or(0.0).clamp(0.0, LONGEST_DELAY_S);
    }

    /// Follows the log's clock. Claims held against where their users were by another clock count no more.
    pub fn learn_clock(&mut self) {
        let movers = self.users.values().map(|u| &u.clock);
        let ahead_s = ahead_s(movers, self.config.tolerated_clock_offset_s);
        if (ahead_s - self.ahead_s).abs() > CLOCK_STEP_S {
            self.ahead_s = ahead_s;
            for user in self.users.values_mut().filter(|u| !u.mismatched) {
                user.residuals.forget();
            }
        }
    }

    /// What the log's clock may still be off, s: at the start of a run nobody has told yet.
    pub fn unsure_of_clock_s(&self, now: Timestamp) -> f64 {
        let known = CLOCK_CLAIMS * self.period_s.unwrap_or(1.0);
        let since = self.first_claim.map_or(0.0, |t| seconds(t, now));
        match since < known.min(NO_CLAIMS_S) {
            true => self.config.tolerated_clock_offset_s,
            false => 0.0,
        }
    }

    /// Whether a run has seen enough to say that a cause from before it is gone.
    pub fn has_caught_up(&self, now: Timestamp) -> bool {
        let needed = 2.0 * self.config.decision_s + self.delay_s;
        self.claims_settled(now) && self.first_usable.is_some_and(|t| seconds(t, now) >= needed)
    }

    pub fn claims_settled(&self, now: Timestamp) -> bool {
        let Some(first) = self.first else { return false };
        match (self.first_claim, self.period_s) {
            (Some(t), Some(period)) => seconds(t, now) >= (FIRST_CLAIMS * period + 2.0 * self.delay_s).min(NO_CLAIMS_S),
            _ => seconds(first, now) >= NO_CLAIMS_S,
        }
    }
}

pub fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
