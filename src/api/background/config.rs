//! `[api.background]`: the picture or the tiles below the page's map.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::geo::{Geodetic, LocalAxes};

/// `[api.background]`: a picture or tiles; nothing when both are left out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// A PNG, JPEG or WebP file, read once at the start.
    pub picture: Option<PathBuf>,
    /// The picture's upper left, upper right and lower left corner: east and north, m.
    pub corners_m: Option<[[f64; 2]; 3]>,
    /// The same as latitudes and longitudes, degrees; needs `[world] origin`.
    pub corners_deg: Option<[[f64; 2]; 3]>,
    /// A folder of tiles, z/x/y.png (or .jpg, .webp), or an .mbtiles file; needs `[world] origin`.
    pub tiles: Option<PathBuf>,
    /// Shown on the map, as licences of maps ask for.
    pub attribution: Option<String>,
}

/// Why there is no background.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("api.background: expected picture or tiles, found both")]
    Both,
    #[error("api.background.{key}: expected nothing without api.background.picture, found corners")]
    NoPicture { key: &'static str },
    #[error(
        "api.background.picture: expected its corners, either corners_m (east, north) or corners_deg (latitude, longitude), found {found}"
    )]
    Corners { found: &'static str },
    #[error(
        "api.background.{key}: expected the upper left, upper right and lower left corner, finite and not in a line, found {found:?}"
    )]
    NoArea { key: &'static str, found: [[f64; 2]; 3] },
    #[error("api.background.{key}: expected [world] origin, about which places on the earth are drawn, found none")]
    NoOrigin { key: &'static str },
    #[error("api.background.attribution: expected at most {MOST_ATTRIBUTION} characters, found {found}")]
    Attribution { found: usize },
    #[error("api.background.{key}: {path}: expected {expected}, found {found}")]
    File {
        key: &'static str,
        path: PathBuf,
        expected: String,
        found: String,
    },
}

/// Characters of an attribution: a line of the map.
const MOST_ATTRIBUTION: usize = 200;
/// Area spanned by the corners of a picture, m², at least.
const LEAST_AREA_M2: f64 = 1e-6;

impl Config {
    /// Checks what can be checked without opening a file; gives the picture's corners in local metres.
    pub fn validate(&self, axes: Option<&LocalAxes>) -> Result<Option<[[f64; 2]; 3]>, Error> {
        let length = self.attribution.as_ref().map_or(0, |text| text.chars().count());
        if length > MOST_ATTRIBUTION {
            return Err(Error::Attribution { found: length });
        }
        match (&self.picture, &self.tiles) {
            (Some(_), Some(_)) => return Err(Error::Both),
            (None, Some(_)) if axes.is_none() => return Err(Error::NoOrigin { key: "tiles" }),
            _ => {}
        }
        let (key, corners, local) = match (self.corners_m, self.corners_deg) {
            (None, None) if self.picture.is_none() => return Ok(None),
            (None, None) => return Err(Error::Corners { found: "none" }),
            (Some(_), Some(_)) => return Err(Error::Corners { found: "both" }),
            (Some(corners), None) => ("corners_m", corners, corners),
            (None, Some(corners)) => {
                let key = "corners_deg";
                let axes = axes.ok_or(Error::NoOrigin { key })?;
                (key, corners, corners.map(|corner| local_of(axes, corner)))
            }
        };
        if self.picture.is_none() {
            return Err(Error::NoPicture { key });
        }
        let [a, b, c] = local;
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if !(area.abs() >= LEAST_AREA_M2 && area.is_finite()) {
            return Err(Error::NoArea { key, found: corners });
        }
        Ok(Some(local))
    }
}

/// East and north, m, of a latitude and longitude, degrees, at the origin's height.
pub fn local_of(axes: &LocalAxes, [latitude_deg, longitude_deg]: [f64; 2]) -> [f64; 2] {
    let height_m = axes.to_geodetic([0.0; 3]).height_m;
    let [x, y, _] = axes.to_local(Geodetic {
        latitude_deg,
        longitude_deg,
        height_m,
    });
    [x, y]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axes() -> LocalAxes {
        LocalAxes::at(Geodetic {
            latitude_deg: 48.137,
            longitude_deg: 11.575,
            height_m: 520.0,
        })
    }

    #[test]
    fn corners_go_with_a_picture_and_places_on_the_earth_with_an_origin() {
        let square = Some([[-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]]);
        let picture = || Config {
            picture: Some("yard.png".into()),
            ..Config::default()
        };
        assert_eq!(Config::default().validate(None).unwrap(), None);
        let good = Config {
            corners_m: square,
            ..picture()
        };
        assert_eq!(good.validate(None).unwrap(), square);
        let on_earth = Config {
            corners_deg: Some([[48.138, 11.574], [48.138, 11.576], [48.136, 11.574]]),
            ..picture()
        };
        let [upper_left, ..] = on_earth.validate(Some(&axes())).unwrap().expect("a picture");
        assert!(
            (upper_left[1] - 111.2).abs() < 0.1 && (upper_left[0] + 74.4).abs() < 0.1,
            "{upper_left:?}"
        );
        let tiles = Config {
            tiles: Some("tiles".into()),
            ..Config::default()
        };
        assert!(tiles.validate(Some(&axes())).is_ok());
        for (bad, named) in [
            (picture(), "corners"),
            (
                Config {
                    corners_m: square,
                    ..Config::default()
                },
                "corners_m",
            ),
            (
                Config {
                    corners_m: Some([[0.0; 2], [1.0; 2], [2.0; 2]]),
                    ..picture()
                },
                "in a line",
            ),
            (
                Config {
                    corners_m: Some([[f64::NAN; 2]; 3]),
                    ..picture()
                },
                "finite",
            ),
            (on_earth.clone(), "[world] origin"),
            (
                Config {
                    corners_m: square,
                    ..on_earth
                },
                "both",
            ),
            (tiles.clone(), "[world] origin"),
            (
                Config {
                    corners_m: square,
                    tiles: tiles.tiles,
                    ..picture()
                },
                "found both",
            ),
            (
                Config {
                    attribution: Some("©".repeat(201)),
                    ..Config::default()
                },
                "201",
            ),
        ] {
            let message = bad.validate(None).expect_err(named).to_string();
            assert!(
                message.starts_with("api.background") && message.contains(named),
                "{message}"
            );
        }
    }
}
