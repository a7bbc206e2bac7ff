//! `oapwatch locate` on files that are not as they should be: what it says, what it still gives, and its exit code.

#[path = "geo/tiff.rs"]
#[allow(dead_code, reason = "the terrain's own tests use more of it")]
mod tiff;

use std::path::Path;
use std::process::{Command, Output};

const SIDE: usize = 32;

/// A .npy file of `frames` frames of `side` rows, dark but for what `fill` says of each frame.
fn npy(folder: &Path, dict: &str, frames: usize, rows: usize, fill: impl Fn(usize) -> f64) -> std::path::PathBuf {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&(dict.len() as u16).to_le_bytes());
    bytes.extend_from_slice(dict.as_bytes());
    for k in 0..frames {
        bytes.extend((0..rows * SIDE).flat_map(|_| fill(k).to_le_bytes()));
    }
    let path = folder.join("frames.npy");
    std::fs::write(&path, bytes).unwrap();
    path
}

fn dict(descr: &str, fortran: &str, shape: &str) -> String {
    format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n")
}

fn locate(folder: &Path, frames: &Path, more: &str) -> Output {
    let config = folder.join("oapwatch.toml");
    std::fs::write(&config, format!("[optics]\npixels = [{SIDE}, {SIDE}]\n{more}")).unwrap();
    Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(["locate", "--config"])
        .args([&config, frames])
        .output()
        .unwrap()
}

/// What a run that must be refused says.
#[track_caller]
fn refusal(output: &Output, code: i32) -> String {
    assert_eq!(output.status.code(), Some(code));
    assert!(output.stdout.is_empty());
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn lines(output: &Output) -> Vec<serde_json::Value> {
    let text = std::str::from_utf8(&output.stdout).unwrap();
    text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

#[test]
fn files_that_hold_no_frames_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    for (descr, fortran, shape, expected) in [
        (
            "<c16",
            "False",
            "(1, 32, 32)",
            "expected f4, f8, u1 or u2, found \"<c16\"",
        ),
        ("<f8", "True", "(1, 32, 32)", "expected C order, found Fortran order"),
        ("<f8", "False", "(0, 32, 32)", "expected at least one frame"),
        ("<f8", "False", "(1024,)", "shape"),
    ] {
        let path = npy(folder.path(), &dict(descr, fortran, shape), 1, SIDE, |_| 0.0);
        let said = refusal(&locate(folder.path(), &path, ""), 2);
        assert!(said.contains("frames.npy") && said.contains(expected), "{said}");
    }
}

#[test]
fn an_unusable_frame_is_an_error_and_the_next_one_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let header = dict("<f8", "False", "(3, 32, 32)");
    let nan = npy(folder.path(), &header, 3, SIDE, |k| if k == 1 { f64::NAN } else { 0.0 });
    let output = locate(folder.path(), &nan, "");
    assert!(output.status.success());
    let found = lines(&output);
    assert_eq!(found.len(), 3);
    assert!(found[1]["error"].as_str().unwrap().contains("no usable pixel"));
    for k in [0, 2] {
        assert_eq!(found[k]["emitters"], serde_json::json!([]));
    }
}

#[test]
fn frames_of_another_shape_are_each_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let narrow = npy(folder.path(), &dict("<f8", "False", "(2, 16, 32)"), 2, 16, |_| 0.0);
    let found = lines(&locate(folder.path(), &narrow, ""));
    assert_eq!(found.len(), 2);
    for line in found {
        assert_eq!(line["error"], "frame is 32 × 16 pixels, the config says 32 × 32");
    }
}

#[test]
fn a_truncated_file_gives_what_is_whole_and_then_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = npy(folder.path(), &dict("<f8", "False", "(3, 32, 32)"), 2, SIDE, |_| 0.0);
    let output = locate(folder.path(), &path, "");
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(lines(&output).len(), 2);
    assert!(
        std::str::from_utf8(&output.stderr)
            .unwrap()
            .contains("frame 2 is truncated")
    );
}

