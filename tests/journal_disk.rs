//! A disk that is full: the process is started again under a file size limit, which fails its writes as a full disk
//! does, in the middle of them; the limit is lifted while it runs.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use oapwatch::journal::{Config, Journal, Subscription};
use oapwatch::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};

fn raised(k: u64) -> AlertEvent {
    let alert = Alert {
        id: format!("a{k}"),
        kind: AlertKind::SensorLost,
        severity: Severity::Critical,
        state: AlertState::Open,
        raised_at: Timestamp::UNIX_EPOCH,
        cleared_at: None,
        user: None,
        x_m: None,
        y_m: None,
        z_m: None,
        geodetic: None,
        cov_m2: None,
        claimed: None,
        evidence: serde_json::json!({"text": "x".repeat(1000)}),
        source: AlertSource {
            kind: "v4l2".to_owned(),
            frame: k,
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    };
    AlertEvent::new(AlertEventKind::Raised, alert)
}

fn open(dir: &Path) -> Journal {
    let config = Config {
        path: Some(dir.join("a.db")),
        ..Config::default()
    };
    let all = Subscription {
        has_operator_acts: false,
        endpoint: "all".to_owned(),
        kinds: None,
    };
    Journal::open(&config, vec![all]).unwrap()
}

async fn until(mut holds: impl FnMut() -> bool) {
    let started = Instant::now();
    while !holds() {
        assert!(started.elapsed() < Duration::from_secs(20), "waited in vain");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// What runs under the limit.
#[tokio::test]
async fn limited() {
    let Ok(dir) = std::env::var("OAPWATCH_DISK_DIR") else {
        return;
    };
    let journal = open(Path::new(&dir));
    let mut follower = journal.follow(0);
    let mut recorded = 0;
    let mut heard = 0;
    // SQLite finds room for a while after the first refusal, by emptying its log into the main file.
    while journal.health().unwritten < 100 {
        for _ in 0..20 {
            recorded += 1;
            journal
                .record(&[raised(recorded)], Timestamp::UNIX_EPOCH, Timestamp::UNIX_EPOCH)
                .unwrap();
        }
        journal.settled().await;
        assert!(recorded < 10_000, "the limit is never met");
    }
    while heard < recorded {
        for event in follower.next().await.unwrap() {
            heard += 1;
            assert_eq!(event.seq, heard, "heard in order, disk or not");
        }
    }
    assert_eq!(journal.open_alerts().unwrap().len() as u64, recorded);
    assert_eq!(journal.waiting("all", 0).unwrap().len() as u64, recorded);
    let health = journal.health();
    assert!(health.unwritten >= 100 && health.lost == 0, "{health:?}");

    let pid = std::process::id().to_string();
    let lifted = Command::new("prlimit")
        .args(["--fsize=unlimited", "--pid", &pid])
        .status()
        .unwrap();
    assert!(lifted.success());
    until(|| journal.health().writable && journal.health().unwritten == 0).await;
    assert_eq!(journal.open_alerts().unwrap().len() as u64, recorded);
    std::fs::write(Path::new(&dir).join("recorded"), recorded.to_string()).unwrap();
}

/// What runs on a disk that is full from the start.
#[tokio::test]
async fn started() {
    let Ok(dir) = std::env::var("OAPWATCH_FULL_DISK_DIR") else {
        return;
    };
    let journal = open(Path::new(&dir));
    let before = journal.open_alerts().unwrap().len() as u64;
    journal
        .record(&[raised(before + 1)], Timestamp::UNIX_EPOCH, Timestamp::UNIX_EPOCH)
        .unwrap();
    journal.settled().await;
    let health = journal.health();
    assert!(!health.writable && health.lost == 0, "{health:?}");
    assert_eq!(journal.open_alerts().unwrap().len() as u64, before + 1);
    assert_eq!(journal.waiting("all", 0).unwrap().len() as u64, before + 1);
    std::fs::remove_file(Path::new(&dir).join(format!("expects {before}"))).unwrap();
}

#[tokio::test]
async fn a_journal_that_is_new_or_was_closed_starts_on_a_full_disk() {
    for before in [0, 3] {
        let dir = tempfile::tempdir().unwrap();
        let expected = dir.path().join(format!("expects {before}"));
        std::fs::write(&expected, "").unwrap();
        if before > 0 {
            let journal = open(dir.path());
            let events: Vec<AlertEvent> = (1..=before).map(raised).collect();
            journal
                .record(&events, Timestamp::UNIX_EPOCH, Timestamp::UNIX_EPOCH)
                .unwrap();
            journal.settled().await;
        }
        let output = Command::new("sh")
            .args([
                "-c",
                "trap '' XFSZ; ulimit -S -f 0; exec \"$0\" started --exact --nocapture 2>&1 | cat",
            ])
            .arg(std::env::current_exe().unwrap())
            .env("OAPWATCH_FULL_DISK_DIR", dir.path())
            .output()
            .unwrap();
        assert!(!expected.exists(), "{}", String::from_utf8_lossy(&output.stdout));
    }
}

#[test]
fn a_full_disk_loses_no_alert_and_stops_nothing() {
    if Command::new("prlimit").arg("--version").output().is_err() {
        eprintln!("not tested: prlimit (util-linux) is not installed");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    // 512-byte blocks; only the soft limit, so that it can be lifted. The signal would end the process.
    let output = Command::new("sh")
        .args([
            "-c",
            "trap '' XFSZ; ulimit -S -f 800; exec \"$0\" limited --exact --nocapture",
        ])
        .arg(std::env::current_exe().unwrap())
        .env("OAPWATCH_DISK_DIR", dir.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recorded: u64 = std::fs::read_to_string(dir.path().join("recorded"))
        .unwrap()
        .parse()
        .unwrap();
    let journal = open(dir.path());
    let seqs: Vec<u64> = journal
        .events_after(0, 100_000)
        .unwrap()
        .iter()
        .map(|e| e.seq)
        .collect();
    assert_eq!(seqs, (1..=recorded).collect::<Vec<_>>());
}
