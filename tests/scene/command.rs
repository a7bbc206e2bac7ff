//! `simulate`, `explain` and `check` from outside.

use std::process::{Command, Output, Stdio};

use oapwatch::frames::npy;

fn oapwatch(arguments: &[&str]) -> Output {
    let command = Command::new(env!("CARGO_BIN_EXE_oapwatch")).args(arguments).output();
    command.expect("the program starts")
}

fn builtin() -> String {
    format!("{}/config/scenes/builtin.toml", env!("CARGO_MANIFEST_DIR"))
}

fn count(path: &std::path::Path) -> u64 {
    std::fs::read_to_string(path).unwrap().lines().count() as u64
}

#[test]
fn simulate_writes_frames_truth_and_claims_and_the_seed_decides() {
    let folder = tempfile::tempdir().unwrap();
    let out = |name: &str| folder.path().join(name);
    for (name, seed) in [("a", "5"), ("b", "5"), ("c", "6")] {
        let path = out(name);
        let done = oapwatch(&[
            "simulate",
            "--scene",
            &builtin(),
            "--frames",
            "30",
            "--seed",
            seed,
            "--out",
            path.to_str().unwrap(),
        ]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    let read = |name: &str, file: &str| std::fs::read(out(name).join(file)).unwrap();
    for file in ["frames.npy", "truth.ndjson", "claims.ndjson"] {
        assert_eq!(read("a", file), read("b", file), "{file}");
    }
    assert_ne!(read("a", "frames.npy"), read("c", "frames.npy"));
    let npy = npy::Reader::open(out("a").join("frames.npy"), None).unwrap();
    assert_eq!((npy.frames(), npy.shape()), (30, (64, 64)));
    assert_eq!(count(&out("a").join("truth.ndjson")), 30);
    // Six users, one claim a second, three seconds.
    assert_eq!(count(&out("a").join("claims.ndjson")), 18);
}

#[test]
fn an_interrupted_recording_is_valid_and_its_files_agree() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let mut child = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
        .args([
            "simulate",
            "--scene",
            &builtin(),
            "--frames",
            "100000000",
            "--out",
            out.to_str().unwrap(),
        ])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let truth = out.join("truth.ndjson");
    for _ in 0..2000 {
        if std::fs::metadata(&truth).is_ok_and(|m| m.len() > 0) {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let killed = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(killed.success());
    assert_eq!(child.wait().unwrap().code(), Some(1));
    let file = out.join("frames.npy");
    let frames = npy::Reader::open(&file, None).unwrap().frames();
    assert!(frames > 0);
    assert_eq!(std::fs::metadata(&file).unwrap().len(), 128 + frames * 64 * 64 * 8);
    assert_eq!(count(&truth), frames);
}

#[test]
fn a_disk_without_room_leaves_valid_files_that_agree() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    // A limit on a file's size stands in for a full disk: 2 MB hold 61 frames and the header.
    let done = Command::new("sh")
        .args([
            "-c",
            "trap '' XFSZ; ulimit -f 3906; exec \"$@\"",
            "sh",
            env!("CARGO_BIN_EXE_oapwatch"),
        ])
        .args([
            "simulate",
            "--frames",
            "1000",
            "--scene",
            &builtin(),
            "--out",
            out.to_str().unwrap(),
        ])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{message}");
    let file = out.join("frames.npy");
    let frames = npy::Reader::open(&file, None).unwrap().frames();
    assert_eq!(frames, (3906 * 512 - 128) / (64 * 64 * 8));
    assert!(
        message.contains(&format!("{frames} of 1000 frames were written")) && message.contains("files are valid"),
        "{message}"
    );
    assert_eq!(message.matches("os error").count(), 1, "{message}");
    assert_eq!(std::fs::metadata(&file).unwrap().len(), 128 + frames * 64 * 64 * 8);
    assert_eq!(count(&out.join("truth.ndjson")), frames);
}

#[test]
fn a_bad_scene_ends_with_64_and_names_the_field() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bad.toml");
    std::fs::write(&file, "[link]\npower_w = -1.0\n").unwrap();
    for command in [
        vec![
            "simulate",
            "--frames",
            "1",
            "--out",
            folder.path().to_str().unwrap(),
            "--scene",
            file.to_str().unwrap(),
        ],
        vec!["explain", file.to_str().unwrap()],
    ] {
        let done = oapwatch(&command);
        assert_eq!(done.status.code(), Some(64));
        let message = String::from_utf8_lossy(&done.stderr);
        assert!(
            message.contains("link.power_w: expected a positive finite number, found -1"),
            "{message}"
        );
    }
}

#[test]
fn explain_names_every_effect_and_draws_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("frame.svg");
    let done = oapwatch(&[
        "explain",
        &builtin(),
        "--picture",
        picture.to_str().unwrap(),
        "--frame",
        "60",
    ]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let text = String::from_utf8_lossy(&done.stdout);
    for effect in oapwatch::scene::Effect::TABLES {
        assert!(text.contains(effect.name()), "{}", effect.name());
    }
    let svg = std::fs::read_to_string(picture).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("u-1") && svg.contains("eavesdropper"));
}

