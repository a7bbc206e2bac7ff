//! What a fleet holds, with a real NATS server: kills while alerts flow, an alert's way to the hub, a thousand access points, a frame's
//! latency while the server is gone. Takes minutes, so none of it is run by default: `make fleet-measured`.

mod kills;
mod latency;
mod link;
mod thousand;

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::process::{Daemon, alerts};

/// Nobody reads a station's log here, and none of its requests is one too many.
const QUIET: &str = "[log]\nlevel = \"off\"\n[api]\nrequests_per_second = 100000\n";

/// `OAPWATCH_FLEET_<name>` from the environment, for a longer or shorter measurement.
fn number(name: &str, usual: u64) -> u64 {
    let name = format!("OAPWATCH_FLEET_{name}");
    let set = std::env::var(name).ok().and_then(|text| text.parse().ok());
    set.unwrap_or(usual)
}

/// The value below which a share `q` of `values` is.
fn quantile(values: &mut [f64], q: f64) -> f64 {
    assert!(!values.is_empty());
    values.sort_unstable_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * q).round() as usize]
}

/// The last minute's load of the machine, for whoever reads the figures.
fn load() -> String {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap();
    text.split(' ').next().unwrap().to_owned()
}

/// Id of an alert that stays open at a station: the first that is.
fn standing_alert(station: &Daemon) -> String {
    let is_open = |a: &&Value| a["state"] != "cleared";
    let list = station.wait_for("/v1/alerts", "open alert", |v| alerts(v).iter().any(|a| is_open(&a)));
    alerts(&list).iter().find(is_open).unwrap()["id"]
        .as_str()
        .unwrap()
        .to_owned()
}

/// A scene whose stranger stands alone from the first second on, so that a station soon has an alert that stands.
pub fn scene(dir: &Path) -> PathBuf {
    let text = "rate_hz = 10.0\n[link]\nintegration_time_s = 0.1\n[claims]\nnoise_m = 0.3\n[effects]\nthermal_noise = {}\n\
                [[user]]\nname = \"u-1\"\nmotion.still = [40, 70]\n\
                [[intruder]]\nname = \"stranger\"\nmotion.still = [-60, -40]\npower_w = 1.0\npresent = { from_s = 0.5 }\n";
    let path = dir.join("stranger.toml");
    std::fs::write(&path, text).unwrap();
    path
}
