//! Why a terrain file cannot be used.

use std::path::PathBuf;

/// A terrain file that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {fault}")]
pub struct Error {
    pub path: PathBuf,
    #[source]
    pub fault: Fault,
}

/// What is wrong with it.
#[derive(Debug, thiserror::Error)]
pub enum Fault {
    #[error("expected a readable file, found: {0}")]
    Unreadable(#[from] std::io::Error),
    #[error("expected a GeoTIFF that can be decoded, found: {0}")]
    Undecodable(#[from] tiff::TiffError),
    #[error("expected {expected}, found {found}")]
    Wrong { expected: &'static str, found: String },
    #[error(
        "expected WGS-84 latitudes and longitudes (EPSG:4326) or UTM on WGS-84 (EPSG:32601 to 32660, 32701 to 32760), found {found}; `gdalwarp -t_srs EPSG:4326 IN OUT` converts"
    )]
    Projection { found: String },
    #[error(
        "expected heights at world.origin ({latitude_deg}°, {longitude_deg}°), found a file that does not reach there"
    )]
    NotCovered { latitude_deg: f64, longitude_deg: f64 },
    #[error("expected heights within {half_m:.0} m of world.origin, found voids only")]
    Empty { half_m: f64 },
}

impl Fault {
    pub(super) fn wrong(expected: &'static str, found: impl Into<String>) -> Self {
        let found = found.into();
        Self::Wrong { expected, found }
    }
}
