//! The telemetry link against another implementation of MAVLink (pymavlink), and against what a network can send.

use std::net::UdpSocket;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use oapwatch::platform::Origin;
use oapwatch::platform::mavlink::{Endpoint, Event, Kind, Link, Moment, Refusal, Relation, Sample, Settings, Signing};
use oapwatch::pose::PoseSigmas;
use serde_json::Value;

const KEY: &str = "00112233445566778899aabbccddeeff0123456789abcdef0123456789abcdef";

struct Listener {
    port: u16,
    told: mpsc::Receiver<(Event, Moment, Relation)>,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Listener {
    fn start(key: Option<&str>) -> Self {
        let link = Link::open(Settings {
            endpoint: "udpin:127.0.0.1:0".parse::<Endpoint>().unwrap(),
            system_id: None,
            signing: key.map(|digits| Signing::new(bytes(digits))),
            sigmas: PoseSigmas::default(),
            request_hz: None,
        });
        let link = link.unwrap();
        let port = link.local_addr().unwrap().port();
        let (sender, told) = mpsc::channel();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = link.start(stop.clone(), move |event, moment, reader| {
            let _ = sender.send((event, moment, reader.relation(moment.now_ns)));
        });
        Self {
            port,
            told,
            stop,
            thread: Some(thread.unwrap()),
        }
    }

    fn end(mut self) -> Vec<(Event, Moment, Relation)> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        self.told.try_iter().collect()
    }
}

fn bytes(digits: &str) -> [u8; 32] {
    std::array::from_fn(|k| u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).unwrap())
}

/// The Python that has pymavlink: `make setup-test` puts it there. `None`, with a word, where it is missing.
fn python() -> Option<PathBuf> {
    let python = std::env::var_os("OAPWATCH_PYMAVLINK").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("target/pymavlink/bin/python"),
        PathBuf::from,
    );
    if python.exists() {
        return Some(python);
    }
    assert!(
        std::env::var_os("CI").is_none(),
        "pymavlink is missing (make setup-test installs it)"
    );
    eprintln!("skipped: pymavlink is missing (make setup-test installs it)");
    None
}

/// What an autopilot of another make sent, and what was told of it.
fn play(
    kind: &str,
    count: usize,
    key: Option<&str>,
    sender_key: Option<&str>,
) -> Option<(Vec<Value>, Vec<(Event, Moment, Relation)>)> {
    let python = python()?;
    let listener = Listener::start(key);
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/platform/sender.py");
    let mut command = Command::new(python);
    command
        .arg(script)
        .args([listener.port.to_string(), kind.to_owned(), count.to_string()])
        .args(sender_key);
    let output = command.stderr(Stdio::inherit()).output().unwrap();
    assert!(output.status.success());
    let sent = String::from_utf8(output.stdout).unwrap();
    let sent = sent.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    Some((sent, listener.end()))
}

fn poses(told: &[(Event, Moment, Relation)]) -> Vec<(&Sample, Moment)> {
    let poses = told.iter().filter_map(|(event, moment, _)| match event {
        Event::Pose(sample) => Some((&**sample, *moment)),
        _ => None,
    });
    poses.collect()
}

fn refusals(told: &[(Event, Moment, Relation)]) -> Vec<Refusal> {
    let refused = told.iter().filter_map(|(event, ..)| match event {
        Event::Refused(why) => Some(*why),
        _ => None,
    });
    refused.collect()
}

