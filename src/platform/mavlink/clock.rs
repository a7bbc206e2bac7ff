//! The autopilot's clock against our own: exchanges of TIMESYNC where they are answered, arrival times where not.

use super::refusal::Refusal;

/// How far two crystals drift apart, s per s. Usual ones keep 50 parts in a million between them.
const DRIFT: f64 = 50e-6;
/// Requests that may be under way. At ten a second an answer has a second to come.
const PENDING: usize = 10;
/// An offset that differs from the present one by more than both bounds and this, ns, shows that the autopilot's clock has been set
/// or that it has restarted.
const STEP_NS: f64 = 10e6;
/// Contradictions in a row after which the new offset is believed: a single one may be a late or a forged answer.
const STEPS_IN_A_ROW: u32 = 5;
/// Without an answer for so long, ns, stamps alone may show that: ten requests a second were not answered.
const SILENT_NS: i64 = 10_000_000_000;
/// How far in our past or future a stamp may lie, ns. A sample older than this is of no use, whatever delayed it.
const OLDEST_NS: i64 = 2_000_000_000;
const NEWEST_NS: i64 = 20_000_000;
/// From here on a stamp counts microseconds since 1970 (this is in 2001), below since the autopilot started.
const UNIX_US: u64 = 1_000_000_000_000_000;

/// Our clock minus the autopilot's, ns, and how wrong it may be.
#[derive(Clone, Copy, Debug)]
struct Offset {
    ns: i64,
    bound_ns: f64,
    /// When it was measured, on our clock.
    at_ns: i64,
}

impl Offset {
    fn bound_at(&self, now_ns: i64) -> f64 {
        self.bound_ns + DRIFT * (now_ns - self.at_ns).abs() as f64
    }
}

/// How the autopilot's clock is related to ours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Relation {
    Unknown,
    /// From arrival times alone: stamps seem later than they are by the link's shortest delay.
    Arrival,
    /// From exchanges; the error is at most this, s.
    Exchange {
        error_s: f64,
    },
}

/// Turns the autopilot's stamps into times on our monotonic clock, all in ns.
#[derive(Debug, Default)]
pub struct Clock {
    exchange: Option<Offset>,
    /// When the last request was answered, on our clock.
    answered_ns: i64,
    /// The smallest difference of arrival and stamp.
    arrival: Option<Offset>,
    contradictions: u32,
    pending: [i64; PENDING],
    next: usize,
}

impl Clock {
    pub fn relation(&self, now_ns: i64) -> Relation {
        match (&self.exchange, &self.arrival) {
            (Some(offset), _) => Relation::Exchange {
                error_s: offset.bound_at(now_ns) * 1e-9,
            },
            (None, Some(_)) => Relation::Arrival,
            (None, None) => Relation::Unknown,
        }
    }

    /// Notes that a request with the stamp `sent_ns` has gone out.
    pub fn requested(&mut self, sent_ns: i64) {
        self.pending[self.next % PENDING] = sent_ns;
        self.next = (self.next + 1) % PENDING;
    }

    /// Takes an answer to one of our requests: `theirs_ns` was the autopilot's clock between `sent_ns` and now. The exchange with
    /// the shortest way is the most exact; it ages by the drift (Mills, Computer Network Time Synchronization, 2006, §3.7).
    pub fn answered(&mut self, sent_ns: i64, theirs_ns: i64, now_ns: i64) -> Result<(), Refusal> {
        let Some(request) = self.pending.iter_mut().find(|p| **p == sent_ns && sent_ns != 0) else {
            return Err(Refusal::Time);
        };
        *request = 0;
        let way_ns = now_ns - sent_ns;
        let found = sent_ns
            .checked_add(way_ns / 2)
            .and_then(|middle| middle.checked_sub(theirs_ns));
        let Some(ns) = found.filter(|_| way_ns >= 0) else {
            return Err(Refusal::Time);
        };
        let found = Offset {
            ns,
            bound_ns: way_ns as f64 / 2.0,
            at_ns: now_ns,
        };
        self.answered_ns = now_ns;
        Self::refine(&mut self.exchange, &mut self.contradictions, found, now_ns)
    }

