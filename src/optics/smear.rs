//! How spots move over the sensor during an exposure, and a smeared spot as a sum of displaced ones.

use std::f64::consts::PI;

use super::Camera;

/// The motion of spots during an exposure: each goes evenly along a straight line, by a displacement linear in its place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Smear {
    /// Displacement from the beginning to the end at the sensor's centre, m.
    pub at_centre_m: [f64; 2],
    /// ∂displacement/∂place.
    pub by_place: [[f64; 2]; 2],
}

/// Standard deviation of a smear, in the spot's σ, from which on it is known to an estimator. Smaller ones widen the spot by less than
/// 2 %; lower costs a fit four to nine times as much in more frames.
pub const LEAST_SMEAR: f64 = 0.2;

/// Most displaced spots of a sum: a fit costs as the square. So many add up to a smear of 7 σ within 4·10⁻⁷ of the peak.
const MOST_NODES: usize = 12;

impl Smear {
    /// Displacement, m, of a spot that is at `place_m` in the middle of the exposure.
    pub fn displacement_m(&self, place_m: [f64; 2]) -> [f64; 2] {
        displacement(self.at_centre_m, self.by_place, place_m)
    }

    /// The same motion as a window of the sensor sees it, whose middle is at `place_m`.
    pub fn seen_from(&self, place_m: [f64; 2]) -> Self {
        Self {
            at_centre_m: self.displacement_m(place_m),
            ..*self
        }
    }

    /// The longest displacement on a camera's sensor, m: that of a corner.
    pub fn longest_m(&self, camera: &Camera) -> f64 {
        let half = [camera.x.half_width(), camera.y.half_width()];
        let corners = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]];
        let lengths = corners.map(|[x, y]| {
            let [dx, dy] = self.displacement_m([x * half[0], y * half[1]]);
            dx.hypot(dy)
        });
        lengths.into_iter().fold(0.0, f64::max)
    }

    /// Whether the standard deviation of the smear, its length over √12, reaches [`LEAST_SMEAR`] anywhere on the sensor.
    pub fn matters(&self, camera: &Camera) -> bool {
        self.longest_m(camera) / 12f64.sqrt() >= LEAST_SMEAR * camera.spot_sigma_m
    }

    /// The same smear as a sum of displaced spots, off by at most `tolerance` of the spot's peak anywhere.
    pub fn displaced(&self, camera: &Camera, tolerance: f64) -> DisplacedSpots {
        let sigma = camera.spot_sigma_m;
        let length = self.longest_m(camera) / sigma;
        DisplacedSpots {
            at_centre: self.at_centre_m.map(|d| d / sigma),
            by_place: self.by_place,
            length,
            nodes: gauss_legendre(nodes_within(length, tolerance)),
        }
    }
}

/// Nodes of Gauss–Legendre quadrature of a Gaussian along `length` σ whose remainder is within `tolerance` of its peak: L²ⁿ(n!)⁴/((2n + 1)
/// (2n)!³) times the 2n-th derivative (Abramowitz and Stegun, 1964, 25.4.30), which is at most (2n)!/(2ⁿn!).
fn nodes_within(length: f64, tolerance: f64) -> usize {
    // n = 1.
    let mut remainder = length * length / 24.0;
    let mut n = 1;
    while remainder > tolerance && n < MOST_NODES {
        let k = n as f64;
        let pair = (2.0 * k + 1.0) * (2.0 * k + 2.0);
        remainder *= length * length * (k + 1.0).powi(3) * (2.0 * k + 1.0) / (2.0 * (2.0 * k + 3.0) * pair * pair);
        n += 1;
    }
    n
}

/// A smeared spot as a sum of displaced ones, in σ of the spot.
#[derive(Clone, Debug, PartialEq)]
pub struct DisplacedSpots {
    at_centre: [f64; 2],
    by_place: [[f64; 2]; 2],
    /// The longest displacement.
    length: f64,
    /// Parts of the displacement, −½ to ½, and shares of the light.
    pub nodes: Vec<(f64, f64)>,
}

impl DisplacedSpots {
    /// The same smear, off by at most `tolerance` of the spot's peak.
    pub fn to_within(&self, tolerance: f64) -> Self {
        Self {
            nodes: gauss_legendre(nodes_within(self.length, tolerance)),
            ..self.clone()
        }
    }

