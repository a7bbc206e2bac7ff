//! A recording as a source: its times, its pace, its end.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use ndarray::Array2;
use oapwatch::frames::{self, Capture, Config, Error, Next, SourceKind, npy};

const LONG: Duration = Duration::from_secs(20);

fn recording(folder: &Path, frames: u64) -> PathBuf {
    let path = folder.join("recording.npy");
    let mut writer = npy::Writer::create(&path, (2, 2)).unwrap();
    for k in 0..frames {
        writer.push(Array2::from_elem((2, 2), k as f64).view()).unwrap();
    }
    path
}

fn config(path: &Path, speed: f64) -> Config {
    Config {
        kind: SourceKind::Replay,
        frames: Some(path.to_owned()),
        start: Some("2026-11-21T08:00:00Z".parse().unwrap()),
        rate_hz: Some(10.0),
        speed,
        ..Config::default()
    }
}

fn open(config: &Config) -> Result<Box<dyn frames::FrameSource>, Error> {
    frames::open(config, &oapwatch::optics::Config::default().camera().unwrap())
}

/// (index, time, value of the pixels) of up to `most` frames.
fn watch(config: &Config, most: usize) -> Vec<(u64, Timestamp, f64)> {
    let mut source = open(config).unwrap();
    let mut seen = Vec::new();
    while seen.len() < most {
        match source.next(LONG) {
            Next::Frame(frame, arrivals) => {
                assert!(arrivals.claims.is_empty() && arrivals.poses.is_empty());
                seen.push((frame.index, frame.time, frame.pixels[[1, 1]]));
            }
            Next::End => break,
            other => panic!("{other:?}"),
        }
    }
    seen
}

#[test]
fn times_follow_from_start_and_rate_whatever_the_speed() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 4);
    let fast = watch(&config(&path, 0.0), 10);
    assert_eq!(fast.len(), 4);
    assert_eq!(fast[3].1, "2026-11-21T08:00:00.3Z".parse().unwrap());
    assert_eq!(watch(&config(&path, 50.0), 10), fast);
}

#[test]
fn the_pace_is_that_of_the_recording_times_the_speed() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 5);
    let began = Instant::now();
    watch(&config(&path, 4.0), 10);
    // Four intervals of 25 ms. A loaded machine may take longer, never less.
    assert!(began.elapsed() >= Duration::from_millis(100), "{:?}", began.elapsed());
}

#[test]
fn a_frame_that_is_not_due_yet_is_not_waited_for_past_patience() {
    let folder = tempfile::tempdir().unwrap();
    let mut source = open(&config(&recording(folder.path(), 2), 1e-6)).unwrap();
    assert!(matches!(source.next(Duration::ZERO), Next::Frame(..)));
    assert!(matches!(source.next(Duration::from_millis(1)), Next::Nothing));
}

#[test]
fn a_loop_counts_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config(&recording(folder.path(), 3), 0.0);
    config.r#loop = true;
    let seen = watch(&config, 7);
    assert_eq!(seen[6].0, 6);
    assert_eq!(seen[6].2, 0.0);
    assert_eq!(seen[6].1, "2026-11-21T08:00:00.6Z".parse().unwrap());
}

#[test]
fn a_cut_recording_gives_what_it_has_then_says_so_then_ends() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 3);
    let file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    file.set_len(file.metadata().unwrap().len() - 1).unwrap();
    let mut source = open(&config(&path, 0.0)).unwrap();
    assert!(matches!(source.next(LONG), Next::Frame(..)));
    assert!(matches!(source.next(LONG), Next::Frame(..)));
    assert!(matches!(source.next(LONG), Next::Unusable { index: 2, reason, .. } if reason.contains("recording.npy")));
    assert!(matches!(source.next(LONG), Next::End));
}

#[test]
fn a_recording_is_not_thinned_by_a_slow_reader() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 20);
    let capture = Capture::start(open(&config(&path, 0.0)).unwrap()).unwrap();
    for k in 0..20 {
        std::thread::sleep(Duration::from_millis(2));
        let captured = capture.next(LONG);
        assert!(matches!(captured.next, Next::Frame(f, _) if f.index == k));
        assert_eq!(captured.file.as_deref(), Some(path.as_path()));
    }
    assert!(matches!(capture.next(LONG).next, Next::End));
}

#[test]
fn a_capture_can_be_dropped_while_its_source_waits() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 20);
    let idle = Capture::start(open(&config(&path, 1e-6)).unwrap()).unwrap();
    assert!(matches!(idle.next(LONG).next, Next::Frame(..)));
    drop(idle);
    drop(Capture::start(open(&config(&path, 0.0)).unwrap()).unwrap());
}

#[test]
fn nonsense_in_the_config_is_refused_by_field() {
    let folder = tempfile::tempdir().unwrap();
    let path = recording(folder.path(), 1);
    let wrong: [(&str, fn(&mut Config)); 5] = [
        ("source.rate_hz", |c| c.rate_hz = Some(0.0)),
        ("source.rate_hz", |c| c.rate_hz = Some(f64::NAN)),
        ("source.speed", |c| c.speed = -1.0),
        ("source.speed", |c| c.speed = f64::INFINITY),
        ("source.frames", |c| c.frames = None),
    ];
    for (field, change) in wrong {
        let mut config = config(&path, 0.0);
        change(&mut config);
        let error = open(&config).err().expect("refused");
        assert!(error.is_config() && error.to_string().contains(field), "{error}");
    }
    let missing = open(&config(&folder.path().join("none.npy"), 0.0))
        .err()
        .expect("refused");
    assert!(!missing.is_config(), "{missing}");
}
