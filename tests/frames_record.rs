//! What is recorded is replayed as it was; the ring stays within its limit; evidence lies around its alert.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use ndarray::Array2;
use oapwatch::claim::{Claim, ClaimState};
use oapwatch::frame::Frame;
use oapwatch::frames::record::{Config, Recorder};
use oapwatch::frames::{self, Arrivals, Error, FrameSource, Next, SourceKind, npy};
use oapwatch::pose::{Pose, PoseSigmas, attitude_of};

fn time(tenths: i64) -> Timestamp {
    let start: Timestamp = "2026-11-21T08:00:00Z".parse().unwrap();
    start + SignedDuration::from_millis(100 * tenths)
}

fn frame(k: u64) -> Frame {
    Frame {
        index: 3 * k,
        time: time(k as i64),
        pixels: Array2::from_shape_fn((4, 5), |(y, x)| {
            (k as f64 + 0.1) * 1e-9 + y as f64 / 3.0 - x as f64 * f64::EPSILON
        }),
        masked: (k % 2 == 1).then(|| Array2::from_shape_fn((4, 5), |(y, x)| y == 1 && x as u64 == k % 5)),
        exposure_s: (k % 3 == 1).then_some(0.02),
        energy_scale: if k % 3 == 1 { 16.0 } else { 1.0 },
    }
}

fn claim(k: u64) -> Claim {
    Claim {
        time: time(k as i64),
        user: format!("u-{}", k % 3),
        // All 17 digits of it: a reader that rounds twice would show.
        x_m: 100.0 * (k as f64 + 0.1).sin(),
        y_m: -80.0 / 3.0,
        z_m: None,
        sigma_m: Some(1.0),
        cov_m2: None,
        power_w: None,
        state: ClaimState::Active,
    }
}

/// A pose of a tenth of a second, all of its numbers with 17 digits.
fn pose(tenth: u64) -> Pose {
    let at = tenth as f64 + 0.1;
    Pose {
        time: time(tenth as i64),
        position_m: [at / 3.0, -at / 7.0, 300.0],
        attitude: attitude_of([1.0, 0.1 * at.sin(), 0.1 * at.cos(), at / 9.0]).unwrap(),
        cov: PoseSigmas::default().cov() / 3.0,
    }
}

fn claims(claims: &[Claim]) -> Arrivals {
    claims.to_vec().into()
}

fn config(folder: &Path) -> Config {
    Config {
        folder: Some(folder.to_owned()),
        segment_s: 1.0,
        before_s: 1.5,
        after_s: 0.5,
        ..Config::default()
    }
}

fn replay(path: &Path) -> Result<Box<dyn FrameSource>, Error> {
    let config = frames::Config {
        kind: SourceKind::Replay,
        frames: Some(path.to_owned()),
        speed: 0.0,
        ..frames::Config::default()
    };
    frames::open(&config, &oapwatch::optics::Config::default().camera().unwrap())
}

/// Everything a source gives, with the file each stands in, in a form that can be compared.
fn all(mut source: Box<dyn FrameSource>) -> Vec<(String, Option<String>)> {
    let mut seen = Vec::new();
    loop {
        match source.next(Duration::from_secs(1)) {
            Next::End => return seen,
            Next::Nothing => panic!("nothing to wait for at speed 0"),
            next => {
                let file = source
                    .file()
                    .map(|f| f.file_name().unwrap().to_str().unwrap().to_owned());
                seen.push((format!("{next:?}"), file));
            }
        }
    }
}

