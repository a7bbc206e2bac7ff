//! Positions, alerts and footprint opened by geopandas.

use std::path::Path;
use std::process::Command;

use crate::process::{Daemon, alerts};

#[test]
fn geopandas_opens_positions_alerts_and_footprint_without_a_warning() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join("target/systems/bin/python");
    if !python.exists() {
        assert!(std::env::var_os("CI").is_none(), "geopandas is not installed");
        eprintln!("SKIPPED: geopandas is not installed; `make setup-test` installs it");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let origin = "latitude_deg = 48.137, longitude_deg = 11.575, height_m = 520.0, datum = \"ellipsoid\"";
    let daemon = Daemon::start(dir.path(), &format!("[world]\norigin = {{ {origin} }}\n"));
    daemon.wait_for("/v1/alerts?kind=unclaimed_emitter", "alert", |v| !alerts(v).is_empty());
    let opened = Command::new(python)
        .arg(root.join("tests/daemon/geojson.py"))
        .arg(daemon.url())
        .output()
        .unwrap();
    assert!(opened.status.success(), "{}", String::from_utf8_lossy(&opened.stderr));
}
