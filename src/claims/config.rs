//! `[claims]`: where claims come from, what their fields are called and how many are kept.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[claims]`: where claims come from and how their lines are read.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// NDJSON log, followed like `tail -F`.
    pub log: Option<PathBuf>,
    /// Names of the fields, for logs of other shapes.
    pub fields: Fields,
    /// Where local (0, 0) lies, for logs in latitude and longitude.
    pub origin: Option<Origin>,
    /// Standard deviation per axis of a claim that does not state one.
    pub default_sigma_m: f64,
    /// Added to every claim's time: the camera's clock minus the network's.
    pub clock_offset_s: f64,
    /// Users remembered at once.
    pub max_users: usize,
    /// At most so much of the log's end is read at the start of a live run, or when the log grows faster than it is read.
    pub tail_bytes: u64,
}

/// Field names of a claim line. A name that starts with `/` is a JSON pointer (RFC 6901).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Fields {
    pub time: String,
    pub user: String,
    pub x_m: String,
    pub y_m: String,
    pub sigma_m: String,
    pub power_w: String,
    pub state: String,
    /// Read instead of `x_m` and `y_m` when `[claims.origin]` is given.
    pub latitude_deg: String,
    pub longitude_deg: String,
}

/// The UAV's nadir on WGS 84; x points east and y north from there, turned by `heading_deg`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    /// Height of the ground above the ellipsoid.
    #[serde(default)]
    pub altitude_m: f64,
    /// Compass bearing of the y axis, clockwise from north.
    #[serde(default)]
    pub heading_deg: f64,
}

/// Why a `[claims]` table cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("claims.{field}: expected {expected}, found {found}")]
pub struct ConfigError {
    pub field: &'static str,
    pub expected: &'static str,
    pub found: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            log: None,
            fields: Fields::default(),
            origin: None,
            default_sigma_m: 1.0,
            clock_offset_s: 0.0,
            max_users: 20_000,
            tail_bytes: 4 << 20,
        }
    }
}

impl Default for Fields {
    fn default() -> Self {
        Self {
            time: "time".into(),
            user: "user".into(),
            x_m: "x_m".into(),
            y_m: "y_m".into(),
            sigma_m: "sigma_m".into(),
            power_w: "power_w".into(),
            state: "state".into(),
            latitude_deg: "latitude_deg".into(),
            longitude_deg: "longitude_deg".into(),
        }
    }
}

impl Config {
    /// Checks every number.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let check = |ok: bool, field, expected, found| match ok {
            true => Ok(()),
            false => Err(ConfigError { field, expected, found }),
        };
        let sigma = self.default_sigma_m;
        check(
            (1e-4..=1e5).contains(&sigma),
            "default_sigma_m",
            "0.0001 to 100000 (metres; a wider claim says nothing)",
            sigma,
        )?;
        let offset = self.clock_offset_s;
        check(
            offset.abs() <= 86_400.0,
            "clock_offset_s",
            "at most a day either way",
            offset,
        )?;
        check(
            (1..=1_000_000).contains(&self.max_users),
            "max_users",
            "1 to 1000000",
            self.max_users as f64,
        )?;
        check(
            (1 << 16..=1 << 30).contains(&self.tail_bytes),
            "tail_bytes",
            "65536 to 1073741824",
            self.tail_bytes as f64,
        )?;
        if let Some(origin) = &self.origin {
            let latitude = origin.latitude_deg;
            check(
                latitude.abs() < 89.0,
                "origin.latitude_deg",
                "between -89 and 89",
                latitude,
            )?;
            let longitude = origin.longitude_deg;
            check(
                longitude.abs() <= 180.0,
                "origin.longitude_deg",
                "between -180 and 180",
                longitude,
            )?;
            check(
                origin.altitude_m.abs() < 10_000.0,
                "origin.altitude_m",
                "within 10 km of the ellipsoid",
                origin.altitude_m,
            )?;
            check(
                origin.heading_deg.abs() <= 360.0,
                "origin.heading_deg",
                "between -360 and 360",
                origin.heading_deg,
            )?;
        }
        Ok(())
    }
}
