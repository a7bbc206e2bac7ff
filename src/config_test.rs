//! Keys, paths and combinations that a config may and may not have.

use super::*;

/// The service's config says what the default one says, but where its files are.
#[test]
fn the_installed_config_differs_by_its_files_only() {
    let [default, installed] = [
        include_str!("../config/default.toml"),
        include_str!("../deploy/oapwatch.toml"),
    ]
    .map(|text| text.lines().skip(1));
    assert_eq!(default.clone().count(), installed.clone().count());
    let is_of_a_file = |line: &str| {
        ["/var/lib/oapwatch", "$CREDENTIALS_DIRECTORY"]
            .iter()
            .any(|f| line.contains(f))
    };
    for (default, installed) in default.zip(installed) {
        assert!(
            default == installed || is_of_a_file(installed),
            "{default}\n{installed}"
        );
    }
}

#[test]
fn paths_lead_from_the_config_s_folder_or_to_a_credential() {
    let base = Path::new("/etc/oapwatch");
    let credentials = Some(Path::new("/run/credentials/oapwatch.service"));
    for (written, credentials, expected) in [
        ("token", credentials, "/etc/oapwatch/token"),
        ("/srv/token", credentials, "/srv/token"),
        (
            "$CREDENTIALS_DIRECTORY/oapwatch_token",
            credentials,
            "/run/credentials/oapwatch.service/oapwatch_token",
        ),
        (
            "$CREDENTIALS_DIRECTORY/oapwatch_token",
            None,
            "$CREDENTIALS_DIRECTORY/oapwatch_token",
        ),
        (
            "$CREDENTIALS_DIRECTORY2/x",
            credentials,
            "/etc/oapwatch/$CREDENTIALS_DIRECTORY2/x",
        ),
    ] {
        assert_eq!(located(base, Path::new(written), credentials), Path::new(expected));
    }
}

/// The example with its commented keys and tables in force.
fn in_full(text: &str) -> String {
    let is_setting = |line: &&str| {
        let rest = line.strip_prefix("# ").unwrap_or(line);
        let key = rest.split(" = ").next().unwrap_or_default();
        let is_key = rest.contains(" = ") && key.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        is_key || rest.starts_with('[')
    };
    let lines = text.lines().filter(is_setting);
    lines
        .map(|line| line.trim_start_matches("# ").to_owned() + "\n")
        .collect()
}

/// The keys that serde expects in a table.
fn keys_of(table: &str) -> Vec<String> {
    let error = toml::from_str::<Config>(&format!("{table}\nno_such_key = 1\n")).expect_err("an unknown key");
    let names = error.message().split('`').skip(1).step_by(2).skip(1);
    names.map(str::to_owned).collect()
}

#[test]
fn the_example_configs_name_every_key_and_only_such() {
    for text in [
        include_str!("../config/default.toml"),
        include_str!("../deploy/oapwatch.toml"),
    ] {
        toml::from_str::<Config>(text).unwrap();
        let full = in_full(text);
        toml::from_str::<Config>(&full).unwrap_or_else(|e| panic!("{e}\n{full}"));
        let table: toml::Table = toml::from_str(&full).unwrap();
        let mut tables: Vec<(String, toml::Table)> = vec![(String::new(), table)];
        while let Some((name, table)) = tables.pop() {
            let header = match name.as_str() {
                "" => String::new(),
                "webhook" | "export" | "zone" | "known_light" | "maintenance" => format!("[[{name}]]"),
                name => format!("[{name}]"),
            };
            for key in keys_of(&header) {
                assert!(table.contains_key(&key), "{header} lacks {key}");
            }
            for (key, value) in table {
                let below = format!("{name}.{key}").trim_start_matches('.').to_owned();
                match value {
                    toml::Value::Table(inner) => tables.push((below, inner)),
                    toml::Value::Array(list) => {
                        let inner = list.into_iter().filter_map(|v| v.try_into::<toml::Table>().ok());
                        tables.extend(inner.map(|table| (below.clone(), table)));
                    }
                    _ => {}
                }
            }
        }
    }
}

fn loaded(text: &str) -> Result<Config, String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("oapwatch.toml");
    std::fs::write(&path, text).unwrap();
    Config::load(&path).map_err(|e| e.to_string())
}

#[test]
fn a_number_out_of_range_is_refused_with_the_reason() {
    for (text, expected) in [
        ("[optics]\nspot_sigma_m = 10", "optics.spot_sigma_m: expected"),
        ("[optics]\naltitude_m = 3e8", "optics.altitude_m: expected"),
        ("[optics]\nsaturation_j = 1e-9", "optics.saturation_j: expected"),
        ("[source]\nrate_hz = -5", "source.rate_hz: expected"),
        ("[source]\nkind = \"replay\"\nspeed = -1", "source.speed: expected"),
        ("[source.v4l2]\nstall_s = 0", "source.v4l2.stall_s: expected"),
        (
            "[world]\norigin = { latitude_deg = 91, longitude_deg = 0, height_m = 0, datum = \"msl\" }",
            "world.origin.latitude_deg: expected",
        ),
        (
            "[platform]\nmount = { yaw_deg = 1000 }",
            "platform.mount.yaw_deg: expected",
        ),
        ("[platform]\nkind = \"replay\"", "platform.poses: expected"),
        ("[platform]\npose_lost_s = 0", "platform.pose_lost_s: expected"),
        ("[record]\nlimit_mb = 10", "record.folder: expected a folder"),
        ("[record]\nfolder = \"r\"\nbefore_s = 1e9", "record.before_s: expected"),
    ] {
        let error = loaded(text).expect_err(text);
        assert!(error.contains(expected) && error.contains("found"), "{text}: {error}");
    }
    let origin = "[claims.origin]\nlatitude_deg = 48\nlongitude_deg = 11";
    assert!(loaded(origin).expect_err("replaced").contains("[world] origin"));
    let undated = "[world]\norigin = { latitude_deg = 48, longitude_deg = 11, height_m = 5 }";
    assert!(loaded(undated).expect_err("no datum").contains("datum"));
    loaded("[optics]\nspot_sigma_m = 0.01\n[record]\nfolder = \"r\"").unwrap();
}

#[test]
fn keys_without_effect_are_named() {
    let config = loaded(
        "[source]\nkind = \"replay\"\nframes = \"f.npy\"\ndevice = \"/dev/video0\"\nseed = 3\n\
         [estimator]\nname = \"ml\"\nnetwork = \"n.onnx\"\n[monitor]\ntolerated_distance_m = 5000",
    );
    let config = config.unwrap();
    let warnings = config.warnings(&config.camera().unwrap());
    let named: Vec<&str> = warnings.iter().filter_map(|w| w.split_whitespace().next()).collect();
    assert_eq!(
        named,
        [
            "source.device",
            "source.seed",
            "estimator.network",
            "monitor.tolerated_distance_m"
        ]
    );
    let plain = loaded("[source]\nseed = 3").unwrap();
    assert_eq!(plain.warnings(&plain.camera().unwrap()), [""; 0]);
}
