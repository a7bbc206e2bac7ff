//! A camera of which nothing is known: `capture`, photon transfer and `setup` on frames of the simulator, and what `locate` makes of it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use ndarray::Array2;
use oapwatch::calibrate::photon_transfer::measure;
use oapwatch::frames::npy::{Reader, Writer};
use oapwatch::scene::{Plan, Scene, SimulatedFrame};

/// Twelve steady users whose beams flicker, and a converter of 12 bits.
fn plan(seed: u64) -> Plan {
    plan_with(seed, "", |at| Some(still(at)))
}

fn still([x, y]: [i32; 2]) -> String {
    format!("motion.still = [{x}, {y}]")
}

/// As [`plan`], with other effects and motions, and without the users who have none.
fn plan_with(seed: u64, effects: &str, motion: impl Fn([i32; 2]) -> Option<String>) -> Plan {
    let mut scene = format!(
        "rate_hz = 10.0\n[link]\nintegration_time_s = 0.1\n[effects]\nfading = {{ alpha = 4.0, beta = 2.0 }}\nthermal_noise = {{}}\n\
         shot_noise = {{ quantum_j = {QUANTUM_J:e} }}\n\
         quantisation = {{ bits = 12, joules_per_count = {COUNT_J:e}, black_level_counts = {BLACK} }}\n{effects}\n"
    );
    for (k, motion) in [-90, -30, 30, 90]
        .into_iter()
        .flat_map(|x| [-70, 0, 70].map(|y| [x, y]))
        .filter_map(motion)
        .enumerate()
    {
        scene += &format!("[[user]]\nname = \"u-{k}\"\n{motion}\n");
    }
    let scene: Scene = toml::from_str(&scene).unwrap();
    Plan::compile(&scene, seed).unwrap()
}

const QUANTUM_J: f64 = 1e-7;
const COUNT_J: f64 = 2e-7;
const BLACK: f64 = 60.0;
/// Of the paper's camera: 15 mm of sensor on each side of the axis, 36 mm behind the lens.
const FIELD_OF_VIEW_DEG: &str = "45.2397";

fn oapwatch(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

#[track_caller]
fn good(output: Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// What a command that must fail says.
#[track_caller]
fn refusal(output: Output, code: i32) -> String {
    assert_eq!(output.status.code(), Some(code));
    String::from_utf8(output.stderr).unwrap()
}

/// Counts of a camera, its black level in them.
fn counts(frames: &[SimulatedFrame]) -> Vec<Array2<f64>> {
    let count = |j: f64| (j / COUNT_J + BLACK).round();
    frames.iter().map(|f| f.frame.pixels.mapv(count)).collect()
}

fn write(path: &Path, frames: &[Array2<f64>]) -> PathBuf {
    let mut writer = Writer::create_counts(path, frames[0].dim()).unwrap();
    frames.iter().for_each(|f| writer.push(f.view()).unwrap());
    path.to_owned()
}

#[test]
fn photon_transfer_is_within_three_per_cent_of_the_simulator_s_truth() {
    for seed in [1, 2] {
        let frames: Vec<Array2<f64>> = plan(seed).frames(0, 300).into_iter().map(|f| f.frame.pixels).collect();
        let none_bad = Array2::from_elem(frames[0].dim(), false);
        let found = measure(&frames, f64::INFINITY, &none_bad, Some(0.0)).unwrap();
        let gain = found.gain.unwrap();
        assert!((gain.counts_per_electron / QUANTUM_J - 1.0).abs() < 0.03, "{found:?}");
        let read = (found.read_variance - COUNT_J * COUNT_J / 12.0).sqrt();
        assert!((read / 1e-6 - 1.0).abs() < 0.03, "{found:?}");
        assert!(gain.misfit < 0.1, "{found:?}");
    }
}

#[test]
fn a_config_made_from_a_recording_finds_the_beams_where_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let made = plan(3).frames(0, 60);
    let mut frames = counts(&made);
    for frame in &mut frames {
        frame[[3, 60]] = 900.0;
    }
    write(Path::new(&at("frames.npy")), &frames);
    let found = good(oapwatch(&[
        "setup",
        "--frames",
        &at("frames.npy"),
        "--altitude-m",
        "300",
        "--field-of-view-deg",
        FIELD_OF_VIEW_DEG,
        "--out",
        &at("oapwatch.toml"),
    ]));
    for expected in ["gain", "counts an electron", "bad pixels: 1", "spots: "] {
        assert!(found.contains(expected), "{expected:?} is not in {found}");
    }
    let text = std::fs::read_to_string(at("oapwatch.toml")).unwrap();
    assert!(text.contains("in counts"), "{text}");
    good(oapwatch(&["check", &at("oapwatch.toml")]));
    let located = good(oapwatch(&[
        "locate",
        "--config",
        &at("oapwatch.toml"),
        &at("frames.npy"),
    ]));
    let (mut near, mut expected) = (0, 0);
    for (line, made) in located.lines().zip(&made) {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        let places: Vec<[f64; 2]> = line["emitters"]
            .as_array()
            .unwrap()
            .iter()
            .map(|e| ["x_m", "y_m"].map(|key| e[key].as_f64().unwrap()))
            .collect();
        for truth in &made.truth.emitters {
            expected += 1;
            let is_near = |p: &&[f64; 2]| (p[0] - truth.x_m).hypot(p[1] - truth.y_m) < 1.0;
            near += usize::from(places.iter().any(|p| is_near(&p)));
        }
    }
    assert!(
        expected == 60 * 12 && near >= expected * 99 / 100,
        "{near} of {expected}"
    );
}

#[test]
fn the_shape_of_spots_that_move_is_learned_and_one_that_stands_says_why_not() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let roam = |[x, y]: [i32; 2]| {
        (y != 0).then(|| format!("motion.roam = {{ home_m = [{x}, {y}], spread_m = 8, time_s = 5 }}"))
    };
    let airy = "[effects.spot]\nkind = \"airy\"\nfirst_zero_m = 2.0e-3";
    let one = |at: [i32; 2]| (at == [-30, 0]).then(|| still(at));
    for (plan, said, has_shape) in [
        (plan_with(4, airy, roam), "the spot's shape: ", true),
        (plan_with(5, "", roam), "a Gaussian it is", false),
        (plan_with(6, "", one), "the spot's shape was not learned", false),
    ] {
        write(Path::new(&at("frames.npy")), &counts(&plan.frames(0, 40)));
        let lens = ["--altitude-m", "300", "--field-of-view-deg", FIELD_OF_VIEW_DEG];
        let (frames, out) = (at("frames.npy"), at("oapwatch.toml"));
        let found = good(oapwatch(
            &[&["setup", "--frames", &frames, "--out", &out], &lens[..]].concat(),
        ));
        assert!(found.contains(said), "{said:?} is not in {found}");
        let calibration = std::fs::read_to_string(at("oapwatch.calibration.toml")).unwrap();
        assert_eq!(calibration.contains("[spot.shape]"), has_shape, "{calibration}");
        good(oapwatch(&["check", &out]));
    }
}

