//! What a hostile network does to the monitor: floods of requests and of claims, clients without end. Takes minutes and wants a machine to itself, so none of it is run by default:
//! `make siege`. `OAPWATCH_SIEGE_SECONDS` is how long each storm lasts, a minute unless set.

mod flood;
pub mod names;
mod slow;
mod viewers;

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use flood::{Count, connect, flood};
use futures_util::StreamExt;
use serde_json::Value;
use tokio::runtime::Runtime;

use super::process::Daemon;

const RATE_HZ: f64 = 40.0;
/// The status tells the latency of the newest 128 frames: each sample is of frames of its own.
const SAMPLE: Duration = Duration::from_millis(3500);
const CALM_SAMPLES: usize = 6;
/// The machine's other work shows in every latency; below a millisecond it is all that shows.
const FLOOR_US: u64 = 1000;

fn seconds() -> Duration {
    let set = std::env::var("OAPWATCH_SIEGE_SECONDS")
        .ok()
        .and_then(|s| s.parse().ok());
    Duration::from_secs(set.unwrap_or(60))
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap()
}

/// The built-in scene at `rate_hz`.
fn start(dir: &Path, rate_hz: f64, more: &str) -> Daemon {
    let scene = include_str!("../../../config/scenes/builtin.toml");
    let scene = scene.replace("rate_hz = 10.0", &format!("rate_hz = {rate_hz:?}"));
    let scene = scene.replace(
        "integration_time_s = 0.1",
        &format!("integration_time_s = {:?}", 0.8 / rate_hz),
    );
    std::fs::write(dir.join("scene.toml"), scene).unwrap();
    let daemon = Daemon::start(
        dir,
        &format!("[source]\nkind = \"simulator\"\nscene = \"scene.toml\"\n{more}"),
    );
    daemon.wait_until_up();
    daemon
}

fn address(daemon: &Daemon) -> SocketAddr {
    daemon.address().parse().unwrap()
}

fn status(daemon: &Daemon, token: Option<&str>) -> Value {
    let (code, body) = daemon.get_as("/v1/status", token);
    assert_eq!(code, 200, "{body}");
    serde_json::from_str(&body).unwrap()
}

fn number(value: &Value, path: &str) -> u64 {
    value
        .pointer(path)
        .and_then(Value::as_u64)
        .unwrap_or_else(|| panic!("{path} in {value}"))
}

/// 99th percentiles of the frames' latency, µs, one a sample, their median, and the frames seen and dropped meanwhile.
struct Latency {
    p99_us: Vec<u64>,
    captured: u64,
    dropped: u64,
}

impl Latency {
    fn watch(daemon: &Daemon, token: Option<&str>, samples: usize) -> Self {
        let before = status(daemon, token);
        let mut last = before.clone();
        let p99_us = (0..samples)
            .map(|_| {
                std::thread::sleep(SAMPLE);
                last = status(daemon, token);
                number(&last, "/latency/p99_us")
            })
            .collect();
        let grown = |path| number(&last, path) - number(&before, path);
        Self {
            p99_us,
            captured: grown("/frames/captured"),
            dropped: grown("/frames/dropped"),
        }
    }

    fn told(&self) -> String {
        format!(
            "{:?}; {} frames, {} given way to newer ones",
            self.p99_us, self.captured, self.dropped
        )
    }

    fn median(&self) -> u64 {
        let mut sorted = self.p99_us.clone();
        sorted.sort_unstable();
        sorted[sorted.len() / 2]
    }
}

/// Watches calm, storm and calm again; prints all three and gives the calm and the storm.
fn compare(what: &str, daemon: &Daemon, token: Option<&str>, storm: impl FnOnce() -> Box<dyn FnOnce()>) -> [u64; 2] {
    let before = Latency::watch(daemon, token, CALM_SAMPLES);
    let end = storm();
    let samples = (seconds().as_secs_f64() / SAMPLE.as_secs_f64()).ceil() as usize;
    let during = Latency::watch(daemon, token, samples.max(1));
    end();
    let after = Latency::watch(daemon, token, CALM_SAMPLES);
    let [b, d, a] = [&before, &during, &after].map(Latency::told);
    println!("{what}: p99 in µs by {SAMPLE:?}\n  before {b}\n  during {d}\n  after  {a}");
    let calm = Latency {
        p99_us: before.p99_us.iter().chain(&after.p99_us).copied().collect(),
        ..before
    };
    let medians = [calm.median(), during.median()];
    println!(
        "  median p99: {} µs in calm, {} µs in the storm; resident {} MiB",
        medians[0],
        medians[1],
        daemon.resident_mib()
    );
    medians
}

/// Ten thousand requests a second in the background until the returned function is called.
fn besiege(
    runtime: &Arc<Runtime>,
    daemon: &Daemon,
    per_second: u32,
    count: &Arc<Count>,
    request: impl Fn(u64) -> String + Clone + Send + Sync + 'static,
) -> Box<dyn FnOnce()> {
    let stop = Arc::new(AtomicBool::new(false));
    let storm = runtime.spawn(flood(address(daemon), per_second, stop.clone(), count.clone(), request));
    let (runtime, count, began) = (runtime.clone(), count.clone(), Instant::now());
    Box::new(move || {
        let took = began.elapsed().as_secs_f64();
        let rates = [count.sent.load(Ordering::Relaxed), count.total()].map(|n| n as f64 / took);
        stop.store(true, Ordering::Relaxed);
        runtime.block_on(storm).unwrap();
        println!(
            "{count:?}: {:.0} sent and {:.0} answered a second over {took:.0} s",
            rates[0], rates[1]
        );
    })
}

