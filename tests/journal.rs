//! The journal from outside: what was recorded is there after a restart, in order, and nothing else is.

use std::path::Path;
use std::time::{Duration, Instant};

use jiff::{SignedDuration, Timestamp};
use oapwatch::journal::{Config, Cursor, Error, Filter, Journal, Subscription};
use oapwatch::monitor::{Alert, AlertEvent, AlertEventKind, AlertKind, AlertSource, AlertState, Severity};

fn start() -> Timestamp {
    "2026-11-21T08:00:00.123456789Z".parse().unwrap()
}

fn alert(id: &str, kind: AlertKind, raised_s: i64) -> Alert {
    Alert {
        id: id.to_owned(),
        kind,
        severity: Severity::Warning,
        state: AlertState::Open,
        raised_at: start() + SignedDuration::from_secs(raised_s),
        cleared_at: None,
        user: Some("u-17".to_owned()),
        x_m: Some(12.5),
        y_m: Some(-80.0),
        z_m: Some(0.0),
        geodetic: None,
        cov_m2: Some([[0.1, 0.0], [0.0, 0.1]]),
        claimed: None,
        evidence: serde_json::json!({"distance_m": 7.5}),
        source: AlertSource {
            kind: "simulator".to_owned(),
            frame: raised_s.unsigned_abs(),
            file: None,
        },
        zone: None,
        webhooks: None,
        maintenance: None,
        acknowledgement: None,
        station: None,
    }
}

fn event(event: AlertEventKind, mut alert: Alert) -> AlertEvent {
    alert.state = match event {
        AlertEventKind::Raised
        | AlertEventKind::Updated
        | AlertEventKind::Unacknowledged
        | AlertEventKind::Reported => AlertState::Open,
        AlertEventKind::Acknowledged => AlertState::Acknowledged,
        AlertEventKind::Cleared => AlertState::Cleared,
    };
    AlertEvent::new(event, alert)
}

fn raised(id: &str, raised_s: i64) -> AlertEvent {
    event(AlertEventKind::Raised, alert(id, AlertKind::UnclaimedEmitter, raised_s))
}

fn at(path: &Path) -> Config {
    Config {
        path: Some(path.to_owned()),
        ..Config::default()
    }
}

/// Waits for a condition that another thread brings about.
async fn until(condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < deadline, "the condition did not come true within 20 s");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

fn ids(alerts: &[Alert]) -> Vec<&str> {
    alerts.iter().map(|a| a.id.as_str()).collect()
}

#[tokio::test]
async fn what_was_recorded_is_there_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let config = at(&dir.path().join("a.db"));
    let raise = raised("a", 0);
    let clear = event(AlertEventKind::Cleared, alert("b", AlertKind::UserUnseen, 1));
    {
        let journal = Journal::open(&config, vec![]).unwrap();
        let seq = journal
            .record(&[raise.clone(), raised("b", 1)], start(), start())
            .unwrap();
        assert_eq!(seq, 2);
        journal.record(std::slice::from_ref(&clear), start(), start()).unwrap();
    }
    let journal = Journal::open(&config, vec![]).unwrap();
    assert_eq!(journal.open_alerts().unwrap(), vec![raise.alert]);
    assert_eq!(journal.alert("b").unwrap().unwrap(), clear.alert);
    assert_eq!(journal.alert("c").unwrap(), None);
    let history = journal.events("b").unwrap();
    assert_eq!(
        history.iter().map(|e| e.event.event).collect::<Vec<_>>(),
        [AlertEventKind::Raised, AlertEventKind::Cleared]
    );
    assert_eq!(journal.last_seq(), 3);
    assert_eq!(journal.record(&[raised("c", 2)], start(), start()).unwrap(), 4);
    assert!(journal.health().writable);
    assert!(journal.health().size_bytes > 0);
}

#[tokio::test]
async fn alerts_are_paged_newest_first_and_filtered() {
    for path in [None, Some(tempfile::tempdir().unwrap())] {
        let config = match &path {
            Some(dir) => at(&dir.path().join("a.db")),
            None => Config::default(),
        };
        let journal = Journal::open(&config, vec![]).unwrap();
        for k in 0..25 {
            let kind = [AlertKind::UnclaimedEmitter, AlertKind::UserUnseen][k % 2];
            // Three alerts a second: the order among equals must be kept over pages too.
            let raise = event(AlertEventKind::Raised, alert(&format!("a{k}"), kind, k as i64 / 3));
            journal.record(&[raise], start(), start()).unwrap();
        }
        journal.settled().await;

        let mut seen = Vec::new();
        let mut filter = Filter::default();
        loop {
            let page = journal.alerts(&filter, 7).unwrap();
            seen.extend(page.alerts.iter().map(|a| a.id.clone()));
            // As a client does it: through the text.
            match page.next {
                Some(next) => filter.after = Some(next.to_string().parse::<Cursor>().unwrap()),
                None => break,
            }
        }
        assert_eq!(seen, (0..25).rev().map(|k| format!("a{k}")).collect::<Vec<_>>());

        let unseen = Filter {
            kind: Some(AlertKind::UserUnseen),
            since: Some(start() + SignedDuration::from_secs(7)),
            state: Some(AlertState::Open),
            ..Filter::default()
        };
        assert_eq!(ids(&journal.alerts(&unseen, 50).unwrap().alerts), ["a23", "a21"]);
        let cleared = Filter {
            state: Some(AlertState::Cleared),
            ..Filter::default()
        };
        assert!(journal.alerts(&cleared, 50).unwrap().alerts.is_empty());
    }
    for wrong in ["", "x", "1-", "-1", "1-2-3", "zz-1", "ffffffffffffffffff-1"] {
        assert!(matches!(wrong.parse::<Cursor>(), Err(Error::Cursor(_))), "{wrong:?}");
    }
}