/// Unix seconds of a sample.
fn unix_s(sample: &Sample, moment: Moment) -> f64 {
    (moment.unix_ns - moment.now_ns + sample.time_ns) as f64 * 1e-9
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

fn same_attitude(sample: &Sample, q: &Value) -> bool {
    let q = numbers(q);
    let found = sample.attitude.quaternion();
    let dot = found.w * q[0] + found.i * q[1] + found.j * q[2] + found.k * q[3];
    // Single precision on the way.
    (dot.abs() - 1.0).abs() < 1e-6
}

#[test]
fn odometry_of_another_implementation_is_read_exactly() {
    let Some((sent, told)) = play("odometry", 60, None, None) else {
        return;
    };
    let poses = poses(&told);
    assert_eq!(poses.len(), 60, "{:?}", refusals(&told));
    for ((sample, moment), sent) in poses.iter().zip(&sent) {
        assert_eq!(sample.kind, Kind::Odometry);
        assert!(same_attitude(sample, &sent["q"]), "{sample:?} {sent}");
        let ned = numbers(&sent["ned"]);
        let enu = sample.place.enu_m;
        let apart = [enu[0] - ned[1], enu[1] - ned[0], enu[2] + ned[2]];
        assert!(apart.iter().all(|d| d.abs() < 1e-4), "{apart:?}");
        let Origin::Start(origin) = sample.place.origin else {
            panic!("GPS_GLOBAL_ORIGIN was sent");
        };
        assert_eq!(
            [origin.latitude_deg, origin.longitude_deg, origin.sea_level_m],
            [48.137, 11.575, 520.0]
        );
        let variances: Vec<f64> = (3..6).map(|k| sample.cov[(k, k)]).collect();
        for (found, expected) in variances.iter().zip([0.36, 0.25, 0.49]) {
            assert!((found - expected).abs() < 1e-6, "{variances:?}: east, north, up");
        }
        assert!((sample.cov.fixed_view::<3, 3>(0, 0).trace() - 1.2e-4).abs() < 1e-9);
        assert!((unix_s(sample, *moment) - sent["unix_s"].as_f64().unwrap()).abs() < 0.02);
    }
    // Once the clocks have been compared, times are exact: the loopback's way takes microseconds, a busy machine's more.
    let (_, _, last) = told.last().unwrap();
    assert!(
        matches!(last, Relation::Exchange { error_s } if *error_s < 5e-3),
        "{last:?}"
    );
    let (sample, moment) = poses[59];
    assert!((unix_s(sample, moment) - sent[59]["unix_s"].as_f64().unwrap()).abs() < 5e-3);
    assert!(sent[60]["answers"].as_u64().unwrap() > 5);
}

#[test]
fn attitude_and_position_of_both_versions_are_read() {
    for (kind, undulation, sigma) in [("attitude", Some(48.0), [1.2, 1.9]), ("mavlink1", None, [2.0, 2.0])] {
        let Some((sent, told)) = play(kind, 40, None, None) else {
            return;
        };
        let poses = poses(&told);
        assert_eq!(poses.len(), 40, "{:?}", refusals(&told));
        for (k, ((sample, _), sent)) in poses.iter().zip(&sent).enumerate() {
            assert_eq!(sample.kind, Kind::AttitudeQuaternion);
            assert!(same_attitude(sample, &sent["q"]));
            let Origin::Passing(origin) = sample.place.origin else {
                panic!("{sample:?}");
            };
            assert!((origin.latitude_deg - 48.137 - 1e-5 * k as f64).abs() < 1e-9);
            assert!((origin.longitude_deg - 11.575 + 5e-6 * k as f64).abs() < 1e-9);
            assert!((origin.sea_level_m - 520.0 - 0.01 * k as f64).abs() < 1e-6);
            assert_eq!(sample.place.enu_m, [0.0; 3]);
            assert_eq!(sample.place.undulation_m, undulation);
            let found = [3, 5].map(|k: usize| sample.cov[(k, k)].sqrt());
            assert!(
                (found[0] - sigma[0]).abs() < 1e-9 && (found[1] - sigma[1]).abs() < 1e-9,
                "{found:?}"
            );
        }
    }
}

#[test]
fn only_frames_signed_with_the_key_are_taken() {
    let Some((sent, told)) = play("odometry", 30, Some(KEY), Some(KEY)) else {
        return;
    };
    assert_eq!(poses(&told).len(), 30, "{:?}", refusals(&told));
    assert!(
        sent[30]["answers"].as_u64().unwrap() > 2,
        "pymavlink takes our signature"
    );
    let (_, told) = play("odometry", 10, Some(KEY), None).unwrap();
    assert!(poses(&told).is_empty() && refusals(&told).contains(&Refusal::Unsigned));
    let other = KEY.replace('0', "1");
    let (_, told) = play("odometry", 10, Some(KEY), Some(&other)).unwrap();
    assert!(poses(&told).is_empty() && refusals(&told).contains(&Refusal::Signature));
}

/// A heartbeat of system 7, and one ODOMETRY, as pymavlink wrote them.
fn recorded() -> (Vec<u8>, Vec<u8>) {
    let hex = |text: &str| -> Vec<u8> {
        (0..text.len() / 2)
            .map(|k| u8::from_str_radix(&text[2 * k..2 * k + 2], 16).unwrap())
            .collect()
    };
    (
        hex(include_str!("heartbeat.hex").trim()),
        hex(include_str!("odometry.hex").trim()),
    )
}

#[test]
fn a_flood_costs_little_and_stops_nothing() {
    let listener = Listener::start(None);
    let (heartbeat, odometry) = recorded();
    let flood = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = ("127.0.0.1", listener.port);
    let mut other = heartbeat.clone();
    other[5] = 9;
    let began = Instant::now();
    let mut cpu = cpu_of_link();
    while began.elapsed() < Duration::from_secs(1) {
        for _ in 0..100 {
            let _ = flood.send_to(&other, to);
            let _ = flood.send_to(&[0xfd; 300], to);
        }
    }
    cpu = cpu_of_link() - cpu;
    assert!(cpu < 0.3, "the link's thread took {cpu} s in a second of flood");
    // The autopilot is heard all the same.
    let autopilot = UdpSocket::bind("127.0.0.1:0").unwrap();
    let patience = Instant::now();
    loop {
        let _ = autopilot.send_to(&heartbeat, to);
        let _ = autopilot.send_to(&odometry, to);
        let mut heard = std::iter::from_fn(|| listener.told.recv_timeout(Duration::from_millis(20)).ok());
        if heard.any(|(event, ..)| matches!(event, Event::Pose(_))) {
            break;
        }
        assert!(patience.elapsed() < Duration::from_secs(20), "no pose");
    }
    // From now on the kernel drops what others send.
    listener.told.try_iter().for_each(drop);
    (0..100).for_each(|_| drop(flood.send_to(&other, to)));
    let _ = autopilot.send_to(&heartbeat[..5], to);
    let mut heard = std::iter::from_fn(|| listener.told.recv_timeout(Duration::from_secs(10)).ok());
    let refused = heard.find(|(event, ..)| matches!(event, Event::Refused(_)));
    assert_eq!(refused.expect("the autopilot's").0, Event::Refused(Refusal::Malformed));
    listener.end();
}

/// Seconds of CPU that threads called "mavlink" of this process have used.
fn cpu_of_link() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap().flatten();
    let ticks = tasks.filter_map(|task| {
        let stat = std::fs::read_to_string(task.path().join("stat")).ok()?;
        let (name, rest) = stat.split_once('(')?.1.split_once(") ")?;
        let fields: Vec<&str> = rest.split(' ').collect();
        (name == "mavlink").then(|| fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap())
    });
    // The kernel counts a hundredth of a second a tick.
    ticks.sum::<f64>() / 100.0
}