    /// Displacement during the exposure, σ, of a spot at `u`, σ.
    #[inline]
    pub fn displacement(&self, u: [f64; 2]) -> [f64; 2] {
        displacement(self.at_centre, self.by_place, u)
    }
}

#[inline]
fn displacement(at_centre: [f64; 2], [[a, b], [c, d]]: [[f64; 2]; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    [at_centre[0] + a * x + b * y, at_centre[1] + c * x + d * y]
}

/// Nodes on −½ to ½ and weights that add up to 1: the zeros of the Legendre polynomial by Newton's method (Abramowitz and Stegun, 1964,
/// 25.4.29).
fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    let node = |k: usize| {
        let mut x = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
        let mut slope = 1.0;
        // Quadratic convergence from an error below 1/n.
        for _ in 0..6 {
            let (mut p, mut before) = (1.0, 0.0);
            for j in 1..=n {
                let j = j as f64;
                (p, before) = (((2.0 * j - 1.0) * x * p - (j - 1.0) * before) / j, p);
            }
            slope = n as f64 * (x * p - before) / (x * x - 1.0);
            x -= p / slope;
        }
        (0.5 * x, 1.0 / ((1.0 - x * x) * slope * slope))
    };
    (0..n).map(node).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::psf::pixel_fraction;

    #[test]
    fn quadrature_integrates_polynomials_of_twice_the_nodes() {
        for n in 1..=MOST_NODES {
            let nodes = gauss_legendre(n);
            for power in 0..2 * n as i32 {
                let found: f64 = nodes.iter().map(|(t, w)| w * t.powi(power)).sum();
                let exact = if power % 2 == 0 {
                    0.5f64.powi(power) / f64::from(power + 1)
                } else {
                    0.0
                };
                assert!((found - exact).abs() < 1e-14, "{n} {power}: {found} {exact}");
            }
        }
    }

    #[test]
    fn displaced_spots_add_up_to_the_smeared_one() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let sigma = camera.spot_sigma_m;
        for (length, tolerance) in [
            (0.7, 1e-3),
            (0.7, 1e-6),
            (2.0, 1e-3),
            (3.5, 1e-5),
            (5.5, 1e-3),
            (7.0, 4e-7),
        ] {
            let smear = Smear {
                at_centre_m: [length * sigma, 0.0],
                by_place: [[0.0; 2]; 2],
            };
            let displaced = smear.displaced(&camera, tolerance);
            let density = |x: f64, c: f64| pixel_fraction(x - 1e-3, x + 1e-3, c, 1.0);
            // The smeared spot itself is a pixel as wide as the smear.
            let exact = |x: f64| 2e-3 / length * pixel_fraction(x - 0.5 * length, x + 0.5 * length, 0.0, 1.0);
            let peak = density(0.0, 0.0);
            for k in 0..40 {
                let x = 0.2 * f64::from(k);
                let [shift, _] = displaced.displacement([0.0, 0.0]);
                let found: f64 = displaced.nodes.iter().map(|(t, w)| w * density(x, t * shift)).sum();
                let error = (found - exact(x)).abs() / peak;
                // 10⁻⁷ is what a pixel of 2·10⁻³ σ differs from a point.
                assert!(error < tolerance + 2e-7, "{length} at {x}: {error}");
            }
        }
    }

    #[test]
    fn the_longest_displacement_is_at_a_corner_and_small_ones_do_not_matter() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let sigma = camera.spot_sigma_m;
        let turning = Smear {
            at_centre_m: [0.0, 0.0],
            by_place: [[0.0, -0.1], [0.1, 0.0]],
        };
        let corner = camera.x.half_width().hypot(camera.y.half_width());
        assert!((turning.longest_m(&camera) - 0.1 * corner).abs() < 1e-12);
        let along = |s: f64| Smear {
            at_centre_m: [s * sigma * 12f64.sqrt(), 0.0],
            by_place: [[0.0; 2]; 2],
        };
        assert!(!along(0.99 * LEAST_SMEAR).matters(&camera) && along(1.01 * LEAST_SMEAR).matters(&camera));
    }
}
