//! A cut of the link and kills of everybody, while a station's alerts flow.

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use super::super::journals::{agree, events};
use super::super::nats::{Server, hub, station_of};
use super::super::process::{Daemon, alerts};
use super::{QUIET, load, number, scene};

fn station(dir: &Path, port: u16) -> Daemon {
    station_of(dir, "ap7", &scene(dir), port, QUIET)
}

/// Acknowledges an alert that stands and withdraws that, again and again: each is an event of its own, and goes the way of all alerts.
fn acknowledge(station: &Mutex<Option<Daemon>>, pause: Duration, done: &AtomicU64, is_over: &AtomicBool) {
    let ask = |method: &str, path: &str| station.lock().unwrap().as_ref()?.ask(method, path);
    while !is_over.load(Ordering::Relaxed) {
        let list = ask("GET", "/v1/alerts").and_then(|(_, body)| serde_json::from_str::<Value>(&body).ok());
        let is_open = |alert: &&Value| alert["state"] != "cleared";
        let standing = list
            .as_ref()
            .and_then(|list| alerts(list).iter().find(is_open)?["id"].as_str());
        let Some(path) = standing.map(|id| format!("/v1/alerts/{id}/acknowledge")) else {
            std::thread::sleep(Duration::from_millis(20));
            continue;
        };
        for method in ["POST", "DELETE"] {
            if let Some((200, _)) = ask(method, &path) {
                done.fetch_add(1, Ordering::Relaxed);
            }
            std::thread::sleep(pause);
        }
    }
}

#[test]
#[ignore = "minutes; make fleet-measured"]
fn a_cut_and_its_backlog() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let seconds = number("SECONDS", 60);
    let port = server.port;
    let hub = hub(dir.path(), port);
    let station = Mutex::new(Some(station(dir.path(), port)));
    hub.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    let (done, is_over) = (AtomicU64::new(0), AtomicBool::new(false));
    let (backlog, recovered) = std::thread::scope(|scope| {
        let (station, done, is_over) = (&station, &done, &is_over);
        let pause = Duration::from_millis(number("PAUSE_MS", 5));
        scope.spawn(move || acknowledge(station, pause, done, is_over));
        let port = server.kill();
        let before = done.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_secs(seconds));
        is_over.store(true, Ordering::Relaxed);
        let backlog = done.load(Ordering::Relaxed) - before;
        let _server = Server::start(dir.path(), Some(port)).unwrap();
        let back = Instant::now();
        let first = events(&dir.path().join("hub/journal.db"), "harbour.ap7.").len();
        while events(&dir.path().join("hub/journal.db"), "harbour.ap7.").len() == first {
            std::thread::sleep(Duration::from_millis(10));
        }
        let began = back.elapsed();
        let all = agree(dir.path(), "hub", "ap7", Duration::from_secs(300));
        println!(
            "cut of {seconds} s: {backlog} events waited; the first reached the hub {:.1} s after the server's return; \
             all {all} are in the hub's journal, once each and in order; load {}",
            began.as_secs_f64(),
            load()
        );
        (backlog, back.elapsed() - began)
    });
    let rate = backlog as f64 / recovered.as_secs_f64();
    println!(
        "{:.2} s for the backlog: {rate:.0} events/s; an hour's at one a second, 3600: {:.0} s",
        recovered.as_secs_f64(),
        3600.0 / rate
    );
}

#[test]
#[ignore = "minutes; make fleet-measured"]
fn kills_while_alerts_flow() {
    let dir = tempfile::tempdir().unwrap();
    let Some(first) = Server::start(dir.path(), None) else {
        return;
    };
    let kills = number("KILLS", 50) as usize;
    let port = first.port;
    let mut server = Some(first);
    let mut at_hub = Some(hub(dir.path(), port));
    let at_station = Mutex::new(Some(station(dir.path(), port)));
    let (done, is_over) = (AtomicU64::new(0), AtomicBool::new(false));
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let began = Instant::now();
    std::thread::scope(|scope| {
        scope.spawn(|| acknowledge(&at_station, Duration::from_millis(10), &done, &is_over));
        let killing = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let mut left = [kills; 3];
            while left.iter().any(|n| *n > 0) {
                let who = rng.random_range(0..3);
                if left[who] == 0 {
                    continue;
                }
                left[who] -= 1;
                std::thread::sleep(Duration::from_millis(rng.random_range(100..1500)));
                let gone = Duration::from_millis(rng.random_range(0..500));
                match who {
                    0 => {
                        let mut daemon = at_station.lock().unwrap();
                        drop(daemon.take());
                        std::thread::sleep(gone);
                        *daemon = Some(station(dir.path(), port));
                    }
                    1 => {
                        drop(at_hub.take());
                        std::thread::sleep(gone);
                        at_hub = Some(hub(dir.path(), port));
                    }
                    _ => {
                        drop(server.take());
                        std::thread::sleep(gone);
                        server = Server::start(dir.path(), Some(port));
                    }
                }
            }
        }));
        is_over.store(true, Ordering::Relaxed);
        killing.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    });
    let all = agree(dir.path(), "hub", "ap7", Duration::from_secs(60));
    println!(
        "{kills} kills each of station, hub and server in {:.0} s: {all} events at the station, the same at the hub, once each \
         and in order; load {}",
        began.elapsed().as_secs_f64(),
        load()
    );
    assert!(all > 10 * kills, "too few events for so many kills");
}
