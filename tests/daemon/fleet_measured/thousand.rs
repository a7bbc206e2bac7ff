//! A thousand access points that publish ten positions each ten times a second, and alerts meanwhile.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use async_nats::{Client, HeaderMap, jetstream};
use jiff::Timestamp;
use oapwatch::claim::Claim;
use oapwatch::fleet::Topic;
use oapwatch::fleet::message::{PositionsMessage, VERSION};
use oapwatch::monitor::{PositionStatus, StationName, TrackedPosition};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

use super::super::nats::{Server, hub};
use super::super::process::{Daemon, cpu_s};
use super::{load, number, quantile};

const RATE_HZ: f64 = 10.0;
const EMITTERS: usize = 10;
/// Connections to the server, which the stations share: the hub has one whatever they are.
const CONNECTIONS: usize = 20;
/// Alert events a second, of all stations together.
const ALERTS_HZ: f64 = 10.0;
/// Stands for the time in a prepared message.
const TIME: &str = "2000-01-01T00:00:00.000001Z";

fn name(k: usize) -> StationName {
    StationName {
        site: "harbour".to_owned(),
        station: format!("ap{k}"),
    }
}

/// A message of `EMITTERS` verified users, with [`TIME`] where the time belongs.
fn positions(k: usize) -> String {
    let time: Timestamp = TIME.parse().unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(k as u64);
    let origin = [400.0 * (k % 32) as f64, 400.0 * (k / 32) as f64];
    let place = |rng: &mut ChaCha8Rng| origin.map(|o| o + rng.random_range(-140.0..140.0));
    let (mut emitters, mut claims) = (Vec::new(), Vec::new());
    for e in 0..EMITTERS {
        let [x_m, y_m] = place(&mut rng);
        let user = format!("u-{k}-{e}");
        claims.push(Claim {
            sigma_m: Some(0.3),
            ..Claim::at(time, user.clone(), [x_m + 0.2, y_m - 0.1])
        });
        emitters.push(TrackedPosition {
            track: e as u64 + 1,
            x_m,
            y_m,
            z_m: 0.0,
            geodetic: None,
            cov_m2: [[4.123456789e-4, 1.0123456e-6], [1.0123456e-6, 4.23456789e-4]],
            energy_j: 0.00712345678,
            user: Some(user),
            status: PositionStatus::Verified,
            flags: Vec::new(),
            known_light: None,
            station: None,
        });
    }
    let footprint_m = (0..16).map(|i| {
        let angle = std::f64::consts::TAU * f64::from(i) / 16.0;
        [origin[0] + 150.0 * angle.cos(), origin[1] + 150.0 * angle.sin()]
    });
    let message = PositionsMessage {
        version: VERSION,
        name: name(k),
        time,
        frame: 1234,
        emitters,
        unseen: Vec::new(),
        claims,
        field_of_view_m: [150.0, 150.0],
        footprint_m: footprint_m.collect(),
    };
    serde_json::to_string(&message).unwrap()
}

fn now() -> String {
    Timestamp::now().strftime("%Y-%m-%dT%H:%M:%S.%6fZ").to_string()
}

/// Publishes as station `k`, `status` as its health, until `end`; gives how many positions.
async fn speak(client: Client, k: usize, status: Value, end: tokio::time::Instant) -> u64 {
    let body = positions(k);
    let subject = |topic: Topic| format!("oapwatch.harbour.ap{k}.{}", topic.name());
    let period = Duration::from_secs_f64(1.0 / RATE_HZ);
    let phase = period.mul_f64((k as f64 * 0.618).fract());
    let mut tick = tokio::time::interval_at(tokio::time::Instant::now() + phase, period);
    let mut sent = 0;
    while tick.tick().await < end {
        let message = body.replace(TIME, &now());
        client.publish(subject(Topic::Positions), message.into()).await.unwrap();
        if sent % RATE_HZ as u64 == 0 {
            let health = json!({
                "version": VERSION, "site": "harbour", "station": format!("ap{k}"), "time": now(), "status": status, "alerts_waiting": 0,
            });
            client
                .publish(subject(Topic::Health), health.to_string().into())
                .await
                .unwrap();
        }
        sent += 1;
    }
    sent
}

/// Publishes alerts of stations in turn; gives their ids at the hub.
async fn alarm(client: Client, stations: usize, end: tokio::time::Instant) -> BTreeSet<String> {
    let context = jetstream::new(client);
    let mut tick = tokio::time::interval(Duration::from_secs_f64(1.0 / ALERTS_HZ));
    let mut ids = BTreeSet::new();
    while tick.tick().await < end {
        let n = ids.len();
        let k = n * 7 % stations;
        let id = format!("unclaimed_emitter-{n}");
        let alert = json!({
            "version": VERSION, "site": "harbour", "station": format!("ap{k}"), "journal": "j", "seq": n + 1, "at": now(),
            "event": "alert.raised",
            "alert": {
                "id": id, "kind": "unclaimed_emitter", "severity": "critical", "state": "open", "raised_at": now(),
                "cleared_at": null, "user": null, "x_m": 1e4 + 50.0 * n as f64, "y_m": 0.0, "cov_m2": null, "claimed": null,
                "evidence": {}, "source": { "kind": "simulator", "frame": 0 },
            },
        });
        let mut headers = HeaderMap::new();
        headers.insert("Nats-Msg-Id", format!("msg_{n}"));
        let subject = format!("oapwatch.harbour.ap{k}.alert");
        let sent = context
            .publish_with_headers(subject, headers, alert.to_string().into())
            .await;
        sent.unwrap().await.unwrap();
        ids.insert(format!("harbour.ap{k}.{id}"));
    }
    ids
}

