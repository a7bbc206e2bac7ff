//! `[world]`: where local (0, 0, 0) lies on the earth.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::wgs84::{Geodetic, LocalAxes};

/// `[world]`: local axes are east, north, up about `origin`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where local (0, 0, 0) lies; without it everything is local.
    pub origin: Option<Origin>,
    /// GeoTIFF or SRTM tile (`.hgt`) of the ground; without it the ground is the plane z = 0.
    pub terrain: Option<PathBuf>,
}

/// A place on WGS-84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub height_m: f64,
    /// What heights are above, here and everywhere else.
    pub datum: Datum,
}

/// What a height is above. The two differ by up to 106 m, so that it is never guessed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Datum {
    /// The WGS-84 ellipsoid.
    Ellipsoid,
    /// Mean sea level.
    Msl,
}

/// Why a `[world]` table cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("world.origin.{field}: expected {expected}, found {found}")]
    Range {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error("world.terrain: expected [world] origin, about which it is read, found none")]
    NoOrigin,
}

impl Config {
    /// Checks every number.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let Some(origin) = &self.origin else {
            return match self.terrain {
                Some(_) => Err(ConfigError::NoOrigin),
                None => Ok(()),
            };
        };
        let check = |ok: bool, field, expected, found| match ok {
            true => Ok(()),
            false => Err(ConfigError::Range { field, expected, found }),
        };
        let latitude = origin.latitude_deg;
        check(latitude.abs() <= 90.0, "latitude_deg", "-90 to 90", latitude)?;
        let longitude = origin.longitude_deg;
        check(longitude.abs() <= 180.0, "longitude_deg", "-180 to 180", longitude)?;
        let height = origin.height_m;
        check(
            height.abs() <= 10_000.0,
            "height_m",
            "within 10000 (metres) of the datum",
            height,
        )
    }

    /// The local axes, where there is an origin.
    pub fn axes(&self) -> Option<LocalAxes> {
        self.origin.map(|o| LocalAxes::at(o.geodetic()))
    }
}

impl Origin {
    /// Heights are differences from the origin's: that sea level lies up to 106 m off the ellipsoid changes local metres by less
    /// than 2 parts in 10⁵, and its own slope (up to 0.3 m/km) is left out.
    pub fn geodetic(&self) -> Geodetic {
        Geodetic {
            latitude_deg: self.latitude_deg,
            longitude_deg: self.longitude_deg,
            height_m: self.height_m,
        }
    }
}