    /// The time of a stamp in µs, since the autopilot started or since 1970. `unix_ns` is now.
    pub fn time_of_us(&mut self, stamp_us: u64, now_ns: i64, unix_ns: i64) -> Result<i64, Refusal> {
        let stamp_ns = i64::try_from(stamp_us)
            .ok()
            .and_then(|us| us.checked_mul(1000))
            .ok_or(Refusal::Time)?;
        match stamp_us < UNIX_US {
            true => self.time_of(stamp_ns, now_ns),
            false => plausible(stamp_ns.saturating_sub(unix_ns).saturating_add(now_ns), now_ns),
        }
    }

    /// The time of a stamp in ms since the autopilot started, which begins anew every 49.7 days.
    pub fn time_of_ms(&mut self, stamp_ms: u32, now_ns: i64) -> Result<i64, Refusal> {
        const TURN_NS: i64 = (1 << 32) * 1_000_000;
        let stamp_ns = i64::from(stamp_ms) * 1_000_000;
        let turns = self.exchange.or(self.arrival).map_or(0, |offset| {
            let expected = now_ns.saturating_sub(offset.ns);
            (expected.saturating_sub(stamp_ns).saturating_add(TURN_NS / 2)).div_euclid(TURN_NS)
        });
        self.time_of(stamp_ns.saturating_add(turns.saturating_mul(TURN_NS)), now_ns)
    }

    fn time_of(&mut self, stamp_ns: i64, now_ns: i64) -> Result<i64, Refusal> {
        if let Some(offset) = self.exchange {
            let time = plausible(stamp_ns.saturating_add(offset.ns), now_ns);
            if now_ns - self.answered_ns < SILENT_NS {
                return time;
            }
            self.contradictions = if time.is_ok() { 0 } else { self.contradictions + 1 };
            if self.contradictions < STEPS_IN_A_ROW {
                return time;
            }
            (self.exchange, self.arrival) = (None, None);
        }
        let found = Offset {
            ns: now_ns.saturating_sub(stamp_ns),
            bound_ns: 0.0,
            at_ns: now_ns,
        };
        // No sample arrives before it was taken: the smallest difference is the nearest to the truth, but for the drift.
        match self.arrival {
            None => self.arrival = Some(found),
            Some(offset) => {
                let later = found.ns.saturating_sub(offset.ns) as f64;
                if later <= DRIFT * (now_ns - offset.at_ns) as f64 && later > -(OLDEST_NS as f64) {
                    (self.arrival, self.contradictions) = (Some(found), 0);
                } else if later.abs() > OLDEST_NS as f64 {
                    self.contradictions += 1;
                    if self.contradictions < STEPS_IN_A_ROW {
                        return Err(Refusal::Time);
                    }
                    (self.arrival, self.contradictions) = (Some(found), 0);
                } else {
                    self.contradictions = 0;
                }
            }
        }
        let offset = self.arrival.map_or(0, |offset| offset.ns);
        plausible(stamp_ns.saturating_add(offset), now_ns)
    }

    fn refine(kept: &mut Option<Offset>, contradictions: &mut u32, found: Offset, now_ns: i64) -> Result<(), Refusal> {
        let Some(offset) = *kept else {
            *kept = Some(found);
            return Ok(());
        };
        let apart = (found.ns.saturating_sub(offset.ns) as f64).abs();
        if apart > found.bound_ns + offset.bound_at(now_ns) + STEP_NS {
            *contradictions += 1;
            if *contradictions < STEPS_IN_A_ROW {
                return Err(Refusal::Time);
            }
            *kept = Some(found);
        } else if found.bound_ns <= offset.bound_at(now_ns) {
            *kept = Some(found);
        }
        *contradictions = 0;
        Ok(())
    }
}