/// Waits for the disk where a test would outrun it.
fn record(recorder: &mut Recorder, frame: &Frame, arrivals: &Arrivals) -> Arc<Path> {
    loop {
        if let Some(taken) = recorder.frame(frame, arrivals) {
            return taken.file.expect("a disk that works");
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_replay_gives_what_was_recorded_bit_for_bit_over_all_files() {
    let folder = tempfile::tempdir().unwrap();
    let mut recorder = Recorder::start(&config(folder.path())).unwrap().unwrap();
    let mut expected = Vec::new();
    for k in 0..35 {
        let name = |path: Arc<Path>| Some(path.file_name().unwrap().to_str().unwrap().to_owned());
        if k == 12 {
            let path = recorder
                .unusable(36, time(12), "short", &claims(&[claim(12)]))
                .unwrap()
                .file
                .unwrap();
            let next = Next::Unusable {
                index: 36,
                time: time(12),
                reason: "short".into(),
                arrivals: claims(&[claim(12)]),
            };
            expected.push((format!("{next:?}"), name(path)));
            continue;
        }
        let arrivals = Arrivals {
            claims: vec![claim(k); (k % 2) as usize],
            poses: (0..k % 4).map(|i| pose(4 * k + i)).collect(),
        };
        let path = record(&mut recorder, &frame(k), &arrivals);
        expected.push((format!("{:?}", Next::Frame(frame(k), arrivals)), name(path)));
    }
    drop(recorder);
    let seen = all(replay(folder.path()).unwrap());
    assert_eq!(seen.len(), expected.len());
    for (seen, expected) in seen.iter().zip(&expected) {
        assert_eq!(seen, expected);
    }
    let files: std::collections::BTreeSet<_> = seen.iter().map(|(_, file)| file).collect();
    assert_eq!(files.len(), 4, "{files:?}");
}

#[test]
fn the_files_are_valid_while_they_grow_and_after_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let mut recorder = Recorder::start(&config(folder.path())).unwrap().unwrap();
    let path = record(&mut recorder, &frame(0), &Arrivals::default());
    for k in 1..4 {
        record(&mut recorder, &frame(k), &Arrivals::default());
    }
    drop(recorder);
    // A process killed between a frame's pixels and its line, and within a line.
    let index = path.with_extension("frames.ndjson");
    let text = std::fs::read_to_string(&index).unwrap();
    std::fs::write(&index, &text[..text.len() - 20]).unwrap();
    let seen = all(replay(&path).unwrap());
    assert_eq!(seen.len(), 3);
    assert_eq!(npy::Reader::open(&path, None).unwrap().count(), 4);
}

#[test]
fn a_damaged_index_is_named_with_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let mut recorder = Recorder::start(&config(folder.path())).unwrap().unwrap();
    let path = record(&mut recorder, &frame(0), &Arrivals::default());
    record(&mut recorder, &frame(1), &Arrivals::default());
    drop(recorder);
    let index = path.with_extension("frames.ndjson");
    let text = std::fs::read_to_string(&index).unwrap();
    std::fs::write(&index, text.replacen("\"time\"", "\"tome\"", 1)).unwrap();
    let seen = all(replay(&path).unwrap());
    assert_eq!(seen.len(), 1);
    assert!(seen[0].0.contains("line 2"), "{seen:?}");
}

#[test]
fn the_ring_stays_within_its_limit_and_loses_the_oldest() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config(folder.path());
    config.limit_mb = 0.02;
    let mut recorder = Recorder::start(&config).unwrap().unwrap();
    for k in 0..400 {
        record(&mut recorder, &frame(k), &claims(&[claim(k)]));
    }
    drop(recorder);
    let files = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|e| e.unwrap().metadata().unwrap());
    let size: u64 = files.filter(|m| m.is_file()).map(|m| m.len()).sum();
    // The file being written comes on top.
    assert!(size < 30_000, "{size} bytes");
    let seen = all(replay(folder.path()).unwrap());
    assert!(seen.last().unwrap().0.contains(&format!("index: {}", 3 * 399)));
    assert!(seen.len() > 20 && seen.len() < 200, "{}", seen.len());
}

#[test]
fn a_recording_goes_on_where_an_earlier_run_ended() {
    let folder = tempfile::tempdir().unwrap();
    for run in 0..2 {
        let mut recorder = Recorder::start(&config(folder.path())).unwrap().unwrap();
        for k in 0..3 {
            record(&mut recorder, &frame(10 * run + k), &Arrivals::default());
        }
    }
    assert_eq!(all(replay(folder.path()).unwrap()).len(), 6);
}