#[test]
fn simulate_writes_a_config_that_review_runs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    let config = folder.path().join("oapwatch.toml");
    let simulate = || {
        let done = oapwatch(&["simulate", "--scene", &builtin(), "--frames", "90", "--out", path]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    };
    simulate();
    let checked = oapwatch(&["check", "--json", config.to_str().unwrap()]);
    let checked: serde_json::Value = serde_json::from_slice(&checked.stdout).unwrap();
    assert_eq!(checked["valid"], true, "{checked}");
    assert_eq!(checked["warnings"], serde_json::json!([]), "{checked}");
    let reviewed = oapwatch(&["review", "--config", config.to_str().unwrap()]);
    assert!(
        reviewed.status.success(),
        "{}",
        String::from_utf8_lossy(&reviewed.stderr)
    );
    // The eavesdropper comes five seconds after the start; everybody else is where they claim to be.
    let text = String::from_utf8(reviewed.stdout).unwrap();
    let raised: Vec<serde_json::Value> = text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert!(
        raised.iter().any(|e| e["alert"]["kind"] == "unclaimed_emitter"),
        "{text}"
    );
    // A recording that was cut short is said to be, after all that it says.
    let frames = folder.path().join("frames.npy");
    let whole = std::fs::metadata(&frames).unwrap().len();
    std::fs::File::options()
        .write(true)
        .open(&frames)
        .unwrap()
        .set_len(whole - 1)
        .unwrap();
    let reviewed = oapwatch(&["review", "--config", config.to_str().unwrap()]);
    let said = String::from_utf8_lossy(&reviewed.stderr);
    assert_eq!(reviewed.status.code(), Some(2));
    assert!(
        said.contains("frame 89 is truncated") && !reviewed.stdout.is_empty(),
        "{said}"
    );
    std::fs::write(&config, "# mine\n").unwrap();
    simulate();
    assert_eq!(std::fs::read_to_string(&config).unwrap(), "# mine\n");
}

#[test]
fn a_closed_pipe_ends_a_command_quietly() {
    let program = env!("CARGO_BIN_EXE_oapwatch");
    for command in [
        "completions bash".to_owned(),
        format!("explain {}", builtin()),
        format!("check {}", builtin()),
    ] {
        // The reader is gone before the first line, as with `| head -0`.
        let mut child = Command::new(program)
            .args(command.split_whitespace())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take());
        let done = child.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.success() && text.is_empty(), "{command}: {text}");
    }
}

#[test]
fn explain_and_devices_speak_json() {
    let explained = oapwatch(&["explain", "--json", &builtin()]);
    let object: serde_json::Value = serde_json::from_slice(&explained.stdout).unwrap();
    assert_eq!(object["rate_hz"], 10.0);
    let effects = object["effects"].as_array().unwrap();
    assert!(
        effects
            .iter()
            .all(|e| e["effect"].is_string() && e["reason"].is_string()),
        "{object}"
    );
    let devices = oapwatch(&["devices", "--json"]);
    let list: serde_json::Value = serde_json::from_slice(&devices.stdout).unwrap();
    assert!(list.is_array(), "{list}");
}
