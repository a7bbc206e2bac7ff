//! Tests of the delivery queue: order per alert, retries, recovery after an outage.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::*;

fn s(seconds: u64) -> Duration {
    Duration::from_secs(seconds)
}

fn take_all(queue: &mut Queue, now: Duration) -> Vec<u64> {
    std::iter::from_fn(|| queue.take(now)).map(|job| job.seq).collect()
}

#[test]
fn an_alerts_later_event_waits_for_the_earlier() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut queue = Queue::default();
    queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
    queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
    queue.push("b", 3, 0, s(0), Timestamp::UNIX_EPOCH);
    assert_eq!(take_all(&mut queue, s(0)), [1, 3]);
    queue.sent(3, s(0));
    queue.failed(1, None, s(0), &mut rng);
    assert!(take_all(&mut queue, s(4)).is_empty(), "not before the schedule says so");
    assert_eq!(take_all(&mut queue, s(6)), [1]);
    queue.sent(1, s(6));
    assert_eq!(take_all(&mut queue, s(6)), [2]);
    queue.sent(2, s(6));
    assert_eq!((queue.len(), queue.wake_at()), (0, None));
}

#[test]
fn a_busy_alert_takes_turns_with_quiet_ones() {
    let mut queue = Queue::default();
    for seq in 1..=100 {
        queue.push("busy", seq, 0, s(0), Timestamp::UNIX_EPOCH);
    }
    for (k, alert) in ["p", "q", "r", "t", "u"].iter().enumerate() {
        queue.push(alert, 101 + k as u64, 0, s(0), Timestamp::UNIX_EPOCH);
    }
    let mut order = Vec::new();
    for round in 1..=4 {
        for seq in take_all(&mut queue, s(round)) {
            order.push(seq);
            queue.sent(seq, s(round));
        }
    }
    let quiet_done = order.iter().position(|&seq| seq == 105).unwrap();
    assert!(quiet_done < 8, "{order:?}");
}

#[test]
fn a_dead_receiver_gets_one_request_at_a_time_and_all_once_it_is_back() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut queue = Queue::default();
    for seq in 0..50 {
        queue.push(&format!("a{seq}"), seq, 0, s(0), Timestamp::UNIX_EPOCH);
    }
    let first = take_all(&mut queue, s(0));
    assert_eq!(first.len(), ABREAST);
    for seq in first {
        queue.failed(seq, None, s(0), &mut rng);
    }
    // A day without an answer. Each try is one request alone; none is given up.
    let mut tries = 0;
    let mut now = s(0);
    while now < s(24 * 3600) {
        match queue.take(now) {
            Some(job) => {
                tries += 1;
                assert_eq!(queue.take(now), None);
                assert!(matches!(queue.failed(job.seq, None, now, &mut rng), Next::Retry { .. }));
            }
            None => now = queue.wake_at().unwrap().max(now + s(1)),
        }
    }
    assert!(tries > 24 * 60, "probed about once a minute, {tries} times");
    // Back: at most a minute later everything has gone out.
    let wake = queue.wake_at().unwrap();
    assert!(wake <= now + PROBE);
    let job = queue.take(wake).unwrap();
    queue.sent(job.seq, wake);
    let mut left = 49;
    while left > 0 {
        let jobs = take_all(&mut queue, wake);
        assert!(!jobs.is_empty());
        for seq in jobs {
            queue.sent(seq, wake);
            left -= 1;
        }
    }
    assert_eq!(queue.len(), 0);
}

#[test]
fn only_scheduled_attempts_use_up_the_schedule() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut queue = Queue::default();
    queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
    queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
    let mut now = s(0);
    let mut attempts = 0;
    loop {
        let Some(job) = queue.take(now) else {
            now = queue.wake_at().unwrap();
            continue;
        };
        attempts += 1;
        if queue.failed(job.seq, None, now, &mut rng) == Next::Dead {
            break;
        }
    }
    assert!(now >= s(75 * 3600 + 35 * 60), "given up after {now:?}");
    assert!(attempts > 1000, "{attempts}");
    assert_eq!(
        queue.origins.keys().collect::<Vec<_>>(),
        [&2],
        "the alert's next event is not given up with it"
    );
}

#[test]
fn patience_is_kept_and_holds_for_the_whole_endpoint() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut queue = Queue::default();
    queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
    let job = queue.take(s(0)).unwrap();
    queue.failed(job.seq, Some(s(600)), s(0), &mut rng);
    queue.push("b", 2, 0, s(1), Timestamp::UNIX_EPOCH);
    assert!(take_all(&mut queue, s(599)).is_empty());
    assert_eq!(queue.wake_at(), Some(s(600)));
    assert_eq!(take_all(&mut queue, s(600)).len(), 1);
}

#[test]
fn a_receiver_that_is_gone_is_left_alone_until_enabled() {
    let mut queue = Queue::default();
    queue.push("a", 1, 0, s(0), Timestamp::UNIX_EPOCH);
    let job = queue.take(s(0)).unwrap();
    queue.gone(job.seq, s(0));
    queue.push("b", 2, 0, s(1), Timestamp::UNIX_EPOCH);
    assert!(take_all(&mut queue, s(1_000_000)).is_empty());
    assert_eq!(queue.wake_at(), None);
    queue.enable(s(1_000_001));
    assert_eq!(take_all(&mut queue, s(1_000_001)), [1, 2]);
}

#[test]
fn a_dead_letter_that_comes_back_goes_ahead_of_what_waits() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut queue = Queue::default();
    queue.push("a", 5, 0, s(0), Timestamp::UNIX_EPOCH);
    queue.push("a", 6, 0, s(0), Timestamp::UNIX_EPOCH);
    assert_eq!(take_all(&mut queue, s(0)), [5]);
    queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
    queue.push("a", 2, 0, s(0), Timestamp::UNIX_EPOCH);
    assert_eq!(queue.len(), 3);
    queue.failed(5, None, s(0), &mut rng);
    // 5 keeps its place: it was under way already.
    assert_eq!(take_all(&mut queue, s(7)), [5]);
    queue.sent(5, s(7));
    assert_eq!(take_all(&mut queue, s(7)), [2]);
    queue.sent(2, s(7));
    assert_eq!(take_all(&mut queue, s(7)), [6]);
}