fn positions(_: u64) -> String {
    "GET /v1/positions HTTP/1.1\r\nhost: localhost\r\n\r\n".to_owned()
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_ten_thousand_requests_a_second_from_one_address() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = start(dir.path(), RATE_HZ, "");
    let (runtime, count) = (Arc::new(runtime()), Arc::new(Count::default()));
    let storm = || besiege(&runtime, &daemon, 10_000, &count, positions);
    let [calm, storm] = compare("10,000 requests/s, as configured", &daemon, None, storm);
    assert!(count.of(3) > count.of(0), "most are refused: {count:?}");
    assert_eq!(count.of(4), 0);
    assert!(storm < 2 * calm.max(FLOOR_US), "{storm} µs against {calm} µs");
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_ten_thousand_requests_a_second_all_answered() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = start(dir.path(), RATE_HZ, "[api]\nrequests_per_second = 1000000\n");
    let (runtime, count) = (Arc::new(runtime()), Arc::new(Count::default()));
    let storm = || besiege(&runtime, &daemon, 10_000, &count, positions);
    let [calm, storm] = compare("10,000 requests/s, without a limit", &daemon, None, storm);
    assert!(count.of(0) > 0 && count.of(4) == 0, "{count:?}");
    assert!(storm < 2 * calm.max(FLOOR_US), "{storm} µs against {calm} µs");
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_a_million_wrong_tokens() {
    const TOKEN: &str = "0123456789abcdef0123456789abcdef0123456789abcdef";
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("token"), TOKEN).unwrap();
    let daemon = start(
        dir.path(),
        RATE_HZ,
        "[api]\ntoken_file = \"token\"\nrequests_per_second = 1000000\n",
    );
    let (runtime, count) = (Arc::new(runtime()), Arc::new(Count::default()));
    let wrong = |k: u64| {
        let guess = k.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        format!("GET /v1/status HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {guess:048x}\r\n\r\n")
    };
    let storm = || besiege(&runtime, &daemon, 20_000, &count, wrong);
    let [calm, storm] = compare("wrong tokens, without a limit", &daemon, Some(TOKEN), storm);
    assert_eq!(count.total(), count.of(2), "each is refused: {count:?}");
    assert!(storm < 2 * calm.max(FLOOR_US), "{storm} µs against {calm} µs");
}

#[test]
#[ignore = "minutes; make siege"]
fn siege_a_thousand_streams_of_which_half_never_read() {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let dir = tempfile::tempdir().unwrap();
    let daemon = start(dir.path(), 10.0, "");
    let runtime = runtime();
    let to = address(&daemon);
    let resident = daemon.resident_mib();
    let (alarms, messages) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let stop = Arc::new(AtomicBool::new(false));
    let mut idle = Vec::new();
    let mut readers = Vec::new();
    for k in 0..1000u32 {
        // A hundred from each of ten addresses, no faster than the limit on requests lets them.
        std::thread::sleep(Duration::from_millis(2));
        let (mut socket, _) = runtime.block_on(async {
            let stream = connect((2 + k / 100) as u8, to).await.unwrap();
            tokio_tungstenite::client_async(format!("ws://{to}/v1/stream"), stream)
                .await
                .unwrap()
        });
        if k % 2 == 0 {
            idle.push(socket);
            continue;
        }
        let (alarms, messages, stop) = (alarms.clone(), messages.clone(), stop.clone());
        readers.push(runtime.spawn(async move {
            let mut told = false;
            while !stop.load(Ordering::Relaxed) {
                match tokio::time::timeout(Duration::from_millis(500), socket.next()).await {
                    Ok(Some(Ok(message))) => {
                        messages.fetch_add(1, Ordering::Relaxed);
                        let text = message.to_text().unwrap_or_default();
                        if !told && text.contains("\"type\":\"alert\"") && text.contains("alert.raised") {
                            told = true;
                            alarms.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                    Ok(_) => return false,
                    Err(_) => {}
                }
            }
            true
        }));
    }
    let connected = daemon.resident_mib();
    let during = Latency::watch(
        &daemon,
        None,
        (seconds().as_secs_f64() / SAMPLE.as_secs_f64()).ceil() as usize,
    );
    let metrics = daemon.get("/metrics").1;
    let streams = metrics.lines().find(|l| l.starts_with("oapwatch_stream_clients"));
    let missed = metrics
        .lines()
        .find(|l| l.starts_with("oapwatch_stream_positions_missed_total"));
    stop.store(true, Ordering::Relaxed);
    let alive = readers
        .into_iter()
        .map(|r| runtime.block_on(r).unwrap())
        .filter(|a| *a)
        .count();
    println!(
        "1,000 streams at 10 frames/s: p99 in µs {}\n  {} messages to 500 readers, {alive} of them still connected, {} told of the alert; {streams:?}; {missed:?}\n  \
         resident {resident} MiB before, {connected} MiB connected, {} MiB after",
        during.told(),
        messages.load(Ordering::Relaxed),
        alarms.load(Ordering::Relaxed),
        daemon.resident_mib()
    );
    assert_eq!(alive, 500);
    assert_eq!(alarms.load(Ordering::Relaxed), 500);
    // 128 KiB of send buffer each are the kernel's; ours is a task and a margin of messages.
    assert!(daemon.resident_mib() < resident + 200);
    drop(idle);
}
