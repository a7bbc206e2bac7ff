//! The daemon as an operator meets it: a process, an address, signals.

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

/// A running `oapwatch run` on a free port; killed when dropped.
struct Daemon {
    child: Child,
    url: String,
}

impl Daemon {
    fn start(dir: &Path, config: &str) -> Self {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let file = dir.join("oapwatch.toml");
        std::fs::write(&file, config).unwrap();
        let child = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
            .args(["run", "--config"])
            .arg(&file)
            .args(["--listen", &format!("127.0.0.1:{port}")])
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let url = format!("http://127.0.0.1:{port}");
        Self { child, url }
    }

    /// Asks until `accept` takes the answer; fails after 20 s.
    fn wait_for(&self, path: &str, what: &str, accept: impl Fn(&Value) -> bool) -> Value {
        let end = Instant::now() + Duration::from_secs(20);
        let mut last = String::new();
        while Instant::now() < end {
            if let Some(body) = get(&self.url, path) {
                match serde_json::from_str(&body) {
                    Ok(value) if accept(&value) => return value,
                    _ => last = body,
                }
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("no {what} within 20 s; {path} last said {last}");
    }

    fn signal(&self, name: &str) {
        let status = Command::new("kill").args([name, &self.child.id().to_string()]).status();
        assert!(status.unwrap().success());
    }

    /// Waits for the end; gives the exit code and the log.
    fn end(mut self) -> (Option<i32>, Vec<String>) {
        let stderr = BufReader::new(self.child.stderr.take().unwrap());
        let log = stderr.lines().map_while(Result::ok).collect();
        (self.child.wait().unwrap().code(), log)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn get(url: &str, path: &str) -> Option<String> {
    use std::io::{Read, Write};
    let address = url.strip_prefix("http://").unwrap();
    let mut stream = std::net::TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(5))).ok()?;
    write!(
        stream,
        "GET {path} HTTP/1.0\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    head.starts_with("HTTP/1.0 200")
        .then(|| body.to_owned())
        .or_else(|| head.starts_with("HTTP/1.1 200").then(|| body.to_owned()))
}

fn alerts(value: &Value) -> &[Value] {
    value["alerts"].as_array().map_or(&[], Vec::as_slice)
}

#[test]
fn on_the_simulator_users_are_verified_and_the_eavesdropper_is_alerted() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = Daemon::start(dir.path(), "");
    let seen = daemon.wait_for("/v1/positions", "verified users", |v| {
        let emitters = v["emitters"].as_array().cloned().unwrap_or_default();
        emitters.iter().filter(|e| e["status"] == "verified").count() >= 5
    });
    let named = seen["emitters"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|e| e["user"].is_string());
    assert!(named.count() >= 5, "{seen}");
    let list = daemon.wait_for("/v1/alerts", "alert", |v| {
        alerts(v).iter().any(|a| a["kind"] == "unclaimed_emitter")
    });
    assert_eq!(
        alerts(&list).len(),
        1,
        "nobody but the eavesdropper is out of place: {list}"
    );
    let stopped = Instant::now();
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0), "{log:?}");
    assert!(
        stopped.elapsed() < Duration::from_secs(2),
        "took {:?} to stop",
        stopped.elapsed()
    );
}