#[tokio::test]
async fn a_follower_gets_every_event_in_order() {
    let journal = Journal::open(&Config::default(), vec![]).unwrap();
    let mut follower = journal.follow(0);
    let recorder = journal.clone();
    let task = tokio::spawn(async move {
        for k in 0..1000 {
            recorder
                .record(&[raised(&format!("a{k}"), k)], start(), start())
                .unwrap();
            if k % 100 == 0 {
                tokio::task::yield_now().await;
            }
        }
    });
    let mut seqs = Vec::new();
    while seqs.len() < 1000 {
        seqs.extend(follower.next().await.unwrap().iter().map(|e| e.seq));
    }
    task.await.unwrap();
    assert_eq!(seqs, (1..=1000).collect::<Vec<u64>>());
}

#[tokio::test]
async fn matching_endpoints_get_an_outbox_row() {
    let dir = tempfile::tempdir().unwrap();
    let config = at(&dir.path().join("a.db"));
    let subscriptions = vec![
        Subscription {
            has_operator_acts: false,
            endpoint: "all".to_owned(),
            kinds: None,
        },
        Subscription {
            has_operator_acts: false,
            endpoint: "unseen".to_owned(),
            kinds: Some(vec![AlertKind::UserUnseen]),
        },
    ];
    let journal = Journal::open(&config, subscriptions).unwrap();
    let b = alert("b", AlertKind::UserUnseen, 1);
    let events = [
        raised("a", 0),
        event(AlertEventKind::Raised, b.clone()),
        event(AlertEventKind::Acknowledged, b.clone()),
        event(AlertEventKind::Cleared, b),
    ];
    journal.record(&events, start(), start()).unwrap();
    journal.settled().await;
    let seqs = |endpoint| -> Vec<u64> { journal.waiting(endpoint, 0).unwrap().iter().map(|w| w.seq).collect() };
    assert_eq!(seqs("all"), [1, 2, 4]);
    assert_eq!(seqs("unseen"), [2, 4]);
    assert_eq!(journal.endpoint("all").unwrap().waiting, 3);
    assert!(journal.endpoint("all").unwrap().oldest_waiting.is_some());
}

#[tokio::test]
async fn a_disk_that_refuses_writes_stops_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.db");
    let all = Subscription {
        has_operator_acts: false,
        endpoint: "all".to_owned(),
        kinds: None,
    };
    let journal = Journal::open(&at(&path), vec![all]).unwrap();
    journal
        .record(&[raised("a", 0), raised("b", 1)], start(), start())
        .unwrap();
    journal.settled().await;

    let other = rusqlite::Connection::open(&path).unwrap();
    other.execute_batch("BEGIN IMMEDIATE").unwrap();
    let clear = event(AlertEventKind::Cleared, alert("a", AlertKind::UnclaimedEmitter, 0));
    journal
        .record(&[clear.clone(), raised("c", 2)], start(), start())
        .unwrap();
    let mut follower = journal.follow(2);
    assert_eq!(
        follower.next().await.unwrap().len(),
        2,
        "an alarm is heard without a disk"
    );
    let health = journal.health();
    assert!(!health.writable);
    assert_eq!((health.unwritten, health.lost), (2, 0));
    // It took too long at first, and was refused in the end.
    until(|| journal.health().last_error.unwrap_or_default().contains("locked")).await;
    assert_eq!(ids(&journal.open_alerts().unwrap()), ["b", "c"]);
    assert_eq!(
        ids(&journal.alerts(&Filter::default(), 9).unwrap().alerts),
        ["c", "b", "a"]
    );
    assert_eq!(ids(&journal.alerts(&Filter::default(), 1).unwrap().alerts), ["c"]);
    assert_eq!(journal.events("a").unwrap().len(), 2);
    assert_eq!(journal.waiting("all", 0).unwrap().len(), 4);

    other.execute_batch("ROLLBACK").unwrap();
    // The next write, or the writer's own retry, takes along what waited.
    journal.record(&[raised("d", 3)], start(), start()).unwrap();
    until(|| journal.health().writable).await;
    assert_eq!(journal.health().unwritten, 0);
    let on_disk: Vec<u64> = other
        .prepare("SELECT seq FROM event ORDER BY seq")
        .unwrap()
        .query_map([], |row| row.get(0))
        .unwrap()
        .collect::<Result<_, _>>()
        .unwrap();
    assert_eq!(on_disk, [1, 2, 3, 4, 5]);
    assert_eq!(
        ids(&journal.alerts(&Filter::default(), 9).unwrap().alerts),
        ["d", "c", "b", "a"]
    );
}

