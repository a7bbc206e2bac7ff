//! `oapwatch locate` of a camera that moves: the poses that a recording holds, and the smear within an exposure.

use std::path::Path;
use std::process::{Command, Output};

use oapwatch::frames::Arrivals;
use oapwatch::frames::record::{Config, Recorder};
use oapwatch::scene::{Plan, Scene};
use serde_json::Value;

/// A platform that sways; two users who stand still.
fn scene(period_s: f64, more: &str) -> String {
    format!(
        "[optics]\npixels = [32, 32]\n[link]\nintegration_time_s = 0.1\ncoherence_time_s = 0.01\n{more}\n\
         [platform]\nmount.yaw_deg = 30.0\nvelocity_m_s = [2.0, -1.0, 0.0]\n\
         sway = {{ amplitude_deg = [6, 5], period_s = [{period_s:?}, {period_s:?}] }}\n\
         [[user]]\nname = \"a\"\nmotion.still = [30, -40]\n[[user]]\nname = \"b\"\nmotion.still = [-30, 50]\n"
    )
}

fn oapwatch(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
    command.args(args).current_dir(folder).output().unwrap()
}

fn lines(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{output:?}");
    let text = std::str::from_utf8(&output.stdout).unwrap();
    text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

#[test]
fn a_recording_is_located_with_the_poses_that_it_holds() {
    let folder = tempfile::tempdir().unwrap();
    let text = scene(8.0, "");
    let scene: Scene = toml::from_str(&text).unwrap();
    let plan = Plan::compile(&scene, 1)
        .unwrap()
        .starting_at("2026-11-21T08:00:00Z".parse().unwrap());
    let config = Config {
        folder: Some(folder.path().join("recorded")),
        ..Config::default()
    };
    let mut recorder = Recorder::start(&config).unwrap().expect("a folder");
    let frames = 20;
    for made in (0..frames).map(|k| plan.frame(k)) {
        let arrivals = Arrivals {
            claims: Vec::new(),
            poses: made.poses,
        };
        assert!(recorder.frame(&made.frame, &arrivals).is_some());
    }
    drop(recorder);
    let config = "[optics]\npixels = [32, 32]\n[source]\nkind = \"replay\"\nframes = \"recorded\"\n\
                  [platform]\nkind = \"frames\"\nmount.yaw_deg = 30.0\n\
                  [world]\norigin = { latitude_deg = 48.137, longitude_deg = 11.575, height_m = 520.0, datum = \"msl\" }\n";
    std::fs::write(folder.path().join("oapwatch.toml"), config).unwrap();
    let located = lines(&oapwatch(
        folder.path(),
        &["locate", "--config", "oapwatch.toml", "recorded"],
    ));
    assert_eq!(located.len(), frames as usize);
    for line in &located {
        let emitters = line["emitters"].as_array().expect("a pose is there");
        assert_eq!(emitters.len(), 2, "{line}");
        for e in emitters {
            let near = [[30.0, -40.0], [-30.0, 50.0]]
                .map(|[x, y]: [f64; 2]| (number(&e["x_m"]) - x).hypot(number(&e["y_m"]) - y))
                .into_iter()
                .fold(f64::INFINITY, f64::min);
            // The poses' own error is in the covariance: 0.01 rad and 2 m, where none is stated.
            let sigma_m = (number(&e["cov_m2"][0][0]) + number(&e["cov_m2"][1][1])).sqrt();
            assert!(near < 4.0 * sigma_m && (2.0..10.0).contains(&sigma_m), "{near} {e}");
            assert_eq!(e["z_m"], 0.0);
            assert!((number(&e["latitude_deg"]) - 48.137).abs() < 1e-3 && (number(&e["height_m"]) - 520.0).abs() < 0.1);
        }
    }
    // A file of the same frames whose poses are not beside it has no positions, and says so.
    let file = std::fs::read_dir(folder.path().join("recorded")).unwrap();
    let file = file
        .map(|e| e.unwrap().path())
        .find(|p| p.extension().is_some_and(|e| e == "npy"))
        .unwrap();
    std::fs::copy(file, folder.path().join("alone.npy")).unwrap();
    let alone = oapwatch(folder.path(), &["locate", "--config", "oapwatch.toml", "alone.npy"]);
    assert_eq!(alone.status.code(), Some(2));
    assert!(
        String::from_utf8_lossy(&alone.stdout).contains("no pose of the platform"),
        "{alone:?}"
    );
}

#[test]
fn the_smear_of_a_sway_is_known_where_the_exposure_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::write(
        path.join("scene.toml"),
        scene(1.5, "[effects]\nmotion_blur = {}\nthermal_noise = {}"),
    )
    .unwrap();
    let simulated = oapwatch(
        path,
        &["simulate", "--scene", "scene.toml", "--frames", "30", "--out", "."],
    );
    assert!(simulated.status.success(), "{simulated:?}");
    // A beam may be seen from beyond the sensor's edge.
    let truth = std::fs::read_to_string(path.join("truth.ndjson")).unwrap();
    let in_view: Vec<usize> = truth
        .lines()
        .map(|line| line.matches("\"in_view\":true").count())
        .collect();
    let misfit = || {
        let located = lines(&oapwatch(path, &["locate", "--config", "oapwatch.toml", "frames.npy"]));
        let misfits: Vec<f64> = located.iter().map(|line| number(&line["reduced_chi2"])).collect();
        let right = located.iter().zip(&in_view).filter(|(line, in_view)| {
            let emitters = line["emitters"].as_array();
            emitters.is_some_and(|e| (**in_view..=2).contains(&e.len()))
        });
        (misfits.iter().sum::<f64>() / misfits.len() as f64, right.count())
    };
    let config = std::fs::read_to_string(path.join("oapwatch.toml")).unwrap();
    assert!(config.contains("exposure_s = 0.1"), "{config}");
    assert!(in_view.iter().sum::<usize>() > 55, "{in_view:?}");
    let (known, known_right) = misfit();
    std::fs::write(path.join("oapwatch.toml"), config.replace("exposure_s = 0.1\n", "")).unwrap();
    let (unknown, unknown_right) = misfit();
    println!("reduced chi2 {unknown} ({unknown_right} right) without, {known} ({known_right} right) with the exposure");
    assert!(
        known_right == 30 && unknown_right < 30,
        "{known} {unknown} {known_right} {unknown_right}"
    );
}