#[test]
fn what_is_missing_or_in_the_way_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    // Noise alone: the lens cap is on.
    let noise = |k: usize| {
        Array2::from_shape_fn((32, 32), |(y, x)| {
            let mixed = (k * 7919 + y * 104_729 + x * 1_299_709).wrapping_mul(2_654_435_761);
            60.0 + ((mixed >> 7) % 9) as f64
        })
    };
    let frames: Vec<Array2<f64>> = (0..30).map(noise).collect();
    write(Path::new(&at("frames.npy")), &frames);
    let setup = |more: &[&str], out: &str| {
        let base = ["setup", "--frames", &at("frames.npy"), "--out", out].map(str::to_owned);
        let more = more.iter().map(|m| (*m).to_owned());
        let arguments: Vec<String> = base.into_iter().chain(more).collect();
        oapwatch(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let out = at("oapwatch.toml");
    let altitude = refusal(setup(&[], &out), 2);
    assert!(
        altitude.contains("--altitude-m") && altitude.contains("no terminal"),
        "{altitude}"
    );
    let angle = refusal(setup(&["--altitude-m", "100", "--field-of-view-deg", "400"], &out), 2);
    assert!(
        angle.contains("--field-of-view-deg") && angle.contains("400"),
        "{angle}"
    );
    for counts in ["0", "-5", "nan"] {
        let limit = format!("--saturation-counts={counts}");
        let said = refusal(setup(&["--altitude-m", "100", &limit], &out), 2);
        assert!(said.contains("saturation-counts"), "{counts}: {said}");
    }
    assert!(!Path::new(&out).exists());

    let lens = [
        "--altitude-m",
        "100",
        "--focal-length-m",
        "0.012",
        "--pixel-pitch-m",
        "3e-6",
    ];
    let done = setup(&lens, &out);
    let warned = String::from_utf8_lossy(&done.stderr).into_owned();
    good(done);
    assert!(warned.contains("lens cap"), "{warned}");
    good(oapwatch(&["check", &out]));
    // What setup wrote it replaces; what somebody else wrote stays.
    good(setup(&lens, &out));
    std::fs::write(&out, "[optics]\n").unwrap();
    assert!(refusal(setup(&lens, &out), 2).contains("not written by"));
    assert_eq!(std::fs::read_to_string(&out).unwrap(), "[optics]\n");

    let none = at("none.npy");
    let absent = oapwatch(&["capture", "--device", "/dev/video99", "--frames", "3", "--out", &none]);
    assert!(refusal(absent, 2).contains("/dev/video99"));
    assert!(!Path::new(&none).exists());
}

#[test]
fn frames_are_captured_with_their_times_settings_and_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(at("oapwatch.toml"), "[source]\nkind = \"simulator\"\n").unwrap();
    good(oapwatch(&[
        "capture",
        "--config",
        &at("oapwatch.toml"),
        "--frames",
        "4",
        "--dark",
        "--out",
        &at("frames.npy"),
    ]));
    let reader = Reader::open(at("frames.npy"), None).unwrap();
    assert_eq!((reader.frames(), reader.shape()), (4, (64, 64)));
    let about: toml::Table = std::fs::read_to_string(at("frames.toml")).unwrap().parse().unwrap();
    assert_eq!(about["times"].as_array().unwrap().len(), 4);
    assert_eq!(
        (about["dark"].as_bool(), about["unit"].as_str()),
        (Some(true), Some("joules"))
    );
    assert!(std::fs::read(at("frames.png")).unwrap().starts_with(b"\x89PNG"));
    let left: Vec<_> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|e| e.unwrap().file_name())
        .collect();
    assert!(
        !left.iter().any(|name| name.to_string_lossy().contains("part")),
        "{left:?}"
    );
}