#[test]
fn an_unknown_key_is_refused_with_the_nearest_known_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = npy(folder.path(), &dict("<f8", "False", "(1, 32, 32)"), 1, SIDE, |_| 0.0);
    let said = refusal(&locate(folder.path(), &path, "spot_sigma = 0.001\n"), 64);
    assert!(said.contains("spot_sigma") && said.contains("spot_sigma_m"), "{said}");
}

#[test]
fn stdin_is_read_and_frames_of_which_none_can_be_used_are_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    let frames = npy(folder.path(), &dict("<f8", "False", "(2, 32, 32)"), 2, SIDE, |_| 0.0);
    let config = folder.path().join("oapwatch.toml");
    std::fs::write(&config, format!("[optics]\npixels = [{SIDE}, {SIDE}]\n")).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(["locate", "--config"])
        .args([config.as_path(), Path::new("-")])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    std::io::Write::write_all(&mut stdin, &std::fs::read(&frames).unwrap()).unwrap();
    drop(stdin);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    assert_eq!(lines(&output).len(), 2);

    let broken = npy(folder.path(), &dict("<f8", "False", "(2, 32, 32)"), 2, SIDE, |_| {
        f64::NAN
    });
    let output = locate(folder.path(), &broken, "");
    assert_eq!(output.status.code(), Some(2));
    assert!(lines(&output).iter().all(|l| l["error"].is_string()));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains("no frame can be used"), "{text}");
    // One that can be used is enough.
    let mixed = npy(folder.path(), &dict("<f8", "False", "(2, 32, 32)"), 2, SIDE, |k| {
        [f64::NAN, 0.0][k]
    });
    assert!(locate(folder.path(), &mixed, "").status.success());
}

#[test]
fn over_terrain_positions_are_where_rays_meet_it() {
    let folder = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
        command.current_dir(&folder).args(args).output().unwrap()
    };
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenes/paper.toml");
    let made = run(&[
        "simulate",
        "--scene",
        scene.to_str().unwrap(),
        "--frames",
        "3",
        "--out",
        ".",
    ]);
    assert!(made.status.success(), "{made:?}");
    // A plateau 100 m above the origin.
    let plateau = |height_m: f64| {
        let mut fields = tiff::place(11.55, 48.16, [0.0005, 0.0005]).to_vec();
        fields.push(tiff::keys(&[(1024, 2), (1025, 1), (2048, 4326)]));
        tiff::image([100, 100], tiff::Kind::I16, false, &fields, |_, _| height_m)
    };
    let scene = std::fs::read_to_string(scene).unwrap();
    let table: toml::Table = scene.parse().unwrap();
    let optics = toml::to_string(&toml::Table::from_iter([(
        "optics".to_owned(),
        table["optics"].clone(),
    )]))
    .unwrap();
    let config = |datum: &str, terrain: &str| {
        let origin = format!("latitude_deg = 48.137, longitude_deg = 11.575, height_m = 500.0, datum = \"{datum}\"");
        let text = format!("{optics}\n[world]\norigin = {{ {origin} }}\n{terrain}\n");
        std::fs::write(folder.path().join("oapwatch.toml"), text).unwrap();
    };
    let located = || run(&["locate", "--config", "oapwatch.toml", "frames.npy"]);

    config("msl", "");
    let plane = lines(&located());
    std::fs::write(folder.path().join("dem.tif"), plateau(600.0)).unwrap();
    config("msl", "terrain = \"dem.tif\"");
    let raised = located();
    assert!(
        raised.status.success() && String::from_utf8_lossy(&raised.stderr).contains("z = 100.0 m"),
        "{raised:?}"
    );
    let altitude_m = table["optics"]["altitude_m"].as_float().unwrap();
    let nearer = (altitude_m - 100.0) / altitude_m;
    let mut compared = 0;
    for (a, b) in plane.iter().zip(lines(&raised)) {
        let (a, b) = (a["emitters"].as_array().unwrap(), b["emitters"].as_array().unwrap());
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(b) {
            let number = |value: &serde_json::Value| value.as_f64().unwrap();
            for key in ["x_m", "y_m"] {
                // The ground falls with the horizon, and is read to some millimetres.
                assert!((number(&b[key]) - number(&a[key]) * nearer).abs() < 1e-2, "{a} {b}");
            }
            let ratio = number(&b["cov_m2"][0][0]) / number(&a["cov_m2"][0][0]);
            assert!((ratio / nearer.powi(2) - 1.0).abs() < 1e-3, "{a} {b}");
            compared += 1;
        }
    }
    assert!(compared > 0);

    let refused = |expected: &str| {
        for args in [
            &["locate", "--config", "oapwatch.toml", "frames.npy"][..],
            &["check", "oapwatch.toml"],
        ] {
            let message = refusal(&run(args), 64);
            assert!(message.contains("terrain") && message.contains(expected), "{message}");
        }
    };
    config("msl", "terrain = \"missing.tif\"");
    refused("missing.tif: expected a readable file");
    std::fs::write(folder.path().join("dem.tif"), plateau(900.0)).unwrap();
    config("msl", "terrain = \"dem.tif\"");
    refused("z = 400.0 m");
    std::fs::write(
        folder.path().join("oapwatch.toml"),
        format!("{optics}\n[world]\nterrain = \"dem.tif\"\n"),
    )
    .unwrap();
    refused("expected [world] origin");
}