fn plausible(time_ns: i64, now_ns: i64) -> Result<i64, Refusal> {
    let age = now_ns.saturating_sub(time_ns);
    (-NEWEST_NS..=OLDEST_NS)
        .contains(&age)
        .then_some(time_ns)
        .ok_or(Refusal::Time)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const S: i64 = 1_000 * MS;

    #[test]
    fn the_shortest_exchange_counts_and_ages() {
        let mut clock = Clock::default();
        // The autopilot started 100 s before our clock; answers come back 1 ms or 21 ms late, the way out takes 1 ms.
        for k in 0..200i64 {
            let sent = k * 100 * MS + 1;
            let back = if k % 7 == 3 { MS } else { 21 * MS };
            clock.requested(sent);
            clock.answered(sent, sent + MS + 100 * S, sent + MS + back).unwrap();
        }
        let now = 20 * S;
        let Relation::Exchange { error_s } = clock.relation(now) else {
            panic!("exchanges were answered");
        };
        assert!(error_s < 1.1e-3, "{error_s}");
        let time = clock.time_of_us(120_000_000, now, 0).unwrap();
        assert!((time - now).abs() < MS / 10, "{}", time - now);
    }

    #[test]
    fn nobody_answers_what_was_not_asked() {
        let mut clock = Clock::default();
        clock.requested(5 * S);
        assert_eq!(clock.answered(4 * S, 0, 5 * S), Err(Refusal::Time));
        assert_eq!(clock.answered(0, 0, 5 * S), Err(Refusal::Time));
        assert_eq!(clock.answered(5 * S, 0, 5 * S), Ok(()));
        assert_eq!(
            clock.answered(5 * S, 0, 5 * S),
            Err(Refusal::Time),
            "an answer is taken once"
        );
    }

    #[test]
    fn milliseconds_go_on_after_their_last() {
        let mut clock = Clock::default();
        let start = i64::from(u32::MAX) * MS;
        for k in 0..100 {
            let since_start = start - 50 * 20 * MS + k * 20 * MS;
            let now = k * 20 * MS;
            let time = clock.time_of_ms((since_start / MS) as u32, now).unwrap();
            assert!((time - now).abs() <= MS, "{k}: {}", time - now);
        }
    }

    #[test]
    fn a_restart_is_believed_after_some_samples_and_one_jump_is_not() {
        let mut clock = Clock::default();
        for k in 0..50i64 {
            assert!(
                clock
                    .time_of_us(1_000_000_000 + k as u64 * 20_000, k * 20 * MS, 0)
                    .is_ok()
            );
        }
        assert!(clock.time_of_us(77, 50 * 20 * MS, 0).is_err());
        assert!(clock.time_of_us(1_001_020_000, 51 * 20 * MS, 0).is_ok());
        let refused = (52..72).filter(|k| clock.time_of_us(*k as u64 * 20_000, k * 20 * MS, 0).is_err());
        assert_eq!(refused.count(), STEPS_IN_A_ROW as usize - 1);
    }

    #[test]
    fn a_restart_is_believed_after_exchanges_have_ended() {
        let mut clock = Clock::default();
        clock.requested(S);
        clock.answered(S, 100 * S, S).unwrap();
        assert!(clock.time_of_us(100_020_000, S + 20 * MS, 0).is_ok());
        // Restarted while answers still come, or may: they decide.
        assert!((0..50).all(|k| clock.time_of_us(k * 20_000, 2 * S + k as i64 * 20 * MS, 0).is_err()));
        let after = S + SILENT_NS;
        assert!(clock.time_of_us(110_000_000, after, 0).is_ok());
        let refused = (0..20).filter(|k| clock.time_of_us(*k as u64 * 20_000, after + k * 20 * MS, 0).is_err());
        assert_eq!(refused.count(), STEPS_IN_A_ROW as usize - 1);
        assert_eq!(clock.relation(after + S), Relation::Arrival);
    }

    #[test]
    fn contradictions_with_others_between_them_do_not_add_up() {
        let mut clock = Clock::default();
        for k in 0..50i64 {
            let now = k * 20 * MS;
            // Each one but the first 10 ms late, every other one absurd.
            let late_us = if k == 0 { 0 } else { 10_000 };
            let stamp = if k % 2 == 1 {
                77
            } else {
                1_000_000_000 + k as u64 * 20_000 - late_us
            };
            assert_eq!(clock.time_of_us(stamp, now, 0).is_ok(), k % 2 == 0, "{k}");
        }
    }

    #[test]
    fn absurd_stamps_are_refused() {
        let mut clock = Clock::default();
        assert!(clock.time_of_us(10_000_000, S, 0).is_ok());
        for stamp in [u64::MAX, u64::MAX / 1000, UNIX_US, UNIX_US - 1] {
            assert_eq!(clock.time_of_us(stamp, S, 1_780_000_000 * S), Err(Refusal::Time));
        }
    }
}
