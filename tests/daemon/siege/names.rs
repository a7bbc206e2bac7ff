//! Floods of claims: what they cost a frame, and whether an eavesdropper who comes meanwhile is alerted.

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::Path;
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use serde_json::Value;

use super::super::process::{Daemon, alerts};
use super::{FLOOR_US, RATE_HZ, SAMPLE, number, status};

const LOG: &str = "claims.ndjson";
/// How long a flood lasts, and for how long it is calm before and after: the eavesdropper comes as often in each.
const PHASE: Duration = Duration::from_millis(21_100);
/// The eavesdropper comes every so often, for so long, the first time after so long, s.
const EVERY_S: f64 = 7.0;
const STAYS_S: f64 = 3.0;
const FIRST_S: f64 = 4.0;
/// Half of the view, m.
const HALF_VIEW_M: f64 = 120.0;

/// The built-in scene with an eavesdropper who comes often, and a log.
pub fn start(dir: &Path, rate_hz: f64) -> Daemon {
    let scene = include_str!("../../../config/scenes/builtin.toml");
    let scene = scene
        .replace("rate_hz = 10.0", &format!("rate_hz = {rate_hz:?}"))
        .replace(
            "integration_time_s = 0.1",
            &format!("integration_time_s = {:?}", 0.8 / rate_hz),
        )
        .replace(
            "from_s = 5, until_s = 13, every_s = 30",
            &format!(
                "from_s = {FIRST_S}, until_s = {}, every_s = {EVERY_S}",
                FIRST_S + STAYS_S
            ),
        );
    std::fs::write(dir.join("scene.toml"), scene).unwrap();
    let daemon = Daemon::start(
        dir,
        &format!("[source]\nkind = \"simulator\"\nscene = \"scene.toml\"\n[claims]\nlog = \"{LOG}\"\n"),
    );
    daemon.wait_until_up();
    daemon
}

/// Lines of the log: `names` claimed at `time`, by a running number.
pub fn lines(names: std::ops::Range<u64>, time: Timestamp, place: impl Fn(u64) -> [f64; 2]) -> String {
    let mut text = String::new();
    for k in names {
        let [x, y] = place(k);
        writeln!(
            text,
            "{{\"time\":\"{time}\",\"user\":\"invented-{k}\",\"x_m\":{x:.3},\"y_m\":{y:.3}}}"
        )
        .unwrap();
    }
    text
}

/// A place in view, as good as random.
pub fn anywhere(k: u64) -> [f64; 2] {
    let share = |m: u64| (k.wrapping_mul(m) >> 11) as f64 / (1u64 << 53) as f64;
    [share(0x9e37_79b9_7f4a_7c15), share(0xd1b5_4a32_d192_ed03)].map(|u| HALF_VIEW_M * (2.0 * u - 1.0))
}

/// A point of a 25 × 25 grid, 10 m apart.
fn carpet(k: u64) -> [f64; 2] {
    [(k % 25) as f64 * 10.0 - 120.0, (k / 25) as f64 * 10.0 - 120.0]
}

pub fn append(dir: &Path, text: &str) {
    let mut log = OpenOptions::new()
        .append(true)
        .create(true)
        .open(dir.join(LOG))
        .unwrap();
    log.write_all(text.as_bytes()).unwrap();
}

/// How long after each time the eavesdropper came on between two frames the alert was there, s: at once where the alert of the time before is
/// still open. `None` where there was none.
pub fn times_to_alert(daemon: &Daemon, rate_hz: f64, from_frame: u64, to_frame: u64) -> Vec<Option<f64>> {
    let (code, body) = daemon.get("/v1/alerts?kind=unclaimed_emitter&limit=500");
    assert_eq!(code, 200, "{body}");
    let list: Value = serde_json::from_str(&body).unwrap();
    let time = |alert: &Value, key: &str| alert[key].as_str()?.parse::<Timestamp>().ok();
    // From when to when each alert is open.
    let open: Vec<(f64, f64)> = alerts(&list)
        .iter()
        .filter_map(|alert| {
            let from_s = alert["source"]["frame"].as_u64()? as f64 / rate_hz;
            let raised_at = time(alert, "raised_at")?;
            let lasts_s =
                time(alert, "cleared_at").map_or(f64::INFINITY, |t| t.duration_since(raised_at).as_secs_f64());
            Some((from_s, from_s + lasts_s))
        })
        .collect();
    let (from_s, to_s) = (from_frame as f64 / rate_hz, to_frame as f64 / rate_hz);
    let came = (0..)
        .map(|k| FIRST_S + EVERY_S * f64::from(k))
        .take_while(|t| *t < to_s);
    came.filter(|t| *t >= from_s && t + STAYS_S < to_s)
        .map(|t| {
            let meanwhile = open.iter().filter(|(from, to)| *from < t + STAYS_S && *to > t);
            meanwhile.map(|(from, _)| (from - t).max(0.0)).min_by(f64::total_cmp)
        })
        .collect()
}

