//! The fuzz targets on their seeds, and on what a few hundred random changes make of each. Fuzzing itself is in `fuzz/`.

#[path = "../api/fake.rs"]
#[allow(dead_code, reason = "the API's own tests use more of it")]
mod fake;
#[path = "../api/fixtures.rs"]
mod fixtures;
#[path = "../../fuzz/src/http.rs"]
mod http;
#[path = "../../fuzz/src/targets.rs"]
mod targets;

use std::panic::AssertUnwindSafe;
use std::path::Path;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Tries every seed and `changes` changes of each; with `OAPWATCH_FUZZ_SECONDS` more of them, for so long.
fn try_seeds(folder: &str, changes: usize, target: impl Fn(&[u8])) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut paths: Vec<_> = std::fs::read_dir(path)
        .expect("the folder of seeds")
        .map(|entry| entry.expect("a seed").path())
        .collect();
    paths.sort();
    let seeds: Vec<_> = paths.iter().map(|path| std::fs::read(path).expect("a seed")).collect();
    assert!(!seeds.is_empty());
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    seeds.iter().for_each(|seed| target(seed));
    let time = std::env::var("OAPWATCH_FUZZ_SECONDS").ok().and_then(|s| s.parse().ok());
    let time = Duration::from_secs(time.unwrap_or(0));
    let began = Instant::now();
    let (mut tried, mut longest) = (0, Duration::ZERO);
    while tried < changes * seeds.len() || began.elapsed() < time {
        let bytes = changed(seeds[tried % seeds.len()].clone(), &mut rng);
        let started = Instant::now();
        let outcome = std::panic::catch_unwind(AssertUnwindSafe(|| target(&bytes)));
        longest = longest.max(started.elapsed());
        if let Err(panic) = outcome {
            eprintln!("{folder}: {:?}", String::from_utf8_lossy(&bytes));
            std::panic::resume_unwind(panic);
        }
        tried += 1;
    }
    println!(
        "{folder}: {tried} inputs in {:.0?}, the slowest {longest:.0?}",
        began.elapsed()
    );
}

/// Up to four of: a byte set, a bit flipped, a stretch cut out, a stretch said twice, the end cut off, a number changed.
fn changed(mut bytes: Vec<u8>, rng: &mut ChaCha8Rng) -> Vec<u8> {
    for _ in 0..rng.random_range(1..=4) {
        if bytes.is_empty() {
            break;
        }
        let at = rng.random_range(0..bytes.len());
        let end = (at + rng.random_range(1..32)).min(bytes.len());
        match rng.random_range(0..6) {
            0 => bytes[at] = rng.random(),
            1 => bytes[at] ^= 1 << rng.random_range(0..8),
            2 => drop(bytes.drain(at..end)),
            3 => bytes.splice(at..at, bytes[at..end].to_vec()).for_each(drop),
            4 => bytes.truncate(at),
            _ => {
                let digits: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i].is_ascii_digit()).collect();
                if let Some(&digit) = digits.get(at % digits.len().max(1)) {
                    let odd: [&[u8]; 8] = [
                        b"0",
                        b"-1",
                        b"1e308",
                        b"1e-308",
                        b"nan",
                        b"9999999999999999999",
                        b"inf",
                        b"-0.0",
                    ];
                    bytes
                        .splice(digit..digit + 1, odd[rng.random_range(0..odd.len())].iter().copied())
                        .for_each(drop);
                }
            }
        }
    }
    bytes
}

#[test]
fn npy() {
    try_seeds("fuzz/seeds/npy", 200, targets::npy);
}

#[test]
fn config() {
    try_seeds("fuzz/seeds/config", 500, targets::config);
}

#[test]
fn calibration() {
    try_seeds("fuzz/seeds/calibration", 500, targets::calibration);
}

#[test]
fn scene() {
    try_seeds("fuzz/seeds/scene", 200, targets::scene);
}

#[test]
fn claims() {
    try_seeds("fuzz/seeds/claims", 1000, targets::claims);
}

#[test]
fn mavlink() {
    try_seeds("fuzz/seeds/mavlink", 3000, targets::mavlink);
}

#[test]
fn ulg() {
    try_seeds("fuzz/seeds/ulg", 1000, targets::ulg);
}

#[test]
fn terrain() {
    try_seeds("fuzz/seeds/terrain", 300, targets::terrain);
}

#[test]
fn v4l2() {
    try_seeds("fuzz/seeds/v4l2", 1000, targets::v4l2);
}

#[test]
fn locate() {
    try_seeds("fuzz/seeds/locate", 100, targets::locate);
}

#[test]
fn onnx() {
    try_seeds("config/models", 3, targets::onnx);
}

#[test]
fn http() {
    try_seeds("fuzz/seeds/http", 30, http::http);
}
