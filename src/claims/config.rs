//! `[claims]`: where claims come from, what their fields are called and how many are kept.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::geo::LocalAxes;

/// Confidence of a shape that names none: one standard deviation of a scalar, as positioning systems usually mean it.
pub(super) const DEFAULT_CONFIDENCE: f64 = 0.68;

/// How lines of the log are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// A JSON object with the fields that `[claims.fields]` names.
    #[default]
    Oapwatch,
    /// 3GPP shapes (TS 23.032) as TS 29.572 writes them in JSON.
    Gad,
    /// `DEVICE_LOCATION_UPDATE` of the Cisco Spaces Firehose.
    CiscoSpaces,
    /// Cursor on Target: self-reports, an XML event a line.
    Cot,
    /// Columns that `[claims.fields]` names, after a header.
    Csv,
}

impl Format {
    /// The name in a config or query.
    pub fn named(name: &str) -> Option<Self> {
        serde_json::from_value(Value::from(name)).ok()
    }
}

/// `[claims]`: where claims come from and how their lines are read.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// NDJSON log, followed like `tail -F`.
    pub log: Option<PathBuf>,
    /// How its lines are written.
    pub format: Format,
    /// Probability that a place lies within an uncertainty shape that states none.
    pub confidence: f64,
    /// Names of the fields, for logs of other shapes.
    pub fields: Fields,
    /// The world's local axes, for claims in latitude and longitude; those of `[world]`.
    #[serde(skip)]
    pub axes: Option<LocalAxes>,
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
    pub cov_m2: String,
    pub power_w: String,
    pub state: String,
    /// Height above the world's origin; the ground where it is left out.
    pub z_m: String,
    /// Read instead of `x_m`, `y_m` and `z_m` where a line has them; `[world] origin` places them.
    pub latitude_deg: String,
    pub longitude_deg: String,
    pub height_m: String,
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
            format: Format::default(),
            confidence: DEFAULT_CONFIDENCE,
            fields: Fields::default(),
            axes: None,
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
            cov_m2: "cov_m2".into(),
            power_w: "power_w".into(),
            state: "state".into(),
            z_m: "z_m".into(),
            latitude_deg: "latitude_deg".into(),
            longitude_deg: "longitude_deg".into(),
            height_m: "height_m".into(),
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
        check(
            (0.05..=0.999).contains(&self.confidence),
            "confidence",
            "0.05 to 0.999 (the probability that a place lies within its shape)",
            self.confidence,
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
        Ok(())
    }
}