/// Latency of the frames between two looks.
struct Phase {
    median_us: Vec<u64>,
    p99_us: Vec<u64>,
    most_s: f64,
    captured: u64,
    dropped: u64,
    frames: [u64; 2],
}

impl Phase {
    /// Watches for `lasts`, while `act` is done over and over with the time since the beginning.
    fn watch(daemon: &Daemon, lasts: Duration, mut act: impl FnMut(Duration)) -> Self {
        let (before, buckets) = (status(daemon, None), Self::buckets(daemon));
        let first = Self::frame(daemon);
        let (mut median_us, mut p99_us) = (Vec::new(), Vec::new());
        let (began, mut sampled) = (Instant::now(), Instant::now());
        while began.elapsed() < lasts {
            act(began.elapsed());
            if sampled.elapsed() >= SAMPLE {
                sampled = Instant::now();
                let now = status(daemon, None);
                median_us.push(number(&now, "/latency/median_us"));
                p99_us.push(number(&now, "/latency/p99_us"));
            }
        }
        let after = status(daemon, None);
        let grown = |path| number(&after, path) - number(&before, path);
        let last = Self::buckets(daemon);
        let most = last.iter().zip(&buckets).rev().find(|(a, b)| a.1 > b.1);
        Self {
            median_us,
            p99_us,
            most_s: most.map_or(0.0, |(a, _)| a.0),
            captured: grown("/frames/captured"),
            dropped: grown("/frames/dropped"),
            frames: [first, Self::frame(daemon)],
        }
    }

    fn frame(daemon: &Daemon) -> u64 {
        let positions: Value = serde_json::from_str(&daemon.get("/v1/positions").1).unwrap();
        positions["frame"].as_u64().unwrap_or(0)
    }

    /// Upper edges of the histogram of latencies, s, with the frames in each.
    fn buckets(daemon: &Daemon) -> Vec<(f64, u64)> {
        let metrics = daemon.get("/metrics").1;
        let sums: Vec<(f64, u64)> = metrics
            .lines()
            .filter_map(|l| l.strip_prefix("oapwatch_frame_latency_seconds_bucket{le=\""))
            .filter_map(|l| {
                let (edge, count) = l.split_once("\"} ")?;
                Some((edge.parse().unwrap_or(f64::INFINITY), count.parse().ok()?))
            })
            .collect();
        let below = std::iter::once(0).chain(sums.iter().map(|(_, sum)| *sum));
        sums.iter()
            .zip(below)
            .map(|((edge, sum), below)| (*edge, sum - below))
            .collect()
    }

    fn median_p99(&self) -> u64 {
        let mut sorted = self.p99_us.clone();
        sorted.sort_unstable();
        sorted.get(sorted.len() / 2).copied().unwrap_or(0)
    }

    fn told(&self) -> String {
        format!(
            "median {:?} µs, p99 {:?} µs, most at most {} s; {} frames, {} given way",
            self.median_us, self.p99_us, self.most_s, self.captured, self.dropped
        )
    }
}

fn idle(_: Duration) {
    std::thread::sleep(Duration::from_millis(20));
}

