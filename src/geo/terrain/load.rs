//! Reads the terrain about the origin from a file, onto a grid of local metres.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

use super::error::{Error, Fault};
use super::geotiff::GeoTiff;
use super::hgt::Hgt;
use super::raster::{Raster, Vertical, Window};
use super::surface::Terrain;
use crate::geo::config::{Config, Datum, Origin};
use crate::geo::geoid::undulation_m;
use crate::geo::wgs84::LocalAxes;

/// How far from the origin ground is kept, m.
const HALF_M: f64 = 20_000.0;
/// Most nodes from the origin to each side: 67 MB, and 2 km of a model with pixels of a metre.
const MOST_NODES: f64 = 2048.0;
/// Pixels, m, that are a terrain about a camera's view and no mistake of units.
const FINEST_M: f64 = 0.05;
const COARSEST_M: f64 = 1000.0;
/// Most pixels that are read.
const MOST_PIXELS: usize = 1 << 26;
/// Map coordinates are exact at nodes this far apart and linear between: off by d²/8R along each axis, 5 mm.
const ANCHORS_M: f64 = 500.0;
/// A height at which map coordinates are taken too, m: verticals 20 km apart differ by 3 mrad.
const UP_M: f64 = 1000.0;
/// Ground at the origin that is farther from z = 0 is warned of, m: models are off by 5 to 10 m.
const ODD_ORIGIN_M: f64 = 10.0;

impl Terrain {
    /// Reads what a config names; `None` where it names none or there is no origin.
    pub fn of_config(world: &Config) -> Result<Option<Self>, Error> {
        let (Some(path), Some(origin)) = (&world.terrain, &world.origin) else {
            return Ok(None);
        };
        let fault = |fault| Error {
            path: path.clone(),
            fault,
        };
        let file = File::open(path).map_err(|e| fault(e.into()))?;
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        Self::read(BufReader::new(file), name, origin).map(Some).map_err(fault)
    }

    /// Reads a file; its name says which format it has, and of an SRTM tile where it lies.
    ///
    /// # Errors
    /// It cannot be decoded, its place or heights cannot be taken for what they are, or it does not reach to the origin.
    pub fn read(reader: impl Read + Seek, name: &str, origin: &Origin) -> Result<Self, Fault> {
        let extension = Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default();
        match extension.to_ascii_lowercase().as_str() {
            "hgt" => sampled(&mut Hgt::open(reader, name)?, origin),
            "tif" | "tiff" => sampled(&mut GeoTiff::open(reader)?, origin),
            _ => Err(Fault::wrong(
                "a file that ends in .tif, .tiff or .hgt",
                format!("{name:?}"),
            )),
        }
    }

    /// What of the terrain the operator should know.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        if let Some((share, nearest_m)) = self.voids() {
            let (percent, half_m) = (100.0 * share, self.half_m());
            warnings.push(format!(
                "world.terrain: {percent:.2} % of the square within {half_m:.0} m of the origin have no height (voids, or beyond the file), the nearest {nearest_m:.0} m from it: a beam there has no position"
            ));
        }
        if let Some(ground) = self.at([0.0, 0.0])
            && ground.z_m.abs() > ODD_ORIGIN_M
        {
            let z_m = ground.z_m;
            warnings.push(format!(
                "world.terrain: the ground at the origin is at z = {z_m:.1} m: z, and [optics] altitude_m, count from world.origin.height_m"
            ));
        }
        warnings
    }
}

/// Where a node of the grid lies in the file: the pixel at z = 0 and its change per metre up, and the height above the file's datum.
#[derive(Clone, Copy, Default)]
struct Anchor {
    pixel: [f64; 2],
    by_up: [f64; 2],
    height_m: f64,
    height_by_up: f64,
}

impl Anchor {
    fn of(raster: &dyn Raster, axes: &LocalAxes, datum: Datum, x: f64, y: f64) -> Self {
        let [low, high] = [0.0, UP_M].map(|z| axes.to_geodetic([x, y, z]));
        let [pixel, above] = [low, high].map(|place| raster.georeference().pixel(place));
        let undulation_m = || undulation_m(low.latitude_deg, low.longitude_deg);
        // Elevation models that say nothing are above the sea.
        let file_above_world_m = match (raster.georeference().vertical, datum) {
            (Vertical::Ellipsoid, Datum::Msl) => undulation_m(),
            (Vertical::SeaLevel | Vertical::Unstated, Datum::Ellipsoid) => -undulation_m(),
            _ => 0.0,
        };
        Self {
            pixel,
            by_up: [0, 1].map(|k| (above[k] - pixel[k]) / UP_M),
            height_m: low.height_m + file_above_world_m,
            height_by_up: (high.height_m - low.height_m) / UP_M,
        }
    }

    fn towards(self, other: Self, share: f64) -> Self {
        let between = |a: f64, b: f64| a + (b - a) * share;
        Self {
            pixel: [0, 1].map(|k| between(self.pixel[k], other.pixel[k])),
            by_up: [0, 1].map(|k| between(self.by_up[k], other.by_up[k])),
            height_m: between(self.height_m, other.height_m),
            height_by_up: between(self.height_by_up, other.height_by_up),
        }
    }
}

/// The heights of a window, bilinear between the centres of pixels.
struct Heights {
    window: Window,
    values: Vec<f32>,
}

