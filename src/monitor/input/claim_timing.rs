//! The rhythm of the log: how often users claim, how late claims come, and whether everybody has had time to claim.

use jiff::Timestamp;

use super::claim_state::ActiveClaim;
use super::crowding::Crowding;
use crate::monitor::stats::robust::median_high;
use crate::time::seconds;

/// Claim periods after which, at the start of a run, every user's claim has come. Longer delays the first verdicts of a run,
/// shorter alerts users whose first claim is still to come. Not measured.
const SETTLED_PERIODS: f64 = 1.3;
/// Claim periods after which moving users have shown what they can of the log's clock. Longer tolerates more at the start of a
/// run, shorter alerts movers before the offset is known. Not measured.
const CLOCK_PERIODS: f64 = 3.0;
/// Without a second claim of anyone by then there is none to wait for, s. Longer delays the first verdict of a run without
/// claims. Not measured.
const NO_CLAIMS_S: f64 = 12.0;
/// Longest delay of claims that is waited for, s: beyond it a slow log would buy a stranger time. Longer delays every alert of a
/// slow log, shorter alerts its users. Not measured.
const MAX_DELAY_S: f64 = 3.0;
/// Share of `decision_s` to wait for late claims. The rest is for frames that miss the beam, and for a beam that comes on within
/// another's spot and is seen only as it walks out. Larger delays the alert of a beam that is seen late beyond `decision_s`,
/// smaller alerts users whose claim is late. Not measured.
const CLAIM_WAIT: f64 = 0.65;

/// Medians over users, so that no single one can slow the monitor down.
#[derive(Clone, Copy, Debug, Default)]
pub struct ClaimTiming {
    started: Option<Timestamp>,
    first_claim: Option<Timestamp>,
    first_usable: Option<Timestamp>,
    /// Typical seconds between a user's claims, and from a claim's own time to its arrival.
    period_s: Option<f64>,
    delay_s: f64,
}

impl ClaimTiming {
    /// The run has begun at `now` if it had not before.
    pub fn begin(&mut self, now: Timestamp) {
        self.started.get_or_insert(now);
    }

    /// A frame could be used.
    pub fn saw_frame(&mut self, now: Timestamp) {
        self.first_usable.get_or_insert(now);
    }

    /// Takes a frame's active claims; `has_claims` once any claim has been accepted. Names without a beam say nothing of the log
    /// while they are many.
    pub fn update(&mut self, claims: &[ActiveClaim], crowding: &Crowding, has_claims: bool, now: Timestamp) {
        if self.first_claim.is_none() && has_claims {
            self.first_claim = Some(now);
        }
        let evidence = || claims.iter().filter(|a| crowding.is_evidence(a));
        if let Some(period) = median_high(evidence().filter_map(|a| a.period_s)) {
            self.period_s = Some(period);
        }
        let delay = median_high(evidence().map(|a| seconds(a.claim.time, a.came)));
        self.delay_s = delay.unwrap_or(0.0).clamp(0.0, MAX_DELAY_S);
    }

    pub fn period_s(&self) -> Option<f64> {
        self.period_s
    }

    /// How long a beam that may be a user's waits for a claim, s.
    pub fn claim_wait_s(&self, decision_s: f64) -> f64 {
        CLAIM_WAIT * decision_s + self.delay_s
    }

    /// Whether everybody has had time to claim once.
    pub fn is_settled(&self, now: Timestamp) -> bool {
        let Some(started) = self.started else { return false };
        match (self.first_claim, self.period_s) {
            (Some(t), Some(period)) => {
                seconds(t, now) >= (SETTLED_PERIODS * period + 2.0 * self.delay_s).min(NO_CLAIMS_S)
            }
            _ => seconds(started, now) >= NO_CLAIMS_S,
        }
    }

    /// Whether a run has seen enough to say that a cause from before it is gone.
    pub fn has_caught_up(&self, now: Timestamp, decision_s: f64) -> bool {
        let needed = 2.0 * decision_s + self.delay_s;
        self.is_settled(now) && self.first_usable.is_some_and(|t| seconds(t, now) >= needed)
    }

    /// What the log's clock may still be off, s: all that is tolerated until users have had time to show it.
    pub fn clock_uncertainty_s(&self, now: Timestamp, tolerated_s: f64) -> f64 {
        let known = CLOCK_PERIODS * self.period_s.unwrap_or(1.0);
        let since = self.first_claim.map_or(0.0, |t| seconds(t, now));
        if since < known.min(NO_CLAIMS_S) {
            tolerated_s
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::claim_state::fixture::active_claim;
    use super::*;

    fn at(s: f64) -> Timestamp {
        Timestamp::from_millisecond((1e3 * s) as i64).unwrap()
    }

    /// Three users who claim every 0.5, 1 and 8 s; one claim took 100 s.
    fn learned() -> ClaimTiming {
        let claims = [(0.5, 0.1), (1.0, 0.2), (8.0, 100.0)].map(|(period_s, delay_s)| {
            let mut claim = active_claim("a", 0.0, 0.0);
            claim.period_s = Some(period_s);
            claim.came = at(delay_s);
            claim
        });
        let mut timing = ClaimTiming::default();
        timing.begin(at(0.0));
        timing.update(&claims, &Crowding::default(), true, at(0.0));
        timing
    }

    #[test]
    fn period_and_delay_are_medians_over_users() {
        let timing = learned();
        assert_eq!(timing.period_s(), Some(1.0));
        assert!((timing.claim_wait_s(1.0) - 0.85).abs() < 1e-9);
        let mut late = active_claim("a", 0.0, 0.0);
        late.came = at(100.0);
        let mut timing = timing;
        timing.update(&[late], &Crowding::default(), true, at(1.0));
        assert!(
            (timing.claim_wait_s(1.0) - 3.65).abs() < 1e-9,
            "a delay counts for 3 s at most"
        );
    }

    #[test]
    fn a_run_settles_after_a_period_and_a_third_or_without_claims_after_twelve_seconds() {
        let timing = learned();
        assert!(!timing.is_settled(at(1.65)) && timing.is_settled(at(1.75)));
        let mut quiet = ClaimTiming::default();
        assert!(!quiet.is_settled(at(99.0)), "it has not begun");
        quiet.begin(at(0.0));
        quiet.begin(at(50.0));
        assert!(!quiet.is_settled(at(11.9)) && quiet.is_settled(at(12.0)));
    }

    #[test]
    fn catching_up_takes_frames_as_well() {
        let mut timing = learned();
        assert!(!timing.has_caught_up(at(50.0), 1.0));
        timing.saw_frame(at(50.0));
        assert!(!timing.has_caught_up(at(52.1), 1.0) && timing.has_caught_up(at(52.3), 1.0));
    }

    #[test]
    fn the_clock_is_uncertain_for_three_periods() {
        let timing = learned();
        assert_eq!(timing.clock_uncertainty_s(at(2.9), 1.5), 1.5);
        assert_eq!(timing.clock_uncertainty_s(at(3.0), 1.5), 0.0);
    }
}
