//! Claims with a height, from the log to the verdict: a user on a roof is seen where the ray through them meets the ground.

use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

const OPTICS: &str = r#"
[optics]
altitude_m = 300.0
lens_radius_m = 0.05
plane_distance_m = 0.036
pixels = [32, 32]
sensor_size_m = [0.03, 0.03]
spot_sigma_m = 0.001
noise_std_j = 1.0e-6
"#;

/// The beam of "roof" meets the ground at (-100, 60): 30 m up, that is (-90, 54).
const SCENE: &str = r#"
rate_hz = 10.0

[link]
integration_time_s = 0.1
coherence_time_s = 0.01

[effects]
thermal_noise = {}

[[user]]
name = "u-1"
motion.still = [40, 40]

[[user]]
name = "u-2"
motion.still = [30, -70]

[[user]]
name = "roof"
motion.still = [-100, 60]
"#;

const CONFIG: &str = r#"
[world]
origin = { latitude_deg = 48.137, longitude_deg = 11.575, height_m = 520.0, datum = "ellipsoid" }

[source]
kind = "replay"
frames = "frames.npy"
start = "2026-01-01T00:00:00Z"
rate_hz = 10.0
speed = 0.0

[claims]
log = "claims.ndjson"
"#;

fn oapwatch(args: &[&str], folder: &Path) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_oapwatch"));
    let output = command.args(args).current_dir(folder).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

/// Kinds and users of the alerts raised where "roof" claims `place`.
fn raised(folder: &Path, claims: &str, place: &Value) -> Vec<(String, String)> {
    let lines = claims.lines().map(|line| {
        let mut claim: Value = serde_json::from_str(line).unwrap();
        if claim["user"] == "roof" {
            for key in ["x_m", "y_m"] {
                claim.as_object_mut().unwrap().remove(key);
            }
            claim
                .as_object_mut()
                .unwrap()
                .extend(place.as_object().unwrap().clone());
        }
        format!("{claim}\n")
    });
    std::fs::write(folder.join("claims.ndjson"), lines.collect::<String>()).unwrap();
    let events = oapwatch(&["review", "--config", "oapwatch.toml"], folder);
    let events = events.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let raised = events.filter(|event| event["event"] == "alert.raised");
    let word = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    raised
        .map(|event| (word(&event["alert"]["kind"]), word(&event["alert"]["user"])))
        .collect()
}

#[test]
fn a_user_on_a_roof_is_held_against_where_their_beam_meets_the_ground() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    std::fs::write(path.join("scene.toml"), format!("{SCENE}{OPTICS}")).unwrap();
    std::fs::write(path.join("oapwatch.toml"), format!("{CONFIG}{OPTICS}")).unwrap();
    let simulate = [
        "simulate",
        "--scene",
        "scene.toml",
        "--frames",
        "150",
        "--seed",
        "3",
        "--out",
        ".",
    ];
    oapwatch(&simulate, path);
    let claims = std::fs::read_to_string(path.join("claims.ndjson")).unwrap();
    assert!(claims.contains("\"roof\""));

    let local = json!({ "x_m": -90.0, "y_m": 54.0, "z_m": 30.0 });
    assert_eq!(raised(path, &claims, &local), []);
    // (-90, 54, 30) by pymap3d.enu2geodetic and by CartConvert.
    let geodetic = json!({ "latitude_deg": 48.1374855938, "longitude_deg": 11.5737908632, "height_m": 550.0009 });
    assert_eq!(raised(path, &claims, &geodetic), []);
    // Without the height the beam is 11.7 m off.
    let mismatch = [("position_mismatch".to_owned(), "roof".to_owned())];
    let flat = json!({ "x_m": -90.0, "y_m": 54.0 });
    assert_eq!(raised(path, &claims, &flat), mismatch);
    // So is somebody on the ground who claims a roof.
    let lie = json!({ "x_m": -100.0, "y_m": 60.0, "z_m": 30.0 });
    assert_eq!(raised(path, &claims, &lie), mismatch);
}
