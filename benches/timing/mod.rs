//! Times calls: one line a name, median and extremes over repeated batches. `cargo bench --bench BENCH [TEXT]` runs the names
//! that contain a text.

use std::hint::black_box;
use std::time::{Duration, Instant};

const BATCHES: usize = 25;
/// A batch lasts at least this long, so that reading the clock does not count.
const BATCH: Duration = Duration::from_millis(20);

/// Calls `work` in batches of equal size and prints the times of one call, µs.
pub fn time<T>(name: &str, mut work: impl FnMut() -> T) {
    let wanted = std::env::args().skip(1).find(|a| !a.starts_with('-'));
    if wanted.is_some_and(|text| !name.contains(&text)) {
        return;
    }
    let mut batch = |calls: u32| {
        let clock = Instant::now();
        for _ in 0..calls {
            black_box(work());
        }
        clock.elapsed()
    };
    let mut calls = 1;
    while batch(calls) < BATCH {
        calls *= 2;
    }
    let mut times: Vec<f64> = (0..BATCHES)
        .map(|_| batch(calls).as_secs_f64() * 1e6 / f64::from(calls))
        .collect();
    times.sort_by(f64::total_cmp);
    let (least, median, most) = (times[0], times[BATCHES / 2], times[BATCHES - 1]);
    println!("{name:60} {median:12.3} µs ({least:.3} to {most:.3})");
}
