//! Retry delays of failed deliveries.

use std::time::Duration;

use rand::{Rng, RngExt};

const HOUR: u64 = 3600;

/// Waits before each attempt, from the one before it: the schedule of Standard Webhooks 1.0.0
/// ("Deliverability and reliability"). It ends 75 h 35 min after the first attempt.
const WAITS_S: [u64; 10] = [
    0,
    5,
    300,
    1800,
    2 * HOUR,
    5 * HOUR,
    10 * HOUR,
    14 * HOUR,
    20 * HOUR,
    24 * HOUR,
];

/// A wait is stretched by up to this fraction, never shortened.
const JITTER: f64 = 0.2;

/// Wait before the attempt that follows `used` attempts; `None` when the schedule is used up.
pub(super) fn wait(used: u32, rng: &mut impl Rng) -> Option<Duration> {
    let wait_s = *WAITS_S.get(used as usize)?;
    Some(Duration::from_secs(wait_s).mul_f64(1.0 + JITTER * rng.random::<f64>()))
}

/// The longest that [`wait`] can give.
pub(super) fn longest_wait(used: u32) -> Duration {
    let wait_s = WAITS_S.get(used as usize).copied().unwrap_or_default();
    Duration::from_secs(wait_s).mul_f64(1.0 + JITTER)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn the_schedule_spans_days_and_jitter_only_stretches_it() {
        for seed in 0..50 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let waits: Vec<Duration> = (0..).map_while(|used| wait(used, &mut rng)).collect();
            assert_eq!(waits.len(), 10);
            assert_eq!(waits[0], Duration::ZERO);
            for (k, wait) in waits.iter().enumerate() {
                assert!(*wait >= Duration::from_secs(WAITS_S[k]) && *wait <= longest_wait(k as u32));
            }
            let total: Duration = waits.iter().sum();
            assert!(total.as_secs() >= 75 * HOUR + 35 * 60);
        }
    }
}
