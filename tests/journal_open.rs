//! What may be opened as a journal, and by whom.

use std::path::Path;

use oapwatch::journal::{Config, Error, Journal};

fn at(path: &Path) -> Config {
    Config {
        path: Some(path.to_owned()),
        ..Config::default()
    }
}

#[test]
fn a_journal_that_is_not_ours_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let text = dir.path().join("notes.txt");
    std::fs::write(
        &text,
        "not a database, and long enough to be read as a header of one".repeat(20),
    )
    .unwrap();
    assert!(matches!(Journal::open(&at(&text), vec![]), Err(Error::Foreign { .. })));

    let foreign = dir.path().join("foreign.db");
    rusqlite::Connection::open(&foreign)
        .unwrap()
        .execute_batch("CREATE TABLE cats (name TEXT)")
        .unwrap();
    assert!(matches!(
        Journal::open(&at(&foreign), vec![]),
        Err(Error::Foreign { .. })
    ));

    let newer = dir.path().join("newer.db");
    drop(Journal::open(&at(&newer), vec![]).unwrap());
    rusqlite::Connection::open(&newer)
        .unwrap()
        .pragma_update(None, "user_version", 99)
        .unwrap();
    assert!(matches!(
        Journal::open(&at(&newer), vec![]),
        Err(Error::NewerSchema { found: 99, .. })
    ));

    let missing = dir.path().join("no-such-folder/a.db");
    assert!(matches!(
        Journal::open(&at(&missing), vec![]),
        Err(Error::Unusable { .. })
    ));
}

#[test]
fn one_journal_has_one_owner() {
    let dir = tempfile::tempdir().unwrap();
    let config = at(&dir.path().join("a.db"));
    let first = Journal::open(&config, vec![]).unwrap();
    assert!(matches!(Journal::open(&config, vec![]), Err(Error::InUse { .. })));
    drop(first);
    Journal::open(&config, vec![]).unwrap();
}

#[test]
fn a_journal_is_its_owner_s_whatever_the_umask_and_an_old_one_becomes_so() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.db");
    let modes = || -> Vec<(String, u32)> {
        let files = std::fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap());
        let mode = |file: &std::fs::DirEntry| file.metadata().unwrap().permissions().mode() & 0o777;
        files
            .map(|file| (file.file_name().into_string().unwrap(), mode(&file)))
            .collect()
    };
    let journal = Journal::open(&at(&path), vec![]).unwrap();
    let found = modes();
    assert!(found.len() >= 3, "the journal, its log and its lock: {found:?}");
    assert!(found.iter().all(|(_, mode)| *mode == 0o600), "{found:?}");
    drop(journal);

    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
    let _journal = Journal::open(&at(&path), vec![]).unwrap();
    let found = modes();
    assert!(found.iter().all(|(_, mode)| *mode == 0o600), "{found:?}");
}

#[tokio::test]
async fn the_audit_log_is_kept_in_order_over_a_restart_and_within_its_age() {
    use jiff::{SignedDuration, Timestamp};
    use oapwatch::journal::{AuditAction, AuditEntry};
    let dir = tempfile::tempdir().unwrap();
    let config = at(&dir.path().join("a.db"));
    let now: Timestamp = "2026-11-21T08:00:00Z".parse().unwrap();
    let entry = |target: &str| AuditEntry {
        action: AuditAction::Acknowledge,
        actor: Some("anna".into()),
        client: "192.0.2.1".into(),
        target: Some(target.into()),
        detail: None,
        count: 1,
    };
    let targets = |journal: &Journal, before| -> Vec<String> {
        let rows = journal.audit_log(before, 10).unwrap();
        rows.into_iter().map(|row| row.entry.target.unwrap()).collect()
    };
    let journal = Journal::open(&config, vec![]).unwrap();
    for target in ["a", "b"] {
        assert!(journal.audit(entry(target), now), "two at one time are two rows");
    }
    journal.settled().await;
    drop(journal);
    let journal = Journal::open(&config, vec![]).unwrap();
    assert!(journal.audit(entry("c"), now + SignedDuration::from_hours(24 * 89)));
    journal.settled().await;
    assert_eq!(targets(&journal, None), ["c", "b", "a"]);
    let last = journal.audit_log(None, 1).unwrap()[0].id;
    assert_eq!(targets(&journal, Some(last)), ["b", "a"]);

    // The first round after two days is skipped: the clock may be wrong.
    for _ in 0..2 {
        journal.maintain(now + SignedDuration::from_hours(24 * 91));
        journal.settled().await;
    }
    drop(journal);
    let journal = Journal::open(&config, vec![]).unwrap();
    assert_eq!(targets(&journal, None), ["c"], "older than keep_days");
}