#[test]
fn an_origin_places_emitters_on_the_earth_and_changes_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let scene = format!(
        "[optics]\npixels = [{SIDE}, {SIDE}]\n[link]\nintegration_time_s = 0.1\ncoherence_time_s = 0.01\n\
         [[user]]\nname = \"a\"\nmotion.still = [80, -60]\n[[user]]\nname = \"b\"\nmotion.still = [-70, 90]\n"
    );
    std::fs::write(path.join("scene.toml"), scene).unwrap();
    let simulate = [
        "simulate",
        "--scene",
        "scene.toml",
        "--frames",
        "2",
        "--seed",
        "1",
        "--out",
        ".",
    ];
    let simulated = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args(simulate)
        .current_dir(path)
        .output();
    assert!(simulated.unwrap().status.success());
    let frames = path.join("frames.npy");
    let flat = lines(&locate(path, &frames, ""));
    let (lat, lon, height) = (48.137_f64, 11.575, 520.0);
    let world = format!(
        "[world]\norigin = {{ latitude_deg = {lat}, longitude_deg = {lon}, height_m = {height}, datum = \"msl\" }}\n"
    );
    let placed = lines(&locate(path, &frames, &world));
    // The ellipsoid's radii of curvature (Torge and Müller 2012, 4.1), to second order in metres over radius.
    let (sin, cos) = lat.to_radians().sin_cos();
    let e2 = (2.0 - 1.0 / 298.257_223_563) / 298.257_223_563;
    let n = 6_378_137.0 / (1.0 - e2 * sin * sin).sqrt() + height;
    let m = 6_378_137.0 * (1.0 - e2) / (1.0 - e2 * sin * sin).powf(1.5) + height;
    let mut emitters = 0;
    for (flat, placed) in flat.iter().zip(&placed) {
        let [before, after] = [flat, placed].map(|line| line["emitters"].as_array().unwrap());
        assert_eq!(before.len(), 2);
        for (before, after) in before.iter().zip(after) {
            let number = |key: &str| after[key].as_f64().unwrap();
            let (x, y) = (number("x_m"), number("y_m"));
            let latitude = lat + (y / m - x * x * sin / cos / (2.0 * m * n)).to_degrees();
            let longitude = lon + (x / (n * cos) * (1.0 + y * sin / cos / n)).to_degrees();
            let rise = (x * x + y * y) / (2.0 * n);
            // A millimetre.
            assert!((number("latitude_deg") - latitude).abs() < 1e-8, "{after}");
            assert!((number("longitude_deg") - longitude).abs() < 1e-8, "{after}");
            assert!((number("height_m") - height - rise).abs() < 1e-3, "{after}");
            assert_eq!(before["z_m"], 0.0);
            let mut stripped = after.clone();
            for key in ["latitude_deg", "longitude_deg", "height_m"] {
                stripped.as_object_mut().unwrap().remove(key);
            }
            assert_eq!(&stripped, before);
            emitters += 1;
        }
    }
    assert_eq!(emitters, 4);
}
