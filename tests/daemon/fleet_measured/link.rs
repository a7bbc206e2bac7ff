//! What a station's frames take while the server is there, gone, hanging and full.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_nats::jetstream::{self, stream};
use serde_json::Value;

use super::super::nats::{Server, station_of};
use super::super::process::Daemon;
use super::{QUIET, load, number, quantile, standing_alert};

const RATE_HZ: f64 = 40.0;
/// The status has the latency of the newest 128 frames.
const SAMPLE: Duration = Duration::from_millis(3600);
/// Bytes that the full server's stream holds.
const ROOM: i64 = 64 << 10;

#[derive(Clone, Copy, PartialEq)]
enum Link {
    Good,
    Gone,
    Hanging,
    Full,
}

/// Median and 99th percentile of a sample's frames, µs, and the time on a processor that each frame took, µs.
fn sample(station: &Daemon) -> [f64; 3] {
    let status = || -> Value { serde_json::from_str(&station.get("/v1/status").1).unwrap() };
    let frames = |status: &Value| status["frames"]["captured"].as_f64().unwrap();
    let (before, cpu) = (status(), station.cpu_s());
    std::thread::sleep(SAMPLE);
    let after = status();
    let cost = 1e6 * (station.cpu_s() - cpu) / (frames(&after) - frames(&before));
    let of = |name: &str| after["latency"][name].as_f64().unwrap();
    [of("median_us"), of("p99_us"), cost]
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
    let links = [Link::Good, Link::Gone, Link::Hanging, Link::Full];
    let mut samples: [Vec<[f64; 3]>; 4] = Default::default();
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
            for (k, link) in links.into_iter().enumerate() {
                match link {
                    Link::Good => {}
                    Link::Gone => server.end(),
                    Link::Hanging => server.signal("-STOP"),
                    Link::Full => fill(server.port, true),
                }
                samples[k].push(sample(&station));
                match link {
                    Link::Good => {}
                    Link::Gone => server = Server::start(dir.path(), Some(server.port)).unwrap(),
                    Link::Hanging => server.signal("-CONT"),
                    Link::Full => fill(server.port, false),
                }
            }
        }
        is_over.store(true, Ordering::Relaxed);
    });
    println!(
        "| server, load {} | median, µs | p99, µs | processor, µs a frame | ratio of medians | of p99 | of processor time |\n|---|---|---|---|---|---|---|",
        load()
    );
    let median = |k: usize, what: usize| quantile(&mut samples[k].iter().map(|s| s[what]).collect::<Vec<_>>(), 0.5);
    for (k, name) in ["there", "gone", "hanging", "full"].iter().enumerate() {
        let [a, b, c] = [0, 1, 2].map(|what| median(k, what));
        let [x, y, z] = [0, 1, 2].map(|what| median(k, what) / median(0, what));
        println!("| {name} | {a:.0} | {b:.0} | {c:.0} | {x:.2} | {y:.2} | {z:.2} |");
    }
}