/// Calm, flood, calm: prints all and asks for what must hold.
fn besiege(what: &str, dir: &Path, mut flood: impl FnMut(&Daemon, Duration)) {
    let daemon = start(dir, RATE_HZ);
    let before = Phase::watch(&daemon, PHASE, idle);
    let during = Phase::watch(&daemon, PHASE, |since| flood(&daemon, since));
    let after = Phase::watch(&daemon, PHASE, idle);
    let alerted = times_to_alert(&daemon, RATE_HZ, during.frames[0], during.frames[1]);
    let flooded = daemon
        .get("/v1/alerts?kind=claims_flooded")
        .1
        .contains("claims_flooded-");
    println!("{what}");
    for (name, phase) in [("before", &before), ("during", &during), ("after ", &after)] {
        println!("  {name} {}", phase.told());
    }
    println!(
        "  seconds from each coming of the eavesdropper to the alert {alerted:.2?}; claims_flooded {flooded}; resident {} MiB",
        daemon.resident_mib()
    );
    let quiet = before.median_p99().max(FLOOR_US);
    assert!(
        during.median_p99() < 2 * quiet,
        "{} µs against {quiet} µs",
        during.median_p99()
    );
    assert!(
        after.median_p99() < 2 * quiet,
        "{} µs against {quiet} µs",
        after.median_p99()
    );
    assert!(alerted.len() >= 2, "{alerted:?}");
    assert!(alerted.iter().all(|s| s.is_some_and(|s| s <= 1.0)), "{alerted:?}");
}

/// Acts once every `period` of a phase.
fn every(period: Duration, mut act: impl FnMut(&Daemon)) -> impl FnMut(&Daemon, Duration) {
    let mut due = Duration::ZERO;
    move |daemon, since| {
        if since >= due {
            due += period;
            act(daemon);
        } else {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_seven_hundred_new_names_every_tenth_of_a_second() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().to_owned();
    let mut next = 0;
    let flood = every(Duration::from_millis(100), move |_| {
        append(&path, &lines(next..next + 700, Timestamp::now(), anywhere));
        next += 700;
    });
    besiege("log: 700 new names every .1 s", dir.path(), flood);
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_twenty_thousand_names_in_each_post() {
    let dir = tempfile::tempdir().unwrap();
    let mut next = 0;
    let flood = every(Duration::from_secs(4), move |daemon| {
        let began = Instant::now();
        let (code, answer) = daemon.post("/v1/claims", &lines(next..next + 20_000, Timestamp::now(), anywhere));
        next += 20_000;
        let head: String = answer.chars().take(60).collect();
        println!("  POST of 20,000 names: {code} after {:.1?}: {head}", began.elapsed());
    });
    besiege("POST: 20,000 new names every 4 s", dir.path(), flood);
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_a_log_of_three_hundred_thousand_old_names() {
    let dir = tempfile::tempdir().unwrap();
    let mut log = File::create(dir.path().join(LOG)).unwrap();
    let now = Timestamp::now();
    for k in 0..300 {
        let time = now - SignedDuration::from_secs(3700 - 12 * k);
        let k = k as u64;
        log.write_all(lines(1000 * k..1000 * (k + 1), time, anywhere).as_bytes())
            .unwrap();
    }
    drop(log);
    let daemon = start(dir.path(), RATE_HZ);
    let began = Phase::watch(&daemon, PHASE, idle);
    let later = Phase::watch(&daemon, PHASE, idle);
    println!("start with 300,000 old names in the log");
    println!("  first 20 s {}\n  next 20 s  {}", began.told(), later.told());
    let alerted = times_to_alert(&daemon, RATE_HZ, 0, later.frames[1]);
    println!(
        "  seconds to the alert {alerted:.2?}; resident {} MiB",
        daemon.resident_mib()
    );
    let quiet = later.median_p99().max(FLOOR_US);
    assert!(
        began.median_p99() < 2 * quiet,
        "{} µs against {quiet} µs",
        began.median_p99()
    );
    assert!(began.most_s < 1.0, "{} s", began.most_s);
    assert!(alerted.iter().all(|s| s.is_some_and(|s| s <= 1.0)), "{alerted:?}");
}

fn accepted_in_view(names: u64) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().to_owned();
    let mut next = 0;
    // A tenth of them every .1 s: each name is claimed once a second.
    let flood = every(Duration::from_millis(100), move |_| {
        append(&path, &lines(next..next + names / 10, Timestamp::now(), anywhere));
        next = (next + names / 10) % names;
    });
    besiege(
        &format!("log: {names} names in view, claimed once a second"),
        dir.path(),
        flood,
    );
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_five_thousand_names_in_view() {
    accepted_in_view(5000);
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_twenty_thousand_names_in_view() {
    accepted_in_view(20_000);
}

#[test]
#[ignore = "a minute; make siege"]
fn siege_a_carpet_of_claims() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().to_owned();
    let flood = every(Duration::from_secs(1), move |_| {
        append(&path, &lines(0..625, Timestamp::now(), carpet));
    });
    besiege(
        "log: 625 names on a grid of 10 m, claimed once a second",
        dir.path(),
        flood,
    );
}
