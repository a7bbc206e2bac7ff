//! Renders spots onto pixels, separably and only where their tails are significant.

use std::sync::LazyLock;

use crate::optics::{Axis, Camera};

/// A spot is left out beyond this many σ from its centre. With the table's error every pixel is within 3·10⁻¹⁵ of the
/// spot's whole energy of the exact one: 2·Q(8.3) < 1.1·10⁻¹⁶ is left out.
pub(super) const REACH_SIGMAS: f64 = 8.3;

/// Gaussian spot on the sensor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spot {
    pub centre: [f64; 2],
    pub sigma_m: f64,
    pub energy_j: f64,
}

/// Adds spots to frames of one shape.
#[derive(Debug, Default)]
pub(super) struct Renderer {
    row: Vec<f64>,
    column: Vec<f64>,
}

impl Renderer {
    /// Adds one spot to `pixels`, row-major (Ny, Nx), J.
    pub fn add(&mut self, camera: &Camera, spot: &Spot, pixels: &mut [f64]) {
        let x0 = window(&camera.x, spot.centre[0], spot.sigma_m, &mut self.row);
        let y0 = window(&camera.y, spot.centre[1], spot.sigma_m, &mut self.column);
        for (j, weight) in self.column.iter().enumerate() {
            let scale = weight * spot.energy_j;
            let start = (y0 + j) * camera.x.n + x0;
            for (pixel, fraction) in pixels[start..start + self.row.len()].iter_mut().zip(&self.row) {
                *pixel += scale * fraction;
            }
        }
    }
}

/// Fills `out` with the fractions that the pixels within reach collect along one axis; returns the first of them.
fn window(axis: &Axis, centre: f64, sigma: f64, out: &mut Vec<f64>) -> usize {
    let n = axis.n as f64;
    let pixel = |x: f64| ((x - axis.min_m) / axis.pitch_m).clamp(0.0, n);
    let lo = pixel(centre - REACH_SIGMAS * sigma).floor() as usize;
    let hi = pixel(centre + REACH_SIGMAS * sigma).ceil() as usize;
    out.clear();
    if lo >= hi {
        return lo.min(axis.n);
    }
    let table = &*TABLE;
    let scale = 1.0 / sigma;
    let mut below = table.phi((axis.edge(lo) - centre) * scale);
    out.extend((lo + 1..=hi).map(|k| {
        let above = table.phi((axis.edge(k) - centre) * scale);
        let fraction = above - below;
        below = above;
        fraction
    }));
    lo
}

/// Φ by Taylor's polynomial of degree 6 about the nearest of these nodes: its error, φ·He₆·d⁷/5040 at |d| ≤ 1/128, is below
/// 10⁻¹⁷, so that rounding, below 4·10⁻¹⁶, is all of it. The difference of two is then good to 10⁻¹⁵ of the whole spot, far
/// below any noise. The relative accuracy in the tails that an estimator's derivatives need is provided by `optics::psf`.
struct NormalTable {
    /// (Φ, φ) at −REACH_LIMIT + k/64.
    nodes: Vec<(f64, f64)>,
}

const PER_UNIT: f64 = 64.0;
/// Edges reach one pixel further out than [`REACH_SIGMAS`]; beyond this Φ is 0 or 1.
const REACH_LIMIT: f64 = 9.0;

static TABLE: LazyLock<NormalTable> = LazyLock::new(|| NormalTable {
    nodes: (0..=(2.0 * REACH_LIMIT * PER_UNIT) as usize)
        .map(|k| {
            let t = k as f64 / PER_UNIT - REACH_LIMIT;
            let upper = 0.5 * libm::erfc(t.abs() * std::f64::consts::FRAC_1_SQRT_2);
            let density = libm::exp(-0.5 * t * t) / (2.0 * std::f64::consts::PI).sqrt();
            (if t < 0.0 { upper } else { 1.0 - upper }, density)
        })
        .collect(),
});

impl NormalTable {
    fn phi(&self, t: f64) -> f64 {
        let t = t.clamp(-REACH_LIMIT, REACH_LIMIT);
        let k = ((t + REACH_LIMIT) * PER_UNIT + 0.5) as usize;
        let (phi, density) = self.nodes[k];
        let x = k as f64 / PER_UNIT - REACH_LIMIT;
        let d = t - x;
        // Derivatives of φ are Hermite polynomials: φ⁽ⁿ⁾ = (−1)ⁿ Heₙ φ.
        let x2 = x * x;
        let he3 = x * (x2 - 3.0);
        let he4 = x2 * (x2 - 6.0) + 3.0;
        let he5 = x * (x2 * (x2 - 10.0) + 15.0);
        let series = d * (-x / 2.0 + d * ((x2 - 1.0) / 6.0 + d * (-he3 / 24.0 + d * (he4 / 120.0 - d * he5 / 720.0))));
        phi + density * d * (1.0 + series)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::psf;

    #[test]
    fn every_pixel_is_the_untruncated_spots() {
        for (n, sigma) in [(10, 0.0005), (64, 0.001), (64, 0.008), (100, 0.0002)] {
            let axis = Axis::centred(n, 0.03);
            let mut out = Vec::new();
            for step in 0..50 {
                let centre = -0.02 + 0.000_813_7 * f64::from(step);
                let lo = window(&axis, centre, sigma, &mut out);
                for k in 0..n {
                    let exact = psf::pixel_fraction(axis.edge(k), axis.edge(k + 1), centre, sigma);
                    let got = k.checked_sub(lo).and_then(|i| out.get(i)).copied().unwrap_or(0.0);
                    assert!((got - exact).abs() < 1e-15, "{n} {sigma} {centre} {k}: {got} {exact}");
                }
            }
        }
    }
}
