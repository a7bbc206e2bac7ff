//! A file of heights, whatever its format: its place on the earth, and windows of its pixels.

use super::error::Fault;
use super::utm::Zone;
use crate::geo::wgs84::Geodetic;

/// Heights, m, outside these are not ground: undeclared voids (−9999, −32768, 3.4·10³⁸).
const LOWEST_M: f64 = -1000.0;
const HIGHEST_M: f64 = 9500.0;

/// A file of heights.
pub trait Raster {
    /// Pixels across and down.
    fn size(&self) -> [usize; 2];

    fn georeference(&self) -> &Georeference;

    /// The heights of a window, row by row, m; NaN where there are none.
    fn read(&mut self, window: Window) -> Result<Vec<f32>, Fault>;
}

/// Pixels from `first`, included, `size` across and down.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    pub first: [usize; 2],
    pub size: [usize; 2],
}

/// What map coordinates are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// Longitude and latitude, degrees.
    Geographic,
    Utm(Zone),
}

/// What a file says that its heights are above.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Vertical {
    /// Nothing: elevation models are above sea level.
    Unstated,
    SeaLevel,
    Ellipsoid,
}

/// Where pixels lie on the earth.
#[derive(Clone, Debug)]
pub struct Georeference {
    pub projection: Projection,
    pub vertical: Vertical,
    /// Map coordinates of the centre of the first pixel.
    first: [f64; 2],
    /// Pixels by map coordinates.
    to_pixels: [[f64; 2]; 2],
    /// Longitude in the middle, degrees: others are taken by whole turns to the nearest.
    middle_deg: f64,
}

impl Georeference {
    /// `first` is the centre of the first pixel, `across` and `down` are the steps to the next, in map coordinates. `None` where they
    /// are not two directions.
    pub fn new(
        (projection, vertical): (Projection, Vertical),
        first: [f64; 2],
        (across, down): ([f64; 2], [f64; 2]),
        size: [usize; 2],
    ) -> Option<Self> {
        let det = across[0] * down[1] - across[1] * down[0];
        let to_pixels = [[down[1] / det, -down[0] / det], [-across[1] / det, across[0] / det]];
        let middle_deg = first[0] + 0.5 * (across[0] * size[0] as f64 + down[0] * size[1] as f64);
        let is_usable = to_pixels.iter().flatten().chain(&first).all(|v| v.is_finite()) && middle_deg.is_finite();
        is_usable.then_some(Self {
            projection,
            vertical,
            first,
            to_pixels,
            middle_deg,
        })
    }

    /// The pixel, across and down, of a place on the earth; the centre of the first is (0, 0).
    pub fn pixel(&self, place: Geodetic) -> [f64; 2] {
        let [east, north] = match self.projection {
            Projection::Utm(zone) => zone.project(place.latitude_deg, place.longitude_deg),
            Projection::Geographic => {
                let turns = ((self.middle_deg - place.longitude_deg) / 360.0).round();
                [place.longitude_deg + 360.0 * turns, place.latitude_deg]
            }
        };
        let [dx, dy] = [east - self.first[0], north - self.first[1]];
        self.to_pixels.map(|[x, y]| x * dx + y * dy)
    }
}

/// A height as it is kept: NaN where it is the file's `void` or cannot be a height.
pub fn height(value: f64, void: Option<f64>) -> f32 {
    let is_void = void.is_some_and(|void| value == void || value as f32 == void as f32);
    match !is_void && (LOWEST_M..=HIGHEST_M).contains(&value) {
        true => value as f32,
        false => f32::NAN,
    }
}
