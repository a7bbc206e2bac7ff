//! How spots move over the sensor during an exposure, and a smeared spot as a sum of displaced ones.

use std::f64::consts::PI;

use super::Camera;

/// The motion of spots during an exposure: each goes evenly along a straight line, by the displacement that a plane has before a moving camera,
/// d(p) = d₀ + B·p + p·(c·p) (Longuet-Higgins and Prazdny, 1980).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Smear {
    /// Displacement from the beginning to the end at the sensor's centre, m.
    pub at_centre_m: [f64; 2],
    /// B, ∂displacement/∂place there.
    pub by_place: [[f64; 2]; 2],
    /// c, 1/m.
    pub by_square_per_m: [f64; 2],
    /// Standard deviation of an exposure's light over its mean, as beams fade within it: the light then lies unevenly along the way.
    pub light_std: f64,
}

/// Beams fade by about so much of their mean in strong turbulence, and anew after so long, s: the coherence time of a turbulent atmosphere.
const FADING_STD: f64 = 0.9;
pub const COHERENCE_S: f64 = 0.01;
/// [`Smear::light_std`] of an exposure: light that fades anew so often has the first moment along the way of so many equal parts, within which
/// none changes.
pub fn light_std(exposure_s: f64) -> f64 {
    let share = (COHERENCE_S / exposure_s).min(1.0);
    FADING_STD * (share * (1.0 - share * share)).sqrt()
}

/// Most displaced spots of a sum: a fit costs as the square. So many add up to a smear of 7 σ within 4·10⁻⁷ of the peak.
const MOST_NODES: usize = 12;

impl Smear {
    /// Displacement, m, of a spot that is at `place_m` in the middle of the exposure.
    pub fn displacement_m(&self, place_m: [f64; 2]) -> [f64; 2] {
        displacement(self.at_centre_m, self.by_place, self.by_square_per_m, place_m)
    }

    /// The same motion as a window of the sensor sees it, whose middle is at `place_m`.
    pub fn seen_from(&self, place_m: [f64; 2]) -> Self {
        let c = self.by_square_per_m;
        let along = c[0] * place_m[0] + c[1] * place_m[1];
        let mut by_place = self.by_place;
        for (k, row) in by_place.iter_mut().enumerate() {
            row[k] += along;
            row.iter_mut().zip(c).for_each(|(b, c)| *b += place_m[k] * c);
        }
        Self {
            at_centre_m: self.displacement_m(place_m),
            by_place,
            by_square_per_m: c,
            light_std: self.light_std,
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

    /// The same smear as a sum of displaced spots, off by at most `tolerance` of the spot's peak anywhere.
    pub fn displaced(&self, camera: &Camera, tolerance: f64) -> DisplacedSpots {
        let sigma = camera.spot_sigma_m;
        let length = self.longest_m(camera) / sigma;
        DisplacedSpots {
            at_centre: self.at_centre_m.map(|d| d / sigma),
            by_place: self.by_place,
            by_square: self.by_square_per_m.map(|c| c * sigma),
            light_std: self.light_std,
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
    by_square: [f64; 2],
    light_std: f64,
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

    /// How much the longest displacement changes a spot's shape, over the spot's norm: L²/24 times its second derivative along the motion, less
    /// what has the spot's own shape.
    pub fn change_of_shape(&self) -> f64 {
        self.length * self.length / (24.0 * 2f64.sqrt())
    }

    /// Standard deviation of what uneven light changes of the shape, over the spot's norm: of light with white fading the second Legendre polynomial
    /// has √5 times the standard deviation of the mean, and L²/60 times the second derivative.
    pub fn unevenness(&self) -> f64 {
        self.light_std * 5f64.sqrt() * self.length * self.length / (60.0 * 2f64.sqrt())
    }

    /// Covariance, σ², of the middle of the light about the middle of the way of a spot at `u`, σ: that of an even displacement at so many
    /// independent draws.
    pub fn cov_of_light(&self, u: [f64; 2]) -> [[f64; 2]; 2] {
        let d = self.displacement(u).map(|d| self.light_std * d / 12f64.sqrt());
        d.map(|r| d.map(|c| r * c))
    }

    /// Displacement during the exposure, σ, of a spot at `u`, σ.
    #[inline]
    pub fn displacement(&self, u: [f64; 2]) -> [f64; 2] {
        displacement(self.at_centre, self.by_place, self.by_square, u)
    }
}

#[inline]
fn displacement(
    at_centre: [f64; 2],
    [[a, b], [c, d]]: [[f64; 2]; 2],
    by_square: [f64; 2],
    [x, y]: [f64; 2],
) -> [f64; 2] {
    let along = by_square[0] * x + by_square[1] * y;
    [
        at_centre[0] + (a + along) * x + b * y,
        at_centre[1] + c * x + (d + along) * y,
    ]
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
                ..Smear::default()
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
    fn the_first_moment_of_uneven_light_is_as_stated() {
        let parts = 7;
        let at = |k: i32| (f64::from(k) + 0.5) / f64::from(parts) - 0.5;
        // Of so many independent draws, each a part of the light and spread over a part of the way.
        let variance = (0..parts).map(|k| (FADING_STD * at(k) / f64::from(parts)).powi(2));
        let stated = light_std(f64::from(parts) * COHERENCE_S).powi(2) / 12.0;
        assert!((variance.sum::<f64>() / stated - 1.0).abs() < 1e-9);
        assert_eq!(light_std(0.5 * COHERENCE_S), 0.0);
    }

    #[test]
    fn the_longest_displacement_is_at_a_corner() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let turning = Smear {
            by_place: [[0.0, -0.1], [0.1, 0.0]],
            ..Smear::default()
        };
        let corner = camera.x.half_width().hypot(camera.y.half_width());
        assert!((turning.longest_m(&camera) - 0.1 * corner).abs() < 1e-12);
    }

    #[test]
    fn a_window_sees_the_same_motion() {
        let smear = Smear {
            at_centre_m: [1e-4, -2e-4],
            by_place: [[0.01, -0.03], [0.02, 0.04]],
            by_square_per_m: [0.7, -1.1],
            ..Smear::default()
        };
        let (middle, place) = ([4e-3, -7e-3], [1.5e-3, 2e-3]);
        let seen = smear.seen_from(middle).displacement_m(place);
        let whole = smear.displacement_m([middle[0] + place[0], middle[1] + place[1]]);
        assert!((0..2).all(|k| (seen[k] - whole[k]).abs() < 1e-15), "{seen:?} {whole:?}");
    }

    #[test]
    fn a_smear_changes_a_shape_by_what_its_energy_and_place_do_not_explain() {
        let camera = crate::optics::Config::default().camera().unwrap();
        let length = 0.3;
        let smear = Smear {
            at_centre_m: [length * camera.spot_sigma_m, 0.0],
            ..Smear::default()
        };
        let displaced = smear.displaced(&camera, 1e-9);
        let (mut own, mut both, mut smeared) = (0.0, 0.0, 0.0);
        for k in -800..800 {
            let x = 0.01 * f64::from(k);
            let spot = |c: f64| (-0.5 * (x - c).powi(2)).exp();
            let sum: f64 = displaced.nodes.iter().map(|(t, w)| w * spot(t * length)).sum();
            own += spot(0.0).powi(2);
            both += spot(0.0) * sum;
            smeared += sum * sum;
        }
        let left = ((smeared - both * both / own) / own).sqrt();
        assert!((left / displaced.change_of_shape() - 1.0).abs() < 0.03, "{left}");
    }
}
