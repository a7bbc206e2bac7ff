//! Spots onto pixels, separably and only as far out as their tails matter.

use crate::optics::{Axis, Camera, psf};

/// A spot is left out beyond this many σ from its centre. Every pixel is then within
/// 2·Q(8.3) < 1.1·10⁻¹⁶ of the spot's whole energy of the untruncated one, half a rounding step of the double.
pub(super) const REACH_SIGMAS: f64 = 8.3;

/// Gaussian spot on the sensor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spot {
    pub centre: [f64; 2],
    pub energy_j: f64,
}

/// Adds spots to frames of one camera.
#[derive(Debug)]
pub(super) struct Renderer {
    row: Vec<f64>,
    column: Vec<f64>,
}

impl Renderer {
    pub fn new(camera: &Camera) -> Self {
        Self {
            row: vec![0.0; camera.x.n],
            column: vec![0.0; camera.y.n],
        }
    }

    /// Adds one spot to `pixels`, row-major (Ny, Nx), J.
    pub fn add(&mut self, camera: &Camera, spot: Spot, pixels: &mut [f64]) {
        let sigma = camera.spot_sigma_m;
        let (x0, row) = window(&camera.x, spot.centre[0], sigma, &mut self.row);
        let (y0, column) = window(&camera.y, spot.centre[1], sigma, &mut self.column);
        for (j, weight) in column.iter().enumerate() {
            let scale = weight * spot.energy_j;
            let start = (y0 + j) * camera.x.n + x0;
            for (pixel, fraction) in pixels[start..start + row.len()].iter_mut().zip(&*row) {
                *pixel += scale * fraction;
            }
        }
    }
}

/// First pixel within reach of the spot along one axis, and the fractions from there on.
fn window<'a>(axis: &Axis, centre: f64, sigma: f64, buffer: &'a mut [f64]) -> (usize, &'a mut [f64]) {
    let n = axis.n as f64;
    let pixel = |x: f64| ((x - axis.min_m) / axis.pitch_m).clamp(0.0, n);
    let lo = pixel(centre - REACH_SIGMAS * sigma).floor() as usize;
    let hi = pixel(centre + REACH_SIGMAS * sigma).ceil() as usize;
    let out = &mut buffer[..hi - lo];
    for (k, fraction) in out.iter_mut().enumerate() {
        *fraction = psf::pixel_fraction(axis.edge(lo + k), axis.edge(lo + k + 1), centre, sigma);
    }
    (lo, out)
}