#[tokio::test]
async fn an_alarm_does_not_wait_for_a_disk_that_hangs() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.db");
    let journal = Journal::open(&at(&path), vec![]).unwrap();
    journal.record(&[raised("a", 0)], start(), start()).unwrap();
    journal.settled().await;
    let other = rusqlite::Connection::open(&path).unwrap();
    other.execute_batch("BEGIN IMMEDIATE").unwrap();
    // The writer waits a second for the lock; it is given back before that, so the write succeeds, but late.
    let locked = Instant::now();
    journal.record(&[raised("b", 1)], start(), start()).unwrap();
    assert_eq!(journal.follow(1).next().await.unwrap().len(), 1);
    assert!(locked.elapsed() < Duration::from_millis(900), "{:?}", locked.elapsed());
    assert_eq!(journal.health().last_error.as_deref(), Some("the disk takes too long"));
    other.execute_batch("ROLLBACK").unwrap();
    journal.record(&[raised("c", 2)], start(), start()).unwrap();
    until(|| journal.health().writable).await;
    drop(journal);
    let journal = Journal::open(&at(&path), vec![]).unwrap();
    let seqs: Vec<u64> = journal.events_after(0, 9).unwrap().iter().map(|e| e.seq).collect();
    assert_eq!(seqs, [1, 2, 3], "each is there once");
}

#[tokio::test]
async fn retention_keeps_what_is_open_or_still_to_be_delivered() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.db");
    let subscriptions = vec![Subscription {
        has_operator_acts: false,
        endpoint: "unseen".to_owned(),
        kinds: Some(vec![AlertKind::UserUnseen]),
    }];
    let journal = Journal::open(&at(&path), subscriptions.clone()).unwrap();
    let old = start() - SignedDuration::from_hours(24 * 91);
    let cleared = |id, kind| event(AlertEventKind::Cleared, alert(id, kind, 0));
    journal
        .record(&[cleared("old", AlertKind::SensorLost)], old, old)
        .unwrap();
    journal
        .record(&[cleared("undelivered", AlertKind::UserUnseen)], old, old)
        .unwrap();
    journal.record(&[raised("open", 0)], old, old).unwrap();
    journal
        .record(&[cleared("new", AlertKind::SensorLost)], start(), start())
        .unwrap();
    journal.maintain(start());
    let remaining = |journal: &Journal| -> Vec<String> {
        let page = journal.alerts(&Filter::default(), 100).unwrap();
        page.alerts.into_iter().map(|a| a.id).collect()
    };
    drop(journal);
    let journal = Journal::open(&at(&path), subscriptions).unwrap();
    assert_eq!(remaining(&journal), ["new", "open", "undelivered"]);
    assert!(journal.events("old").unwrap().is_empty());
    drop(journal);

    // Without its endpoint in the config, a delivery waits for `keep_days` and no longer.
    let journal = Journal::open(&at(&path), vec![]).unwrap();
    journal.maintain(start());
    drop(journal);
    let journal = Journal::open(&at(&path), vec![]).unwrap();
    assert_eq!(remaining(&journal), ["new", "open"]);
    assert_eq!(
        journal.record(&[raised("next", 0)], start(), start()).unwrap(),
        5,
        "numbers are not given twice"
    );
}

#[tokio::test]
async fn a_journal_stays_within_its_size() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.db");
    let config = Config { max_mb: 1, ..at(&path) };
    let journal = Journal::open(&config, vec![]).unwrap();
    journal.record(&[raised("open", 0)], start(), start()).unwrap();
    for k in 0..40 {
        let ids: Vec<String> = (0..100).map(|n| format!("a{}", 100 * k + n)).collect();
        let batch: Vec<AlertEvent> = ids
            .iter()
            .flat_map(|id| {
                let raise = raised(id, k);
                let clear = event(AlertEventKind::Cleared, raise.alert.clone());
                [raise, clear]
            })
            .collect();
        journal.record(&batch, start(), start()).unwrap();
        journal.settled().await;
    }
    drop(journal);
    let bytes = std::fs::metadata(&path).unwrap().len();
    assert!(bytes < 2_000_000, "{bytes} bytes");
    let journal = Journal::open(&config, vec![]).unwrap();
    assert_eq!(ids(&journal.open_alerts().unwrap()), ["open"]);
    assert!(journal.alert("a3999").unwrap().is_some(), "the newest are kept");
    assert!(journal.alert("a0").unwrap().is_none());
}
