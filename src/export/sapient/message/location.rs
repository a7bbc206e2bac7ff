//! Places, and the axes and datum they are given in.

use prost::{Enumeration, Message, Oneof};

#[derive(Clone, PartialEq, Message)]
pub struct Location {
    /// Longitude.
    #[prost(double, optional, tag = "1")]
    pub x: Option<f64>,
    /// Latitude.
    #[prost(double, optional, tag = "2")]
    pub y: Option<f64>,
    #[prost(double, optional, tag = "3")]
    pub z: Option<f64>,
    #[prost(double, optional, tag = "4")]
    pub x_error: Option<f64>,
    #[prost(double, optional, tag = "5")]
    pub y_error: Option<f64>,
    #[prost(double, optional, tag = "6")]
    pub z_error: Option<f64>,
    #[prost(enumeration = "LocationCoordinateSystem", optional, tag = "7")]
    pub coordinate_system: Option<i32>,
    #[prost(enumeration = "LocationDatum", optional, tag = "8")]
    pub datum: Option<i32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum LocationCoordinateSystem {
    Unspecified = 0,
    LatLngDegM = 1,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Enumeration)]
pub enum LocationDatum {
    Unspecified = 0,
    Wgs84Ellipsoid = 1,
    Wgs84Geoid = 2,
}

#[derive(Clone, PartialEq, Oneof)]
pub enum Place {
    #[prost(message, tag = "6")]
    Location(Location),
}

#[derive(Clone, PartialEq, Message)]
pub struct LocationType {
    #[prost(oneof = "LocationUnits", tags = "1")]
    pub units: Option<LocationUnits>,
    #[prost(oneof = "Datum", tags = "3")]
    pub datum: Option<Datum>,
}

#[derive(Clone, PartialEq, Oneof)]
pub enum LocationUnits {
    #[prost(enumeration = "LocationCoordinateSystem", tag = "1")]
    Location(i32),
}

#[derive(Clone, PartialEq, Oneof)]
pub enum Datum {
    #[prost(enumeration = "LocationDatum", tag = "3")]
    Location(i32),
}
