//! The spot's light distribution as a value.

use serde::{Deserialize, Serialize};

use super::field::{Field, FieldPolynomial};
use super::profile::Profile;

/// One term w(u, v)·a(x)·b(y).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Term {
    pub weight: FieldPolynomial,
    pub x: Profile,
    pub y: Profile,
}

/// The light distribution of a spot of unit energy at any place of the sensor: Σ_k w_k(u, v)·a_k(x)·b_k(y), 1/m². All profiles
/// have the same knots, and the light adds up to 1 at every place.
#[derive(Clone, Debug, PartialEq)]
pub struct SpotShape {
    pub(super) field: Field,
    /// At least one, the strongest first.
    pub(super) terms: Vec<Term>,
    pub(super) beyond: Option<Beyond>,
}

/// What a shape does not say of a spot: the light far from its centre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Beyond {
    /// Share of a spot's light by which it may differ from the shape there.
    pub error: f64,
    /// Distance from the centre, m.
    pub from_m: f64,
}

/// Gauss–Legendre nodes and weights of order 5 on [−1, 1] (Abramowitz and Stegun, 1964, table 25.4).
const LEGENDRE: [(f64, f64); 5] = [
    (0.0, 0.568_888_888_888_888_9),
    (0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (-0.538_469_310_105_683_1, 0.478_628_670_499_366_5),
    (0.906_179_845_938_664, 0.236_926_885_056_189_1),
    (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
];

impl SpotShape {
    /// Most terms of a shape. Each costs every fit as much as a Gaussian does; ghosts and strong coma need the most.
    pub const MOST_TERMS: usize = 24;

    /// Number of terms, K ≥ 1.
    pub fn terms(&self) -> usize {
        self.terms.len()
    }

    /// Half the support along each axis, R, m: no light is further from the centre than this.
    pub fn radius_m(&self) -> f64 {
        self.terms[0].x.radius_m()
    }

    pub fn beyond(&self) -> Option<Beyond> {
        self.beyond
    }

    /// The same shape, knowing what it does not say.
    pub fn with_beyond(self, beyond: Option<Beyond>) -> Self {
        Self { beyond, ..self }
    }

    /// Factor a_k of term `k` along x.
    pub fn x_profile(&self, k: usize) -> &Profile {
        &self.terms[k].x
    }

    /// Factor b_k of term `k` along y.
    pub fn y_profile(&self, k: usize) -> &Profile {
        &self.terms[k].y
    }

    /// Of each term in turn: (w, ∂w/∂u, ∂w/∂v) of a spot at a place on the sensor, m; the derivatives in 1/m.
    pub fn weights_at(&self, u_m: f64, v_m: f64) -> impl Iterator<Item = (f64, f64, f64)> {
        let (at, scale) = self.field.at([u_m, v_m]);
        let most = self.terms.iter().map(|term| term.weight.0.len()).max().unwrap_or(1);
        let monomials = FieldPolynomial::monomials(at, most);
        self.terms.iter().map(move |term| {
            let [w, du, dv] = term.weight.value(&monomials);
            (w, du * scale[0], dv * scale[1])
        })
    }

    /// Whether the shape is the same all over the sensor.
    pub fn is_uniform(&self) -> bool {
        self.terms.iter().all(|t| t.weight.0.iter().skip(1).all(|c| *c == 0.0))
    }

    /// Light of a spot at `sensor_m` per area, 1/m², at `offset_m` from its centre.
    pub fn density(&self, sensor_m: [f64; 2], offset_m: [f64; 2]) -> f64 {
        let weights = self.weights_at(sensor_m[0], sensor_m[1]).zip(&self.terms);
        weights
            .map(|((w, ..), term)| w * term.x.density(offset_m[0]) * term.y.density(offset_m[1]))
            .sum()
    }

    /// All light of a spot at `sensor_m`: 1 but for rounding.
    pub fn total(&self, sensor_m: [f64; 2]) -> f64 {
        let weights = self.weights_at(sensor_m[0], sensor_m[1]).zip(&self.terms);
        weights.map(|((w, ..), term)| w * term.x.total() * term.y.total()).sum()
    }

    /// Share of the light of a spot at `sensor_m` within `radius_m` of its centre.
    pub fn encircled_energy(&self, sensor_m: [f64; 2], radius_m: f64) -> f64 {
        let reach = radius_m.min(self.radius_m());
        let knot = self.terms[0].x.knot_m();
        let steps = (4.0 * reach / knot).ceil().max(8.0) as usize;
        let half = reach / steps as f64;
        let weights: Vec<f64> = self.weights_at(sensor_m[0], sensor_m[1]).map(|(w, ..)| w).collect();
        let mut sum = 0.0;
        for step in 0..steps {
            for (node, weight) in LEGENDRE {
                let x = -reach + half * (2 * step + 1) as f64 + half * node;
                let y = (radius_m * radius_m - x * x).max(0.0).sqrt();
                for (term, w) in self.terms.iter().zip(&weights) {
                    let along_y = term.y.cumulative(y) - term.y.cumulative(-y);
                    sum += w * weight * half * term.x.density(x) * along_y;
                }
            }
        }
        sum
    }

    /// ∫∫ S² at `sensor_m`, 1/m².
    pub fn sharpness(&self, sensor_m: [f64; 2]) -> f64 {
        let weights: Vec<f64> = self.weights_at(sensor_m[0], sensor_m[1]).map(|(w, ..)| w).collect();
        let mut sum = 0.0;
        for (a, wa) in self.terms.iter().zip(&weights) {
            for (b, wb) in self.terms.iter().zip(&weights) {
                sum += wa * wb * a.x.inner_product(&b.x) * a.y.inner_product(&b.y);
            }
        }
        sum
    }

    /// Half the side of the square about the centre outside which lies at most `share` of Σ S² and of Σ |∇S|², which the energy and the position
    /// are told from, at the sensor's middle and its corners, m.
    pub fn core_radius_m(&self, share: f64) -> f64 {
        let [u, v] = self.field.half_sensor_m;
        let places = [[0.0, 0.0], [-u, -v], [u, -v], [-u, v], [u, v]];
        let rings = self.terms[0].x.coefficients().len().div_ceil(2) + 2;
        let knot = self.terms[0].x.knot_m();
        let at = |profile: &Profile| -> Vec<[f64; 2]> {
            (0..2 * rings)
                .map(|k| (k as f64 - rings as f64 + 0.5) * knot)
                .map(|t| [profile.density(t), profile.slope(t)])
                .collect()
        };
        let profiles: Vec<_> = self.terms.iter().map(|term| (at(&term.x), at(&term.y))).collect();
        let core = |[u, v]: [f64; 2]| {
            let weights: Vec<f64> = self.weights_at(u, v).map(|(w, ..)| w).collect();
            let mut of_ring = vec![[0.0; 2]; rings];
            for j in 0..2 * rings {
                for i in 0..2 * rings {
                    let (mut value, mut slopes) = (0.0, [0.0; 2]);
                    for ((x, y), w) in profiles.iter().zip(&weights) {
                        value += w * x[i][0] * y[j][0];
                        slopes[0] += w * x[i][1] * y[j][0];
                        slopes[1] += w * x[i][0] * y[j][1];
                    }
                    let ring = |k: usize| k.max(2 * rings - 1 - k) - rings;
                    let sums = &mut of_ring[ring(i).max(ring(j))];
                    sums[0] += value * value;
                    sums[1] += slopes[0] * slopes[0] + slopes[1] * slopes[1];
                }
            }
            let total = of_ring.iter().fold([0.0; 2], |t, r| [t[0] + r[0], t[1] + r[1]]);
            let mut outside = [0.0; 2];
            let needed = of_ring.iter().rposition(|ring| {
                outside = [outside[0] + ring[0], outside[1] + ring[1]];
                (0..2).any(|k| outside[k] > share * total[k])
            });
            (needed.map_or(0, |k| k + 1)) as f64 * knot
        };
        let count = if self.is_uniform() { 1 } else { places.len() };
        places
            .into_iter()
            .take(count)
            .map(core)
            .fold(0.0, f64::max)
            .min(self.radius_m())
    }

    /// Width of the Gaussian with the same noise-equivalent area 1/∫∫S² = 4πσ² (King, 1983), m, averaged over the sensor.
    pub fn sigma_equivalent_m(&self) -> f64 {
        const PLACES: [f64; 3] = [-0.8, 0.0, 0.8];
        let [u, v] = self.field.half_sensor_m;
        let at = PLACES.iter().flat_map(|a| PLACES.map(|b| [a * u, b * v]));
        let areas = at.map(|at| 1.0 / self.sharpness(at));
        let mean = areas.sum::<f64>() / (PLACES.len() * PLACES.len()) as f64;
        (mean / (4.0 * std::f64::consts::PI)).sqrt()
    }
}
