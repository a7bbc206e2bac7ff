//! Where an autopilot says that the platform is, and where that is in the world's local axes.

use crate::geo::{self, Datum, LocalAxes};

/// A place by latitude, longitude and height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeaLevelPlace {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
    /// Above mean sea level: autopilots state no other.
    pub sea_level_m: f64,
}

/// What a place is counted from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Origin {
    /// Where the autopilot started, wherever that was.
    Unknown,
    /// Where the autopilot started.
    Start(SeaLevelPlace),
    /// The place itself, or one close by: the autopilot has no axes of its own.
    Passing(SeaLevelPlace),
}

/// Where a sample was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    pub origin: Origin,
    /// East, north, up of the origin, m.
    pub enu_m: [f64; 3],
    /// Height of the sea level above the ellipsoid there, m, where the GNSS receiver states it.
    pub undulation_m: Option<f64>,
}

/// Why a place has none in the local axes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unplaced {
    #[error("the autopilot gives latitudes and longitudes only: set [world] origin")]
    NoWorld,
    #[error(
        "[world] origin is set, but the autopilot has not said where its own origin lies (GPS_GLOBAL_ORIGIN or GLOBAL_POSITION_INT)"
    )]
    NoOrigin,
}

impl Place {
    /// East, north, up of the world's origin, m; of the autopilot's own where the world has none.
    pub fn local_m(&self, world: &geo::Config) -> Result<[f64; 3], Unplaced> {
        let (Some(origin), Some(axes)) = (&world.origin, world.axes()) else {
            return match self.origin {
                Origin::Unknown | Origin::Start(_) => Ok(self.enu_m),
                Origin::Passing(_) => Err(Unplaced::NoWorld),
            };
        };
        let at = match self.origin {
            Origin::Unknown => return Err(Unplaced::NoOrigin),
            Origin::Start(at) | Origin::Passing(at) => at,
        };
        let undulation_m = match origin.datum {
            Datum::Msl => 0.0,
            // The receiver's own, which the autopilot's heights were made with.
            Datum::Ellipsoid => self
                .undulation_m
                .unwrap_or_else(|| geo::undulation_m(at.latitude_deg, at.longitude_deg)),
        };
        let at = geo::Geodetic {
            latitude_deg: at.latitude_deg,
            longitude_deg: at.longitude_deg,
            height_m: at.sea_level_m + undulation_m,
        };
        Ok(axes.to_local(LocalAxes::at(at).to_geodetic(self.enu_m)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: SeaLevelPlace = SeaLevelPlace {
        latitude_deg: 48.137,
        longitude_deg: 11.575,
        sea_level_m: 520.0,
    };

    fn world(datum: Option<Datum>) -> geo::Config {
        geo::Config {
            origin: datum.map(|datum| geo::Origin {
                latitude_deg: 48.137,
                longitude_deg: 11.575,
                height_m: 500.0,
                datum,
            }),
            terrain: None,
        }
    }

    #[test]
    fn heights_are_told_apart_and_places_without_an_origin_refused() {
        let place = |origin| Place {
            origin,
            enu_m: [3.0, 4.0, 100.0],
            undulation_m: Some(47.0),
        };
        let near = |found: Result<[f64; 3], Unplaced>, up: f64| {
            let found = found.unwrap();
            let apart = [found[0] - 3.0, found[1] - 4.0, found[2] - up];
            assert!(apart.iter().all(|d| d.abs() < 1e-6), "{found:?}");
        };
        for origin in [Origin::Start(START), Origin::Passing(START)] {
            near(place(origin).local_m(&world(Some(Datum::Msl))), 120.0);
            near(place(origin).local_m(&world(Some(Datum::Ellipsoid))), 167.0);
        }
        near(place(Origin::Start(START)).local_m(&world(None)), 100.0);
        near(place(Origin::Unknown).local_m(&world(None)), 100.0);
        let refused = |origin, datum| place(origin).local_m(&world(datum)).unwrap_err();
        assert_eq!(refused(Origin::Passing(START), None), Unplaced::NoWorld);
        assert_eq!(refused(Origin::Unknown, Some(Datum::Msl)), Unplaced::NoOrigin);
        let silent = Place {
            undulation_m: None,
            ..place(Origin::Start(START))
        };
        // EGM96 has 45.5 m there.
        let found = silent.local_m(&world(Some(Datum::Ellipsoid))).unwrap()[2];
        assert!((found - 165.5).abs() < 0.5, "{found}");
        assert!(silent.local_m(&world(Some(Datum::Msl))).is_ok());
    }
}