/// Sum of a metric's lines that hold all of `labels`.
fn metric(daemon: &Daemon, labels: &[&str]) -> u64 {
    let text = daemon.get("/metrics").1;
    let lines = text
        .lines()
        .filter(|l| l.starts_with("oapwatch_fleet_messages_total") && labels.iter().all(|label| l.contains(label)));
    lines.filter_map(|l| l.rsplit(' ').next()?.parse::<u64>().ok()).sum()
}

/// What the hub is like while it is spoken to.
#[derive(Default)]
struct Watched {
    resident_mib: Vec<u64>,
    lag_s: Vec<f64>,
}

fn watch(hub: &Daemon, seconds: u64) -> Watched {
    let mut watched = Watched::default();
    let end = Instant::now() + Duration::from_secs(seconds);
    while Instant::now() < end {
        std::thread::sleep(Duration::from_secs(3));
        watched.resident_mib.push(hub.resident_mib());
        let stations: Value = serde_json::from_str(&hub.get("/v1/stations").1).unwrap();
        let lags = stations["stations"]
            .as_array()
            .unwrap()
            .iter()
            .filter_map(|s| s["lag_s"].as_f64());
        watched.lag_s.extend(lags);
    }
    watched
}

#[test]
#[ignore = "minutes; make fleet-measured"]
fn a_thousand_access_points() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let (stations, seconds) = (number("STATIONS", 1000) as usize, number("SECONDS", 30));
    let hub = hub(dir.path(), server.port);
    hub.wait_for("/v1/alerts", "an answer", |v| v["alerts"].is_array());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let connect = || async { async_nats::connect(format!("127.0.0.1:{}", server.port)).await.unwrap() };
    let clients: Vec<Client> = (0..CONNECTIONS).map(|_| runtime.block_on(connect())).collect();
    let status: Value = {
        let station = super::super::nats::station(dir.path(), "real", "builtin", server.port);
        station.wait_for("/v1/status", "a status", |v| v["frames"]["captured"].as_u64() > Some(3))
    };
    let cpu = || [hub.cpu_s(), cpu_s(server.id()), cpu_s(std::process::id())];
    let (began, before, taken) = (Instant::now(), cpu(), metric(&hub, &["positions", "taken"]));
    let end = tokio::time::Instant::now() + Duration::from_secs(seconds);
    let speaking: Vec<_> = (0..stations)
        .map(|k| runtime.spawn(speak(clients[k % CONNECTIONS].clone(), k, status.clone(), end)))
        .collect();
    let alarming = runtime.spawn(alarm(clients[0].clone(), stations, end));
    let mut watched = watch(&hub, seconds - 2);
    let sent: u64 = speaking.into_iter().map(|s| runtime.block_on(s).unwrap()).sum();
    let wall = began.elapsed().as_secs_f64();
    let used = cpu();
    let raised = runtime.block_on(alarming).unwrap();

    let at_hub = || -> Vec<String> {
        let db = rusqlite::Connection::open_with_flags(
            dir.path().join("hub/journal.db"),
            rusqlite::OpenFlags::SQLITE_OPEN_READ_ONLY,
        )
        .unwrap();
        let mut rows = db
            .prepare("SELECT alert FROM event WHERE alert LIKE 'harbour.ap%.unclaimed%'")
            .unwrap();
        rows.query_map([], |row| row.get(0))
            .unwrap()
            .map(Result::unwrap)
            .collect()
    };
    let until = Instant::now() + Duration::from_secs(20);
    while at_hub().len() < raised.len() && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(100));
    }
    let taken = metric(&hub, &["positions", "taken"]) - taken;
    let cores = |k: usize| (used[k] - before[k]) / wall;
    println!(
        "{stations} stations, {RATE_HZ} Hz, {EMITTERS} emitters, {:.1} kB a message, {wall:.0} s, load {}\n\
         positions: {:.0}/s sent, {:.1} % taken; outcomes {:?}\n\
         cores: hub {:.2}, server {:.2}, generator {:.2}\n\
         hub's memory: {} MiB at most, {:?} at the end\n\
         positions' age when taken: median {:.3} s, p99 {:.3} s\n\
         alerts: {} of {} in the hub's journal, once each",
        positions(0).len() as f64 / 1e3,
        load(),
        sent as f64 / wall,
        100.0 * taken as f64 / sent as f64,
        ["replaced", "dropped", "late", "too_many_stations"].map(|o| (o, metric(&hub, &[o]))),
        cores(0),
        cores(1),
        cores(2),
        watched.resident_mib.iter().max().unwrap(),
        &watched.resident_mib[watched.resident_mib.len().saturating_sub(3)..],
        quantile(&mut watched.lag_s, 0.5),
        quantile(&mut watched.lag_s, 0.99),
        at_hub().len(),
        raised.len(),
    );
    let found = at_hub();
    assert_eq!(found.len(), raised.len(), "lost or doubled");
    assert_eq!(found.into_iter().collect::<BTreeSet<_>>(), raised);
}
