//! A background as it is opened at the start, and what the page needs to draw it.

use axum::body::Bytes;
use axum::http::HeaderValue;
use serde::Serialize;

use super::config::{Config, Error, local_of};
use super::raster::{raster_type, read_bounded};
use super::tiles::Tiles;
use crate::geo::LocalAxes;
use crate::hash;

/// Bytes of a picture, which is kept in memory.
const MOST_BYTES: u64 = 32 << 20;

/// A background that has been read or opened.
pub struct Background {
    pub shown: Shown,
    pub source: Source,
}

/// Where pictures come from.
pub enum Source {
    Picture {
        bytes: Bytes,
        kind: HeaderValue,
        version: u64,
    },
    Tiles(Tiles),
}

/// What the page needs to draw a background. One of `picture` and `tiles` is there, or neither.
#[derive(Clone, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct Shown {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub picture: Option<ShownPicture>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tiles: Option<ShownTiles>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attribution: Option<String>,
}

/// A picture at `/v1/background/picture`.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct ShownPicture {
    /// Upper left, upper right and lower left corner: east and north, m.
    pub corners_m: [[f64; 2]; 3],
}

/// Tiles at `/v1/background/tiles/{zoom}/{column}/{row}`.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct ShownTiles {
    pub min_zoom: u8,
    pub max_zoom: u8,
    /// East and north, m, of a place (u, v) of the map, each 0 to 1, v from the north: east = a·u + b·v + c, north = d·u + e·v + f, as
    /// [[a, b, c], [d, e, f]]. Exact at the origin; 0.1 m off at 1 km from there, 2 m at 5 km, in middle latitudes.
    pub to_local_m: [[f64; 3]; 2],
}

impl Background {
    /// Reads or opens what a config names; `None` where it names nothing.
    pub fn open(config: &Config, axes: Option<&LocalAxes>) -> Result<Option<Self>, Error> {
        let corners_m = config.validate(axes)?;
        let mut shown = Shown {
            attribution: config.attribution.clone(),
            ..Shown::default()
        };
        let source = match (&config.picture, &config.tiles, corners_m, axes) {
            (Some(path), _, Some(corners_m), _) => {
                let refuse = |found: String| Error::File {
                    key: "picture",
                    path: path.clone(),
                    expected: format!("a PNG, JPEG or WebP file of at most {} MiB", MOST_BYTES >> 20),
                    found,
                };
                let bytes = read_bounded(path, MOST_BYTES).map_err(|e| refuse(e.to_string()))?;
                let bytes = bytes.ok_or_else(|| refuse("a larger one".to_owned()))?;
                let kind = raster_type(&bytes).ok_or_else(|| refuse("something else".to_owned()))?;
                shown.picture = Some(ShownPicture { corners_m });
                Source::Picture {
                    version: hash::fnv1a(bytes.iter().copied()),
                    kind,
                    bytes: bytes.into(),
                }
            }
            (_, Some(path), _, Some(axes)) => {
                let tiles = Tiles::open(path)?;
                shown.tiles = Some(ShownTiles {
                    min_zoom: tiles.zooms[0],
                    max_zoom: tiles.zooms[1],
                    to_local_m: mercator_to_local(axes),
                });
                Source::Tiles(tiles)
            }
            _ => return Ok(None),
        };
        Ok(Some(Self { shown, source }))
    }
}

/// The linear map from web Mercator (EPSG:3857), as [`ShownTiles::to_local_m`] has it, that is exact at the origin.
fn mercator_to_local(axes: &LocalAxes) -> [[f64; 3]; 2] {
    use std::f64::consts::{PI, TAU};
    // A step of 40 m at the equator: rounding 10⁻⁹ m, third derivative 10⁻⁶ m.
    const STEP: f64 = 1e-6;
    let origin = axes.to_geodetic([0.0; 3]);
    let latitude = origin.latitude_deg.to_radians();
    let u = origin.longitude_deg / 360.0 + 0.5;
    let v = 0.5 - latitude.tan().asinh() / TAU;
    let place = |u: f64, v: f64| {
        let latitude = (PI * (1.0 - 2.0 * v)).sinh().atan();
        local_of(axes, [latitude.to_degrees(), 360.0 * (u - 0.5)])
    };
    let slope = |up: [f64; 2], down: [f64; 2]| [0, 1].map(|k| (up[k] - down[k]) / (2.0 * STEP));
    let by_u = slope(place(u + STEP, v), place(u - STEP, v));
    let by_v = slope(place(u, v + STEP), place(u, v - STEP));
    [0, 1].map(|k| [by_u[k], by_v[k], -by_u[k] * u - by_v[k] * v])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::Geodetic;

    #[test]
    fn the_map_from_mercator_is_within_what_it_says() {
        let axes = LocalAxes::at(Geodetic {
            latitude_deg: 48.137,
            longitude_deg: 11.575,
            height_m: 520.0,
        });
        let [east, north] = mercator_to_local(&axes);
        let apart = |latitude_deg: f64, longitude_deg: f64| {
            let u = longitude_deg / 360.0 + 0.5;
            let v = 0.5 - latitude_deg.to_radians().tan().asinh() / std::f64::consts::TAU;
            let found = [east, north].map(|[a, b, c]| a * u + b * v + c);
            let exact = local_of(&axes, [latitude_deg, longitude_deg]);
            (found[0] - exact[0]).hypot(found[1] - exact[1])
        };
        assert!(apart(48.137, 11.575) < 1e-5);
        assert!(apart(48.137 + 0.0064, 11.575 + 0.0095) < 0.2, "1 km");
        assert!(
            apart(48.137 - 0.032, 11.575 + 0.0475) < 5.0,
            "5 km: {}",
            apart(48.137 - 0.032, 11.575 + 0.0475)
        );
    }
}
