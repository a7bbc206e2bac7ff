//! WGS-84: geodetic, earth-centred and local east-north-up coordinates.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// Semi-major axis, m, and flattening of WGS-84 (NIMA TR8350.2, table 3.1).
const A: f64 = 6_378_137.0;
const F: f64 = 1.0 / 298.257_223_563;
const E2: f64 = F * (2.0 - F);
const B: f64 = A * (1.0 - F);

/// A place by latitude, longitude (degrees) and height above the ellipsoid, m.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Geodetic {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    pub height_m: f64,
}

impl Geodetic {
    /// Earth-centred, earth-fixed coordinates, m (Torge and Müller 2012, eq. 4.28).
    pub fn to_ecef(self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude_deg.to_radians().sin_cos();
        let n = A / (1.0 - E2 * sin_lat * sin_lat).sqrt();
        let across = (n + self.height_m) * cos_lat;
        Vector3::new(
            across * cos_lon,
            across * sin_lon,
            (n * (1.0 - E2) + self.height_m) * sin_lat,
        )
    }

    /// The inverse of [`Geodetic::to_ecef`]: Bowring's iteration (1976) on the parametric latitude. Three rounds are exact to
    /// rounding from the sea floor to orbits; the height's formula is Bowring's of 1985, which holds at the poles too.
    pub fn of_ecef(p: Vector3<f64>) -> Self {
        let across = p.x.hypot(p.y);
        let mut parametric = (p.z * A).atan2(across * B);
        let mut latitude = 0.0;
        for _ in 0..3 {
            let (sin, cos) = parametric.sin_cos();
            let second = E2 / (1.0 - E2);
            latitude = (p.z + second * B * sin.powi(3)).atan2(across - E2 * A * cos.powi(3));
            parametric = ((1.0 - F) * latitude.sin()).atan2(latitude.cos());
        }
        let (sin, cos) = latitude.sin_cos();
        Self {
            latitude_deg: latitude.to_degrees(),
            longitude_deg: p.y.atan2(p.x).to_degrees(),
            height_m: across * cos + p.z * sin - A * (1.0 - E2 * sin * sin).sqrt(),
        }
    }
}

/// East, north, up about an origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalAxes {
    origin: Vector3<f64>,
    height_m: f64,
    /// Earth-centred to east, north, up.
    rotation: Matrix3<f64>,
}

impl LocalAxes {
    pub fn at(origin: Geodetic) -> Self {
        let (sin_lat, cos_lat) = origin.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = origin.longitude_deg.to_radians().sin_cos();
        let rotation = Matrix3::new(
            -sin_lon,
            cos_lon,
            0.0,
            -sin_lat * cos_lon,
            -sin_lat * sin_lon,
            cos_lat,
            cos_lat * cos_lon,
            cos_lat * sin_lon,
            sin_lat,
        );
        Self {
            origin: origin.to_ecef(),
            height_m: origin.height_m,
            rotation,
        }
    }

    /// The origin's height, m.
    pub fn height_m(&self) -> f64 {
        self.height_m
    }

    /// East, north, up of a place, m.
    pub fn to_local(&self, place: Geodetic) -> [f64; 3] {
        (self.rotation * (place.to_ecef() - self.origin)).into()
    }

    /// The place at east, north, up, m.
    pub fn to_geodetic(&self, local_m: [f64; 3]) -> Geodetic {
        Geodetic::of_ecef(self.origin + self.rotation.transpose() * Vector3::from(local_m))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back_from_the_sea_floor_to_orbit() {
        for latitude_deg in [-90.0, -89.999, -45.0, -1e-9, 0.0, 12.3, 48.137, 89.9] {
            for height_m in [-11_000.0, 0.0, 520.0, 9000.0, 400_000.0] {
                let place = Geodetic {
                    latitude_deg,
                    longitude_deg: -170.25,
                    height_m,
                };
                let back = Geodetic::of_ecef(place.to_ecef());
                // A micrometre is a hundred-thousandth of the millimetre that is asked for.
                let off = (back.to_ecef() - place.to_ecef()).norm();
                assert!(off < 1e-6 && (back.height_m - height_m).abs() < 1e-6, "{place:?} {off}");
            }
        }
    }

    #[test]
    fn up_is_up() {
        let origin = Geodetic {
            latitude_deg: 48.137,
            longitude_deg: 11.575,
            height_m: 520.0,
        };
        let axes = LocalAxes::at(origin);
        let above = Geodetic {
            height_m: 620.0,
            ..origin
        };
        let [e, n, u] = axes.to_local(above);
        assert!(e.abs() < 1e-8 && n.abs() < 1e-8 && (u - 100.0).abs() < 1e-8);
        let north = Geodetic {
            latitude_deg: 48.138,
            ..origin
        };
        assert!(axes.to_local(north)[1] > 111.0);
    }
}