#[test]
fn an_alert_survives_kill_9() {
    let dir = tempfile::tempdir().unwrap();
    let config = "[journal]\npath = \"journal.db\"\n";
    let first = Daemon::start(dir.path(), config);
    let before = first.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    first.signal("-KILL");
    let (code, _) = first.end();
    assert_eq!(code, None);
    let second = Daemon::start(dir.path(), config);
    let after = second.wait_for("/v1/alerts", "alert of the first run", |v| !alerts(v).is_empty());
    let ids = |v: &Value| {
        alerts(v)
            .iter()
            .map(|a| a["id"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    for id in ids(&before) {
        assert!(ids(&after).contains(&id), "{id} is lost");
    }
}

#[test]
fn a_bad_config_ends_the_program_before_a_port_is_bound() {
    let dir = tempfile::tempdir().unwrap();
    for (config, message) in [
        ("[optics]\nspot_sigma = 0.001\n", "did you mean `spot_sigma_m`?"),
        (
            "[optics]\naltitude_m = -3.0\n",
            "optics.altitude_m: expected a positive finite number, found -3",
        ),
        ("[estimator]\nname = \"grredy-fit\"\n", "did you mean"),
        ("[api]\nlisten = \"0.0.0.0:0\"\n", "api.token_file is needed"),
        ("[source]\nkind = \"replay\"\n", "source.frames"),
        (
            "[monitor]\ntolerated_distance_m = nan\n",
            "monitor.tolerated_distance_m",
        ),
        (
            "[[webhook]]\nurl = \"http://127.0.0.1:1\"\nsecret_file = \"absent\"\n",
            "absent",
        ),
    ] {
        let file = dir.path().join("bad.toml");
        std::fs::write(&file, config).unwrap();
        // The port is taken: a daemon that tried to bind it would say so instead.
        for command in ["run", "check"] {
            let mut run = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
            match command {
                "run" => run.args(["run", "--config"]),
                _ => run.arg("check"),
            };
            let output = run.arg(&file).output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(said.contains(message), "{command} of {config:?} said {said}");
            assert_eq!(output.status.code(), Some(64), "{said}");
        }
    }
}

#[test]
fn a_bad_file_changes_nothing_on_reload() {
    let dir = tempfile::tempdir().unwrap();
    let daemon = Daemon::start(dir.path(), "");
    daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64());
    std::fs::write(dir.path().join("oapwatch.toml"), "nonsense = 1\n").unwrap();
    daemon.signal("-HUP");
    let seen = daemon.wait_for("/v1/positions", "positions", |v| v["frame"].is_u64());
    daemon.wait_for("/v1/positions", "newer positions", |v| {
        v["frame"].as_u64() > seen["frame"].as_u64()
    });
    daemon.signal("-TERM");
    let (code, log) = daemon.end();
    assert_eq!(code, Some(0));
    assert!(log.iter().any(|l| l.contains("nothing was changed")), "{log:?}");
}

#[test]
fn what_the_daemon_records_is_reviewed_to_the_same_alert() {
    let dir = tempfile::tempdir().unwrap();
    let record = "[record]\nfolder = \"recordings\"\nsegment_s = 2.0\nbefore_s = 1.0\nafter_s = 0.5\n";
    let daemon = Daemon::start(dir.path(), record);
    let list = daemon.wait_for("/v1/alerts", "alert", |v| !alerts(v).is_empty());
    let raised = alerts(&list)[0].clone();
    daemon.wait_for("/v1/positions", "frames after the alert", |v| {
        v["frame"].as_u64() > raised["source"]["frame"].as_u64().map(|k| k + 10)
    });
    daemon.signal("-TERM");
    assert_eq!(daemon.end().0, Some(0));

    let file = Path::new(raised["source"]["file"].as_str().unwrap());
    assert!(file.is_file(), "the alert names {}", file.display());
    let id = raised["id"].as_str().unwrap();
    assert!(dir.path().join(format!("recordings/evidence/{id}.npy")).is_file());
    let config = dir.path().join("review.toml");
    for recording in ["recordings".to_owned(), format!("recordings/evidence/{id}.npy")] {
        std::fs::write(
            &config,
            format!("[source]\nkind = \"replay\"\nframes = \"{recording}\"\n"),
        )
        .unwrap();
        let review = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
            .args(["review", "--config"])
            .arg(&config)
            .output()
            .unwrap();
        assert!(review.status.success(), "{}", String::from_utf8_lossy(&review.stderr));
        let told = String::from_utf8(review.stdout).unwrap();
        let events: Vec<Value> = told.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let found = events.iter().find(|e| e["event"] == "alert.raised");
        let found = &found.unwrap_or_else(|| panic!("no alert in {recording}: {told}"))["alert"];
        if recording == "recordings" {
            for member in ["id", "kind", "raised_at", "user", "claimed"] {
                assert_eq!(found[member], raised[member], "{member}");
            }
            assert_eq!(found["source"]["frame"], raised["source"]["frame"]);
        }
    }
}
