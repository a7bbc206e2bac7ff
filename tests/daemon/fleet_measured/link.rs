//! What a station's frames take while the server is there, gone, hanging and full.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use async_nats::jetstream::{self, stream};
use serde_json::Value;

use super::super::nats::{Server, station_of};
use super::super::process::Daemon;
use super::{QUIET, load, number, quantile, standing_alert};

const RATE_HZ: f64 = 40.0;
const SAMPLE: Duration = Duration::from_millis(3600);
/// Between two looks at the newest frame's latency: each frame is seen.
const LOOK: Duration = Duration::from_millis(8);
/// Bytes that the full server's stream holds.
const ROOM: i64 = 64 << 10;

#[derive(Clone, Copy, PartialEq)]
enum Link {
    Good,
    Gone,
    Hanging,
    Full,
    /// As the first: what differs from it is the machine's doing.
    GoodAgain,
}

const LINKS: [(Link, &str); 5] = [
    (Link::Good, "there"),
    (Link::Gone, "gone"),
    (Link::Hanging, "hanging"),
    (Link::Full, "full"),
    (Link::GoodAgain, "there, again"),
];

/// Frames under one state of the server.
#[derive(Default)]
struct Frames {
    latencies_us: Vec<f64>,
    cpu_s: f64,
}

impl Frames {
    fn sample(&mut self, station: &Daemon) {
        let (cpu_s, until) = (station.cpu_s(), Instant::now() + SAMPLE);
        let mut last = None;
        while Instant::now() < until {
            let status: Value = serde_json::from_str(&station.get("/v1/status").1).unwrap();
            let captured = status["frames"]["captured"].as_u64();
            if last != captured {
                last = captured;
                self.latencies_us.push(status["latency"]["last_us"].as_f64().unwrap());
            }
            std::thread::sleep(LOOK);
        }
        self.cpu_s += station.cpu_s() - cpu_s;
    }

    /// Median and 99th percentile, µs, and the time on a processor that a frame took with all else that the station does, µs.
    fn figures(&mut self) -> [f64; 3] {
        let cpu_us = 1e6 * self.cpu_s / self.latencies_us.len() as f64;
        [
            quantile(&mut self.latencies_us, 0.5),
            quantile(&mut self.latencies_us, 0.99),
            cpu_us,
        ]
    }
}

/// The stream with room for little, filled to the brim or empty.
fn fill(port: u16, is_full: bool) {
    let work = async {
        let client = async_nats::connect(format!("127.0.0.1:{port}")).await.unwrap();
        let context = jetstream::new(client);
        let config = stream::Config {
            name: "OAPWATCH".to_owned(),
            subjects: vec!["oapwatch.*.*.alert".to_owned()],
            max_bytes: ROOM,
            discard: stream::DiscardPolicy::New,
            ..stream::Config::default()
        };
        let stream = context.get_or_create_stream(config).await.unwrap();
        stream.purge().await.unwrap();
        let mut has_room = is_full;
        while has_room {
            let sent = context
                .publish("oapwatch.harbour.ap0.alert", vec![b'x'; 512].into())
                .await
                .unwrap();
            has_room = sent.await.is_ok();
        }
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(work);
}

#[test]
#[ignore = "minutes; make fleet-measured"]
fn a_frame_s_latency_whatever_the_server_does() {
    let dir = tempfile::tempdir().unwrap();
    let Some(mut server) = Server::start(dir.path(), None) else {
        return;
    };
    let scene = include_str!("../../../config/scenes/builtin.toml");
    let scene = scene.replace("rate_hz = 10.0", &format!("rate_hz = {RATE_HZ:?}"));
    let scene = scene.replace(
        "integration_time_s = 0.1",
        &format!("integration_time_s = {:?}", 0.8 / RATE_HZ),
    );
    let file = dir.path().join("scene.toml");
    std::fs::write(&file, scene).unwrap();
    fill(server.port, false);
    let more = format!("positions_hz = {RATE_HZ:?}\n{QUIET}");
    let station = station_of(dir.path(), "ap7", &file, server.port, &more);
    let id = standing_alert(&station);
    let is_over = AtomicBool::new(false);
    let mut frames: [Frames; 5] = Default::default();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let path = format!("/v1/alerts/{id}/acknowledge");
            for method in ["POST", "DELETE"].iter().cycle() {
                if is_over.load(Ordering::Relaxed) {
                    break;
                }
                let _ = station.ask(method, &path);
                std::thread::sleep(Duration::from_millis(200));
            }
        });
        for _ in 0..number("ROUNDS", 6) {
            for ((link, _), frames) in LINKS.into_iter().zip(&mut frames) {
                match link {
                    Link::Good | Link::GoodAgain => {}
                    Link::Gone => server.end(),
                    Link::Hanging => server.signal("-STOP"),
                    Link::Full => fill(server.port, true),
                }
                frames.sample(&station);
                match link {
                    Link::Good | Link::GoodAgain => {}
                    Link::Gone => server = Server::start(dir.path(), Some(server.port)).unwrap(),
                    Link::Hanging => server.signal("-CONT"),
                    Link::Full => fill(server.port, false),
                }
            }
        }
        is_over.store(true, Ordering::Relaxed);
    });
    println!(
        "| server, load {} | frames | median, µs | p99, µs | processor, µs a frame | ratio of medians | of p99 | of processor time |\n|---|---|---|---|---|---|---|---|",
        load()
    );
    let there = frames[0].figures();
    for ((_, name), frames) in LINKS.into_iter().zip(&mut frames) {
        let [a, b, c] = frames.figures();
        let count = frames.latencies_us.len();
        let [x, y, z] = [a / there[0], b / there[1], c / there[2]];
        println!("| {name} | {count} | {a:.0} | {b:.0} | {c:.0} | {x:.2} | {y:.2} | {z:.2} |");
    }
}