impl Heights {
    fn at(&self, pixel: [f64; 2]) -> f64 {
        let [width, rows] = self.window.size;
        let [u, v] = [0, 1].map(|k| pixel[k] - self.window.first[k] as f64);
        // Rounding must not lose the edge of a file at which the next begins.
        let is_inside = |c: f64, n: usize| (-1e-6..=(n - 1) as f64 + 1e-6).contains(&c);
        if !is_inside(u, width) || !is_inside(v, rows) {
            return f64::NAN;
        }
        let [i, j] = [
            (u.max(0.0) as usize).min(width - 2),
            (v.max(0.0) as usize).min(rows - 2),
        ];
        let [fx, fy] = [(u - i as f64).clamp(0.0, 1.0), (v - j as f64).clamp(0.0, 1.0)];
        let at = |i: usize, j: usize| f64::from(self.values[j * width + i]);
        let along = |j: usize| at(i, j) * (1.0 - fx) + at(i + 1, j) * fx;
        along(j) * (1.0 - fy) + along(j + 1) * fy
    }
}

/// The terrain of a file about an origin.
fn sampled(raster: &mut dyn Raster, origin: &Origin) -> Result<Terrain, Fault> {
    let axes = LocalAxes::at(origin.geodetic());
    let [width, rows] = raster.size();
    let pixel = |x: f64, y: f64| raster.georeference().pixel(axes.to_geodetic([x, y, 0.0]));
    let centre = pixel(0.0, 0.0);
    let is_covered = |c: f64, n: usize| (0.0..=n as f64 - 1.0).contains(&c) && n >= 2;
    if !is_covered(centre[0], width) || !is_covered(centre[1], rows) {
        return Err(Fault::NotCovered {
            latitude_deg: origin.latitude_deg,
            longitude_deg: origin.longitude_deg,
        });
    }
    const APART_M: f64 = 100.0;
    let [east, north] = [pixel(APART_M, 0.0), pixel(0.0, APART_M)].map(|p| [p[0] - centre[0], p[1] - centre[1]]);
    let spacing_m = APART_M / (east[0] * north[1] - east[1] * north[0]).abs().sqrt();
    if !(FINEST_M..=COARSEST_M).contains(&spacing_m) {
        return Err(Fault::wrong("pixels of 0.05 to 1000 m", format!("{spacing_m} m")));
    }
    let step = (ANCHORS_M / spacing_m).clamp(1.0, 16.0) as usize;
    // No farther than the file reaches, however it is turned.
    let reach = [(centre[0], width), (centre[1], rows)].map(|(c, n)| c.max(n as f64 - 1.0 - c));
    let nodes = (HALF_M / spacing_m).min(MOST_NODES).min(1.0 + reach[0].hypot(reach[1]));
    let intervals = (nodes / step as f64).ceil() as usize;
    let half = intervals * step;
    let side = 2 * intervals + 1;
    let at = |k: usize| (k as f64 - intervals as f64) * step as f64 * spacing_m;
    let anchors: Vec<_> = (0..side * side)
        .map(|k| Anchor::of(raster, &axes, origin.datum, at(k % side), at(k / side)))
        .collect();
    let heights = read_around(raster, &anchors, spacing_m)?;
    let n = 2 * half + 1;
    let mut z_m = Vec::with_capacity(n * n);
    for row in 0..n {
        let (j, share) = (row / step, (row % step) as f64 / step as f64);
        let above = (j + 1).min(side - 1);
        let along: Vec<_> = (0..side)
            .map(|i| anchors[j * side + i].towards(anchors[above * side + i], share))
            .collect();
        for column in 0..n {
            let (i, share) = (column / step, (column % step) as f64 / step as f64);
            let anchor = along[i].towards(along[(i + 1).min(side - 1)], share);
            z_m.push(z_at(&anchor, &heights) as f32);
        }
    }
    if z_m.iter().all(|z| z.is_nan()) {
        let half_m = half as f64 * spacing_m;
        return Err(Fault::Empty { half_m });
    }
    Ok(Terrain::of_nodes(half, spacing_m, z_m))
}

/// The local height of the ground above a node. The pixel below it depends on that height a little: twice is exact to a millimetre.
fn z_at(anchor: &Anchor, heights: &Heights) -> f64 {
    let mut z_m = 0.0;
    for _ in 0..2 {
        let pixel = [0, 1].map(|k| anchor.pixel[k] + anchor.by_up[k] * z_m);
        z_m = (heights.at(pixel) - anchor.height_m) / anchor.height_by_up;
    }
    z_m
}

/// The window of a file that the anchors lie in.
fn read_around(raster: &mut dyn Raster, anchors: &[Anchor], spacing_m: f64) -> Result<Heights, Fault> {
    // What a height of 10 km shifts 20 km off the origin, and the pixels to interpolate with.
    let margin = 2.0 + 30.0 / spacing_m;
    let size = raster.size();
    let range = |k: usize| {
        let pixels = anchors.iter().map(|anchor| anchor.pixel[k]);
        let (low, high) = pixels.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| {
            (low.min(p), high.max(p))
        });
        // Casts saturate; at least two pixels to interpolate between.
        let first = ((low - margin).max(0.0) as usize).min(size[k] - 2);
        let last = ((high + margin).max(0.0) as usize).clamp(first + 1, size[k] - 1);
        (first, last - first + 1)
    };
    let (across, down) = (range(0), range(1));
    let window = Window {
        first: [across.0, down.0],
        size: [across.1, down.1],
    };
    if across.1.saturating_mul(down.1) > MOST_PIXELS {
        return Err(Fault::wrong(
            "pixels about as wide as high",
            "a window of more than 67 million pixels",
        ));
    }
    let values = raster.read(window)?;
    Ok(Heights { window, values })
}