#[test]
fn evidence_holds_what_lies_around_the_alert_and_what_stood() {
    let folder = tempfile::tempdir().unwrap();
    let mut recorder = Recorder::start(&config(folder.path())).unwrap().unwrap();
    for k in 0..60 {
        let arrivals = Arrivals {
            claims: vec![claim(k)],
            poses: vec![pose(k)],
        };
        record(&mut recorder, &frame(k), &arrivals);
        if k == 40 {
            recorder.evidence("alert-7/../x", time(40));
        }
    }
    drop(recorder);
    let path = folder.path().join("evidence/alert-7____x.npy");
    let mut source = replay(&path).unwrap();
    let Next::Frame(first, arrivals) = source.next(Duration::ZERO) else {
        panic!("a frame")
    };
    assert_eq!(first.time, time(25));
    // Each of three users' last two claims stood; the frame's own follows.
    let expected: Vec<Claim> = (19..=25).map(claim).collect();
    assert_eq!(arrivals.claims, expected);
    // The poses of the second before, and the frame's own.
    let expected: Vec<Pose> = (14..=25).map(pose).collect();
    assert_eq!(arrivals.poses, expected);
    let rest = all(source);
    assert!(
        rest.last().unwrap().0.contains(&format!("index: {}", 3 * 45)),
        "{:?}",
        rest.last()
    );
    assert_eq!(rest.len(), 45 - 25);
}

#[test]
fn a_recorder_whose_disk_fails_names_no_file_and_goes_on_when_it_can() {
    let folder = tempfile::tempdir().unwrap();
    let ring = folder.path().join("ring");
    let mut recorder = Recorder::start(&config(&ring)).unwrap().unwrap();
    record(&mut recorder, &frame(0), &claims(&[claim(0)]));
    std::fs::rename(&ring, folder.path().join("unplugged")).unwrap();
    let mut k = 1;
    let mut until = |is_named: bool| {
        for _ in 0..10_000 {
            k += 1;
            let taken = recorder.frame(&frame(k), &Arrivals::default());
            if taken.is_some_and(|taken| taken.file.is_some() == is_named) {
                return k;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        panic!(
            "10,000 frames later a file {} named",
            if is_named { "is not" } else { "is still" }
        );
    };
    until(false);
    std::fs::create_dir(&ring).unwrap();
    let again = until(true);
    drop(recorder);
    let seen = all(replay(&ring).unwrap());
    assert!(
        seen.iter()
            .any(|(next, _)| next.contains(&format!("index: {},", 3 * again))),
        "{seen:?}"
    );
    // The claim that stood when the disk came back is in the head of the first file.
    assert!(seen[0].0.contains("u-0"), "{}", seen[0].0);
}

#[test]
fn what_cannot_be_replayed_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(replay(folder.path()), Err(Error::NoRecording { .. })));
    let wrong = Config {
        limit_mb: f64::NAN,
        ..config(folder.path())
    };
    let error = Recorder::start(&wrong).unwrap_err();
    assert!(
        error.is_config() && error.to_string().contains("record.limit_mb"),
        "{error}"
    );
    assert!(Recorder::start(&Config::default()).unwrap().is_none());
}

#[test]
fn recordings_and_evidence_are_their_owner_s_whatever_the_umask() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("new/recordings");
    let config = config(&folder);
    let mut recorder = Recorder::start(&config).unwrap().unwrap();
    let mut evidence = None;
    for k in 0..5 {
        let frame = frame(k);
        recorder.frame(&frame, &Arrivals::default()).expect("taken");
        if k == 2 {
            evidence = recorder.evidence("alert-1", frame.time);
        }
    }
    drop(recorder);
    let evidence = evidence.expect("the evidence has a file");
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    for made in [&folder, &folder.join("evidence"), &dir.path().join("new")] {
        assert_eq!(mode(made), 0o700, "{}", made.display());
    }
    let ring = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = ring.filter(|path| path.is_file()).collect();
    files.extend([evidence.to_path_buf(), evidence.with_extension("frames.ndjson")]);
    assert!(files.len() >= 4, "{files:?}");
    for file in files {
        assert_eq!(mode(&file), 0o600, "{}", file.display());
    }
}
