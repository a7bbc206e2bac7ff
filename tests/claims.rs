//! Claims from outside: a log that lives, and what a review reads of it.

#[path = "claims/formats.rs"]
mod formats;
#[path = "claims/heights.rs"]
mod heights;
#[path = "claims/store.rs"]
mod store;

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use jiff::{SignedDuration, Timestamp};
use oapwatch::claims::{Claim, ClaimState, Config, Follower, LONGEST_LINE, Poll, parse_line, read_log};

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
        z_m: None,
        sigma_m: None,
        cov_m2: None,
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

/// A writer that was not told of the rotation goes on in the old file, until that is deleted or rotated again.
#[test]
fn lines_written_to_the_old_file_after_the_rotation_are_read() {
    let mut log = log();
    let old = log.path.with_extension("1");
    append(&log.path, &line("a", 0));
    log.follower.poll().unwrap();
    let half = line("b", 1);
    append(&log.path, &half[..20]);
    fs::rename(&log.path, &old).unwrap();
    append(&log.path, &line("new", 2));
    assert_eq!(users(&log.follower.poll().unwrap()), ["new"]);
    append(&old, &half[20..]);
    append(&old, &line("c", 3));
    append(&log.path, &line("d", 4));
    let poll = log.follower.poll().unwrap();
    assert_eq!((users(&poll), poll.refused_count), (vec!["b", "c", "d"], 0));
    append(&old, &line("e", 5));
    append(&old, "{");
    fs::remove_file(&old).unwrap();
    let poll = log.follower.poll().unwrap();
    assert_eq!((users(&poll), poll.refused_count), (vec!["e"], 1));
}

fn gzip(from: &Path, to: &Path) {
    let mut packed = flate2::write::GzEncoder::new(fs::File::create(to).unwrap(), flate2::Compression::fast());
    packed.write_all(&fs::read(from).unwrap()).unwrap();
    packed.finish().unwrap();
    fs::remove_file(from).unwrap();
}

#[test]
fn a_live_log_that_was_just_rotated_and_packed_is_read_before_the_new_one() {
    for (age_s, expected) in [(10, vec!["a", "b", "c"]), (1000, vec!["b", "c"])] {
        let log = log();
        let packed = log.path.with_file_name("claims.ndjson.1.gz");
        append(&log.path, &line("a", 0));
        gzip(&log.path, &packed);
        let now = SystemTime::now();
        let written = now - Duration::from_secs(age_s);
        let file = fs::File::options().append(true).open(&packed).unwrap();
        file.set_modified(written).unwrap();
        append(&log.path, &line("b", 1));
        let mut follower = Follower::new(&log.path, &Config::default()).live(now - Duration::from_secs(120));
        let mut found = users(&follower.poll().unwrap()).join(" ");
        append(&log.path, &line("c", 2));
        found += &format!(" {}", users(&follower.poll().unwrap()).join(" "));
        assert_eq!(found.split(' ').collect::<Vec<_>>(), expected);
    }
}

#[test]
fn a_review_reads_packed_logs_back_to_the_recording_s_start() {
    let log = log();
    for (k, user) in ["too-early", "early", "late"].iter().enumerate() {
        append(&log.path, &format!("\u{feff}{}", line(user, 10 * k as u32)));
        if k < 2 {
            let rotated = log.path.with_file_name(format!("claims.ndjson.{}.gz", 2 - k));
            gzip(&log.path, &rotated);
            let written = SystemTime::UNIX_EPOCH + Duration::from_secs(k as u64);
            fs::File::options()
                .append(true)
                .open(&rotated)
                .unwrap()
                .set_modified(written)
                .unwrap();
        }
    }
    for (since, expected) in [
        (None, vec!["late"]),
        (Some(25.0), vec!["late"]),
        (Some(15.0), vec!["early", "late"]),
        (Some(-5.0), vec!["too-early", "early", "late"]),
    ] {
        let poll = read_log(&log.path, &Config::default(), since.map(at)).unwrap();
        assert_eq!((users(&poll), poll.refused_count), (expected, 0), "{since:?}");
    }
    let packed = log.path.with_extension("gz");
    gzip(&log.path, &packed);
    assert_eq!(users(&read_log(&packed, &Config::default(), None).unwrap()), ["late"]);
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
    let poll = read_log(&log.path, &Config::default(), None).unwrap();
    assert_eq!(users(&poll), ["a", "b", "c"]);
}

#[test]
fn a_long_log_is_read_from_near_its_end() {
    let log = log();
    let config = Config {
        tail_bytes: 65_536,
        ..Config::default()
    };
    let mut follower = Follower::new(&log.path, &config).live(SystemTime::UNIX_EPOCH);
    append(&log.path, &line("old", 0).repeat(5000));
    append(&log.path, &line("new", 1));
    let whole = fs::metadata(&log.path).unwrap().len();
    let poll = follower.poll().unwrap();
    assert_eq!(poll.skipped_at_start_bytes, whole - config.tail_bytes);
    assert_eq!(
        (poll.refused_count, poll.skipped_bytes),
        (0, 0),
        "the line that was cut is no error"
    );
    assert_eq!(users(&poll).last(), Some(&"new"));
    assert!(
        poll.claims.len() > 900 && poll.claims.len() < 1100,
        "{}",
        poll.claims.len()
    );
    // It grows by more than is read: what is too far behind is passed over, and a rewrite is still noticed.
    append(&log.path, &line("flood", 2).repeat(5000));
    append(&log.path, &line("last", 3));
    let poll = follower.poll().unwrap();
    assert!(
        poll.skipped_bytes > 200_000 && poll.skipped_at_start_bytes == 0,
        "{}",
        poll.skipped_bytes
    );
    assert_eq!(users(&poll).last(), Some(&"last"));
    let other = line("new", 4).replace("08:00", "09:00");
    fs::write(&log.path, other.repeat(15_000)).unwrap();
    assert!(follower.poll().unwrap().restarted);
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
