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
