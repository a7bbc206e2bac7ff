//! What lies below the page's map where it is configured: a picture with its corners, or tiles for maps without the internet.

mod config;
mod tiles;

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use config::local_of;
pub use config::{Config, Error};
use tiles::{Tiles, read_bounded};

use super::extract::Path;
use super::problem::Problem;
use super::state::State;
use super::{conditional, respond};
use crate::geo::LocalAxes;
use crate::hash;

/// Bytes of a picture, which is kept in memory.
const MOST_BYTES: u64 = 32 << 20;

/// A background that has been read or opened.
pub struct Background {
    shown: Shown,
    source: Source,
}

enum Source {
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

/// The media type of a picture, by its first bytes.
fn raster_type(bytes: &[u8]) -> Option<HeaderValue> {
    let is_webp = bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP");
    let name = match bytes {
        _ if bytes.starts_with(b"\x89PNG\r\n\x1a\n") => "image/png",
        _ if bytes.starts_with(b"\xff\xd8\xff") => "image/jpeg",
        _ if is_webp => "image/webp",
        _ => return None,
    };
    Some(HeaderValue::from_static(name))
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

/// What lies below the page's map
#[utoipa::path(get, path = "/v1/background", tag = "positions",
    responses((status = 200, description = "A picture with its corners, tiles, or nothing", body = Shown)))]
pub async fn description(Shared(state): Shared<State>) -> Response {
    let shown = state.background.as_ref().map(|background| background.shown.clone());
    respond::json(&shown.unwrap_or_default())
}

/// The picture below the map
#[utoipa::path(get, path = "/v1/background/picture", tag = "positions",
    responses(
        (status = 200, description = "The picture: PNG, JPEG or WebP", body = Vec<u8>, content_type = "image/png"),
        (status = 304, description = "Nothing new since the ETag given in If-None-Match"),
        (status = 404, description = "There is none", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn picture(Shared(state): Shared<State>, headers: HeaderMap) -> Result<Response, Problem> {
    let Some(Source::Picture { bytes, kind, version }) = state.background.as_ref().map(|b| &b.source) else {
        return Err(Problem::not_found("no [api.background] picture is configured"));
    };
    Ok(conditional::answer(&headers, *version, || {
        ([(header::CONTENT_TYPE, kind.clone())], bytes.clone()).into_response()
    }))
}

/// A tile of the map below
#[utoipa::path(get, path = "/v1/background/tiles/{zoom}/{column}/{row}", tag = "positions",
    params(
        ("zoom" = u8, Path, description = "Zoom of the XYZ scheme"),
        ("column" = u32, Path, description = "Column, from the west"),
        ("row" = u32, Path, description = "Row, from the north"),
    ),
    responses(
        (status = 200, description = "The tile: PNG, JPEG or WebP", body = Vec<u8>, content_type = "image/png"),
        (status = 400, description = "No number", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such tile", body = Problem, content_type = "application/problem+json"),
    ))]
pub async fn tile(
    Shared(state): Shared<State>,
    Path((zoom, column, row)): Path<(u8, u32, u32)>,
) -> Result<Response, Problem> {
    let none = || Problem::not_found(format!("there is no tile {zoom}/{column}/{row}"));
    let background: Arc<Background> = state.background.ok_or_else(none)?;
    let read = move || match &background.source {
        Source::Tiles(tiles) => tiles.read(zoom, column, row),
        Source::Picture { .. } => None,
    };
    let bytes = tokio::task::spawn_blocking(read).await.expect("reading does not panic");
    let bytes = bytes.ok_or_else(none)?;
    let kind = raster_type(&bytes).ok_or_else(none)?;
    let kept = HeaderValue::from_static("private, max-age=3600");
    Ok(([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, kept)], bytes).into_response())
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

    #[test]
    fn a_picture_is_one_by_its_first_bytes() {
        assert_eq!(raster_type(b"\x89PNG\r\n\x1a\n").unwrap(), "image/png");
        assert_eq!(raster_type(b"\xff\xd8\xff\xe0").unwrap(), "image/jpeg");
        assert_eq!(raster_type(b"RIFF....WEBPVP8 ").unwrap(), "image/webp");
        assert!(raster_type(b"<svg onload=alert(1)>").is_none() && raster_type(b"").is_none());
    }
}
