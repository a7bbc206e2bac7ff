//! The claims room from outside: a log that lives, and a store that cannot be filled up or lied into.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use jiff::{SignedDuration, Timestamp};
use oapwatch::claims::{Claim, ClaimState, Config, Follower, LONGEST_LINE, Outcome, Poll, Store, parse_line, read_log};

fn at(s: f64) -> Timestamp {
    let start: Timestamp = "2026-11-21T08:00:00Z".parse().unwrap();
    start + SignedDuration::from_nanos((s * 1e9) as i64)
}

fn line(user: &str, s: u32) -> String {
    format!("{{\"time\":\"2026-11-21T08:00:{s:02}Z\",\"user\":\"{user}\",\"x_m\":{s},\"y_m\":0}}\n")
}

fn claim(user: &str, s: f64, x_m: f64) -> Claim {
    Claim {
        time: at(s),
        user: user.into(),
        x_m,
        y_m: 0.0,
        sigma_m: None,
        power_w: None,
        state: ClaimState::Active,
    }
}

fn append(path: &Path, text: &str) {
    let mut file = OpenOptions::new().append(true).create(true).open(path).unwrap();
    file.write_all(text.as_bytes()).unwrap();
}

fn users(poll: &Poll) -> Vec<&str> {
    poll.claims.iter().map(|c| c.user.as_str()).collect()
}

struct Log {
    _folder: tempfile::TempDir,
    path: PathBuf,
    follower: Follower,
}

fn log() -> Log {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("claims.ndjson");
    let follower = Follower::new(&path, &Config::default());
    Log {
        _folder: folder,
        path,
        follower,
    }
}

#[test]
fn a_log_that_does_not_exist_yet_is_waited_for() {
    let mut log = log();
    assert!(log.follower.poll().unwrap().claims.is_empty());
    append(&log.path, &line("a", 0));
    assert_eq!(users(&log.follower.poll().unwrap()), ["a"]);
    assert!(log.follower.poll().unwrap().claims.is_empty());
}

#[test]
fn a_half_written_line_is_taken_once_whole() {
    let mut log = log();
    let whole = line("a", 0);
    append(&log.path, &whole[..20]);
    let poll = log.follower.poll().unwrap();
    assert!(poll.claims.is_empty() && poll.refused.is_empty());
    append(&log.path, &whole[20..]);
    assert_eq!(users(&log.follower.poll().unwrap()), ["a"]);
}

#[test]
fn rotation_loses_nothing_of_the_old_file() {
    let mut log = log();
    append(&log.path, &line("a", 0));
    log.follower.poll().unwrap();
    append(&log.path, &line("b", 1));
    fs::rename(&log.path, log.path.with_extension("1")).unwrap();
    append(&log.path.with_extension("1"), &line("c", 2));
    assert_eq!(
        users(&log.follower.poll().unwrap()),
        ["b", "c"],
        "the old name is gone, the file is not"
    );
    append(&log.path, &line("d", 3));
    let poll = log.follower.poll().unwrap();
    assert_eq!(users(&poll), ["d"]);
    assert!(poll.restarted);
    append(&log.path, &line("e", 4));
    assert_eq!(users(&log.follower.poll().unwrap()), ["e"]);
}

/// What the old file still held comes first; the folder is an error until a file stands there again.
#[test]
fn a_log_replaced_by_a_folder_loses_nothing_and_is_taken_up_again() {
    let mut log = log();
    append(&log.path, &line("a", 0));
    log.follower.poll().unwrap();
    append(&log.path, &line("b", 1));
    fs::rename(&log.path, log.path.with_extension("1")).unwrap();
    fs::create_dir(&log.path).unwrap();
    assert_eq!(users(&log.follower.poll().unwrap()), ["b"]);
    for _ in 0..2 {
        let error = log.follower.poll().unwrap_err().to_string();
        assert!(error.contains("claims.ndjson: expected a file"), "{error}");
    }
    fs::remove_dir(&log.path).unwrap();
    assert!(log.follower.poll().unwrap().claims.is_empty());
    append(&log.path, &line("c", 2));
    assert_eq!(users(&log.follower.poll().unwrap()), ["c"]);
}

#[test]
fn a_log_of_garbage_is_counted_and_not_kept() {
    let mut log = log();
    append(&log.path, &"x\n".repeat(5000));
    append(&log.path, &line("a", 0));
    let poll = log.follower.poll().unwrap();
    assert_eq!((poll.refused_count, poll.refused.len()), (5000, 100));
    assert_eq!(users(&poll), ["a"]);
}

#[test]
fn truncation_and_a_rewrite_in_place_start_again() {
    let mut log = log();
    append(&log.path, &(line("a", 0) + &line("b", 1)));
    log.follower.poll().unwrap();
    fs::write(&log.path, line("c", 2)).unwrap();
    let poll = log.follower.poll().unwrap();
    assert!(poll.restarted);
    assert_eq!(users(&poll), ["c"]);
    let longer: String = (3..9).map(|s| line("d", s)).collect();
    fs::write(&log.path, longer).unwrap();
    assert_eq!(log.follower.poll().unwrap().claims.len(), 6);
}

