//! A hub that records what it hears, reviewed.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::nats::{Server, hub_with, station};
use crate::process::{Daemon, alerts};

/// The events of a journal, in order.
fn events(journal: &Path) -> Vec<Value> {
    let db = rusqlite::Connection::open_with_flags(journal, rusqlite::OpenFlags::SQLITE_OPEN_READ_ONLY).unwrap();
    let mut rows = db.prepare("SELECT body FROM event ORDER BY seq").unwrap();
    let bodies = rows.query_map([], |row| row.get::<_, String>(0)).unwrap();
    bodies
        .map(|body| serde_json::from_str(&body.unwrap()).unwrap())
        .collect()
}

fn review(hub: &Path, what: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
    command.args(["fleet", "--config"]).arg(hub.join("oapwatch.toml"));
    command.arg("--review").arg(what).output().unwrap()
}

fn told(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::str::from_utf8(&output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn stop(daemon: Daemon) {
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0), "{log:?}");
}

#[test]
fn a_recorded_fleet_gives_the_hub_s_own_alerts_again() {
    let dir = tempfile::tempdir().unwrap();
    let Some(server) = Server::start(dir.path(), None) else {
        return;
    };
    let start = || {
        hub_with(
            dir.path(),
            server.port,
            "[record]\nfolder = \"recordings\"\nsegment_s = 2.0\n",
        )
    };
    let hub = start();
    let ap7 = station(dir.path(), "ap7", "eavesdropper", server.port);
    let _ap8 = station(dir.path(), "ap8", "builtin", server.port);
    let told_of = |hub: &Daemon, kind: &str| {
        let list = hub.wait_for(&format!("/v1/alerts?kind={kind}"), kind, |v| !alerts(v).is_empty());
        alerts(&list)[0]["id"].as_str().unwrap().to_owned()
    };
    told_of(&hub, "unclaimed_emitter");
    let conflict = told_of(&hub, "user_in_two_places");
    let path = format!("/v1/alerts/{conflict}/acknowledge");
    assert_eq!(hub.post(&path, &json!({ "note": "twins" }).to_string()).0, 200);
    // A second run goes on with the first one's alerts.
    stop(hub);
    let hub = start();
    hub.wait_for("/v1/stations", "both stations", |v| {
        v["stations"].as_array().is_some_and(|s| s.len() == 2)
    });
    drop(ap7);
    told_of(&hub, "station_lost");
    stop(hub);

    let folder = dir.path().join("hub");
    let recordings = folder.join("recordings");
    let first = review(&folder, &recordings);
    assert_eq!(told(&first), events(&folder.join("journal.db")));
    assert_eq!(first.stdout, review(&folder, &recordings).stdout);

    // Each file begins with what alerts depend on: what it tells by itself is what it tells among the others.
    let mut files: Vec<_> = std::fs::read_dir(&recordings)
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    files.sort();
    assert!(files.len() > 3, "{files:?}");
    let each: Vec<u8> = files.iter().flat_map(|file| review(&folder, file).stdout).collect();
    assert_eq!(String::from_utf8(each), String::from_utf8(first.stdout));

    // Where the hub was killed a line is not whole; one that is whole and wrong is named.
    let last = files.last().unwrap();
    let text = std::fs::read_to_string(last).unwrap();
    std::fs::write(last, format!("{text}{{\"at\":")).unwrap();
    told(&review(&folder, last));
    std::fs::write(last, format!("{text}{{\"at\":1}}\n")).unwrap();
    let refused = review(&folder, last);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{said}");
    assert!(
        said.contains(&format!(".ndjson:{}: expected", text.lines().count() + 1)),
        "{said}"
    );
}
