//! Spots of lenses, known and unknown.

use std::path::Path;

use serde_json::Value;

use super::{SIX, learned, oapwatch, scene_frames};

#[test]
fn an_airy_disc_is_learned_from_frames_of_unknown_positions() {
    let dir = tempfile::tempdir().unwrap();
    let effects = "[effects.spot]\nkind = \"airy\"\nfirst_zero_m = 2.0e-3";
    scene_frames(dir.path(), "spot_sigma_m = 7.5e-4", SIX, effects, 60);
    let out = learned(dir.path());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let report: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    let reduced =
        |key: &str| report[key]["chi2"].as_f64().unwrap() / report[key]["degrees_of_freedom"].as_f64().unwrap();
    // Twelve held-out frames of some 2,000 pixels each scatter by one per cent; spots that overlap closely add a little.
    assert!(reduced("before") > 2.0 && reduced("after") < 1.1, "{report}");
    assert!(
        (report["noise_std_j"].as_f64().unwrap() / 1e-6 - 1.0).abs() < 0.03,
        "{report}"
    );
    // The curve is of the light within the learned reach, and so are the shares of an Airy disc (Rayleigh, 1881) here. Near its
    // edge the template fades, over a fifth of its reach.
    let share = |r: f64| {
        let x = 3.8317 * r / 2.0e-3;
        1.0 - libm::j0(x).powi(2) - libm::j1(x).powi(2)
    };
    let reach = report["spot"]["reach_m"].as_f64().unwrap();
    // Where the light of the brightest spot sinks below a tenth of a pixel's noise.
    assert!((6e-3..12e-3).contains(&reach), "{report}");
    for point in report["spot"]["encircled_energy"].as_array().unwrap() {
        let (r, energy) = (point[0].as_f64().unwrap(), point[1].as_f64().unwrap());
        let expected = share(r) / share(0.9 * reach);
        assert!(
            r > 0.8 * reach || (energy - expected).abs() < 0.01,
            "{r} {energy} {expected}"
        );
    }
    assert!(
        std::fs::read_to_string(dir.path().join("spot.svg"))
            .unwrap()
            .starts_with("<svg")
    );

    // What was written is read back and names the shape.
    let device = std::fs::read_to_string(dir.path().join("device.toml")).unwrap();
    let source = "[source]\nkind = \"replay\"\nframes = \"frames.npy\"\n";
    let calibrated = format!("{device}calibration = \"calibration.toml\"\n{source}");
    std::fs::write(dir.path().join("calibrated.toml"), calibrated).unwrap();
    let out = oapwatch(&[&"check", &dir.path().join("calibrated.toml")]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let text = std::fs::read_to_string(dir.path().join("calibration.toml")).unwrap();
    assert!(text.contains("[spot.shape]") && text.contains("error ="), "{text}");
}

/// Coma on a small sensor: no shape is the same everywhere, and the config's width is that of the core without it.
#[test]
fn a_comatic_lens_is_learned_from_its_wavefront() {
    let dir = tempfile::tempdir().unwrap();
    let effects = "[effects.spot]\nkind = \"zernike\"\nfirst_zero_m = 2.2e-3\n\
        [[effects.spot.term]]\nnoll = 8\nwaves = [0.0, 0.12]\n\
        [[effects.spot.term]]\nnoll = 7\nwaves = [0.0, 0.0, 0.12]";
    scene_frames(dir.path(), "spot_sigma_m = 7.5e-4", SIX, effects, 100);
    let out = learned(dir.path());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let report: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    let after = &report["after"];
    let reduced = after["chi2"].as_f64().unwrap() / after["degrees_of_freedom"].as_f64().unwrap();
    assert!(reduced < 1.15, "{report}");
    let wavefront = &report["spot"]["wavefront"];
    assert!(
        (wavefront["first_zero_m"].as_f64().unwrap() / 2.2e-3 - 1.0).abs() < 0.03,
        "{report}"
    );
    // 0.12 waves at the edge along both axes; the simulator mixes images between seven places of the field.
    let coma = 0.12 * (2.0f64 / 3.0).sqrt();
    assert!(
        (wavefront["coma"].as_f64().unwrap() / coma - 1.0).abs() < 0.1,
        "{report}"
    );
    assert!(report["gain_scatter"].is_null(), "{report}");

    let device = std::fs::read_to_string(dir.path().join("device.toml")).unwrap();
    let calibrated = dir.path().join("calibrated.toml");
    std::fs::write(&calibrated, format!("{device}calibration = \"calibration.toml\"\n")).unwrap();
    let count = |config: &Path| {
        let out = oapwatch(&[&"locate", &"--config", &config, &dir.path().join("frames.npy")]);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let answers: Vec<serde_json::Value> = serde_json::Deserializer::from_slice(&out.stdout)
            .into_iter()
            .map(Result::unwrap)
            .collect();
        answers
            .iter()
            .map(|a| a["emitters"].as_array().unwrap().len())
            .sum::<usize>()
    };
    // Of six hundred some are too near to each other to be told apart.
    let (before, found) = (count(&dir.path().join("device.toml")), count(&calibrated));
    assert!((560..=602).contains(&found), "{found}, not calibrated {before}");
}

/// Astigmatism that grows with the square of the field and turns as one goes around: a start that is the same everywhere ends beside it.
/// The wavefront that 60 frames of six beams through a lens teach.
fn wavefront_of(lens: &str) -> Value {
    let dir = tempfile::tempdir().unwrap();
    scene_frames(dir.path(), "spot_sigma_m = 7.5e-4", SIX, lens, 60);
    let out = learned(dir.path());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let report: Value = serde_json::from_slice(&out.stdout).unwrap();
    report["spot"]["wavefront"].clone()
}

#[test]
fn astigmatism_that_turns_with_the_field_is_learned() {
    let wavefront = wavefront_of(
        "[effects.spot]\nkind = \"zernike\"\nfirst_zero_m = 2.2e-3\n\
        [[effects.spot.term]]\nnoll = 6\nwaves = [0.0, 0.0, 0.0, 0.1, 0.0, -0.1]\n\
        [[effects.spot.term]]\nnoll = 5\nwaves = [0.0, 0.0, 0.0, 0.0, 0.2]",
    );
    // The mean of (u² + v²)² over the sensor is 28/45.
    let astigmatism = 0.1 * (28.0f64 / 45.0).sqrt();
    for (key, expected) in [("first_zero_m", 2.2e-3), ("astigmatism", astigmatism)] {
        let ratio = wavefront[key].as_f64().unwrap() / expected;
        assert!((ratio - 1.0).abs() < 0.03, "{key}: {wavefront}");
    }
    assert!(wavefront["rim"].is_null(), "{wavefront}");
}

#[test]
fn an_aperture_that_is_covered_and_cut_off_is_learned() {
    let wavefront = wavefront_of(
        "[effects.spot]\nkind = \"zernike\"\nfirst_zero_m = 2.0e-3\nobscuration = 0.35\n\
        rim = { moves = 0.5, radius = 1.1 }\n\
        [[effects.spot.term]]\nnoll = 4\nwaves = [0.0, 0.0, 0.0, 0.06, 0.0, 0.06]",
    );
    let at = |value: &Value| value.as_f64().unwrap();
    assert!(
        (at(&wavefront["first_zero_m"]) / 2.0e-3 - 1.0).abs() < 0.02,
        "{wavefront}"
    );
    assert!((at(&wavefront["obscuration"]) - 0.35).abs() < 0.05, "{wavefront}");
    // With the sign of the defocus the rim may move the other way: the images are the same.
    let rim = &wavefront["rim"];
    let least_open = at(&rim["radius"]) - at(&rim["moves"]).abs();
    assert!((least_open - 0.6).abs() < 0.06, "{wavefront}");
}

#[test]
fn a_gaussian_that_is_known_is_not_calibrated_again() {
    let dir = tempfile::tempdir().unwrap();
    scene_frames(dir.path(), "spot_sigma_m = 7.5e-4", SIX, "", 50);
    let out = learned(dir.path());
    let text = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{text}");
    assert!(text.contains("is as good as the learned one"), "{text}");
    assert!(!dir.path().join("calibration.toml").exists());
}