#[test]
fn malformed_lines_are_named_once_and_skipped() {
    let mut log = log();
    let text = format!(
        "{}not json\n\n{}{}\n{}",
        line("a", 0),
        line("b", 1),
        "x".repeat(LONGEST_LINE + 9),
        line("c", 2)
    );
    append(&log.path, &text);
    let poll = log.follower.poll().unwrap();
    assert_eq!(users(&poll), ["a", "b", "c"]);
    let lines: Vec<u64> = poll.refused.iter().map(|r| r.line).collect();
    assert_eq!(lines, [2, 5]);
    assert!(
        poll.refused[1].error.to_string().contains("longer than"),
        "{}",
        poll.refused[1].error
    );
    assert!(log.follower.poll().unwrap().refused.is_empty());
    append(&log.path, "{}\n");
    assert_eq!(log.follower.poll().unwrap().refused[0].line, 7);
}

#[test]
fn any_bytes_are_survived() {
    let mut log = log();
    append(&log.path, &line("a", 0));
    let mut file = OpenOptions::new().append(true).open(&log.path).unwrap();
    file.write_all(&[0xff, 0xfe, 0, b'\n', 0xf0, b'\r', b'\n']).unwrap();
    append(&log.path, &line("b", 1));
    let poll = log.follower.poll().unwrap();
    assert_eq!(users(&poll), ["a", "b"]);
    assert_eq!(poll.refused.len(), 2);
}

#[test]
fn a_review_reads_a_whole_log_by_time() {
    let log = log();
    append(&log.path, &(line("b", 5) + &line("a", 1) + line("c", 9).trim_end()));
    let poll = read_log(&log.path, &Config::default()).unwrap();
    assert_eq!(users(&poll), ["a", "b", "c"]);
}

#[test]
fn the_store_tells_apart_new_late_repeated_and_contradicting_claims() {
    let mut store = Store::new(&Config::default());
    assert_eq!(store.insert(claim("a", 1.0, 1.0), at(1.0)), Outcome::Accepted);
    assert_eq!(store.insert(claim("a", 1.0, 1.0), at(1.1)), Outcome::Duplicate);
    assert_eq!(store.insert(claim("a", 1.0, 50.0), at(1.2)), Outcome::Conflicting);
    assert_eq!(store.insert(claim("a", 3.0, 3.0), at(3.0)), Outcome::Accepted);
    assert_eq!(store.insert(claim("a", 2.0, 4.0), at(3.1)), Outcome::Late);
    assert_eq!(store.user("a").unwrap().claim.x_m, 3.0);
    assert_eq!(store.position_at("a", at(1.5)).unwrap(), [2.5, 0.0]);
    assert_eq!(store.position_at("a", at(9.0)).unwrap(), [3.0, 0.0]);
    assert_eq!(store.position_at("a", at(0.0)).unwrap(), [1.0, 0.0]);
    assert_eq!(store.position_at("nobody", at(0.0)), None);
    let counts = store.counts();
    assert_eq!(
        (counts.accepted, counts.late, counts.duplicate, counts.conflicting),
        (2, 1, 1, 1)
    );
}

#[test]
fn a_claim_from_the_future_waits_for_its_time() {
    let mut store = Store::new(&Config::default());
    assert_eq!(store.insert(claim("a", 5.0, 1.0), at(1.0)), Outcome::Ahead);
    store.advance(at(4.9));
    assert!(store.is_empty());
    store.advance(at(5.0));
    assert_eq!(store.len(), 1);
    // It cannot keep out what is true now.
    store.insert(claim("b", 1e7, 9.0), at(6.0));
    assert_eq!(store.insert(claim("b", 6.0, 2.0), at(6.0)), Outcome::Accepted);
    assert_eq!(store.user("b").unwrap().claim.x_m, 2.0);
}

#[test]
fn a_flood_of_users_pushes_nobody_out() {
    let config = Config {
        max_users: 3,
        ..Config::default()
    };
    let mut store = Store::new(&config);
    for user in ["a", "b", "c"] {
        assert_eq!(store.insert(claim(user, 0.0, 0.0), at(0.0)), Outcome::Accepted);
    }
    assert_eq!(store.insert(claim("flood", 1.0, 0.0), at(1.0)), Outcome::Full);
    assert!(store.user("a").is_some());
    // Users long silent do make room.
    store.insert(claim("b", 1000.0, 0.0), at(1000.0));
    assert_eq!(store.insert(claim("new", 1000.0, 0.0), at(1000.0)), Outcome::Accepted);
    assert!(store.user("b").is_some() && store.len() == 3);
}

#[test]
fn a_reported_power_is_read_and_a_wrong_one_is_told() {
    let read = |text: &str| parse_line(text.as_bytes(), &Config::default());
    let line = |power: &str| format!("{{\"time\":1,\"user\":\"u\",\"x_m\":0,\"y_m\":0,\"power_w\":{power}}}");
    assert_eq!(read(&line("0.25")).unwrap().power_w, Some(0.25));
    assert_eq!(read(&line("null")).unwrap().power_w, None);
    assert_eq!(read(&line("0")).unwrap().power_w, Some(0.0));
    for wrong in ["-1", "\"1\""] {
        let error = read(&line(wrong)).unwrap_err().to_string();
        assert!(error.contains("power_w") && error.contains("watts"), "{error}");
    }
}
