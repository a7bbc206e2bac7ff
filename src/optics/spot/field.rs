//! Polynomials of the place on the sensor.

/// The coordinates of the field: a place on the sensor, m from its centre, over half the sensor's size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    pub half_sensor_m: [f64; 2],
}

/// Places further out than this, in half sensors, have the weights of the edge: a polynomial is not to be extrapolated.
const OUTERMOST: f64 = 1.2;

impl Field {
    /// Field coordinates of a place and their derivatives by it, 1/m.
    pub fn at(&self, sensor_m: [f64; 2]) -> ([f64; 2], [f64; 2]) {
        let t: [f64; 2] = std::array::from_fn(|k| sensor_m[k] / self.half_sensor_m[k]);
        let inside = |k: usize| (t[k].abs() <= OUTERMOST) as u8 as f64;
        (
            t.map(|t| t.clamp(-OUTERMOST, OUTERMOST)),
            std::array::from_fn(|k| inside(k) / self.half_sensor_m[k]),
        )
    }
}

/// Σ c_ij uⁱ vʲ, coefficients by rising degree and, within a degree, rising power of v: 1, u, v, u², uv, v², …
#[derive(Clone, Debug, PartialEq)]
pub struct FieldPolynomial(pub Vec<f64>);

impl FieldPolynomial {
    /// Number of coefficients of a polynomial of this degree.
    pub const fn length(degree: usize) -> usize {
        (degree + 1) * (degree + 2) / 2
    }

    pub fn constant(value: f64) -> Self {
        Self(vec![value])
    }

    /// Powers (i, j) of u and v in the order of the coefficients.
    pub fn powers() -> impl Iterator<Item = (i32, i32)> {
        (0..).flat_map(|degree| (0..=degree).map(move |j| (degree - j, j)))
    }

    /// The first `count` of the uⁱ vʲ, at least one, each with its derivatives by u and v.
    pub fn monomials([u, v]: [f64; 2], count: usize) -> Vec<[f64; 3]> {
        let mut all = Vec::with_capacity(count + 1);
        all.push([1.0, 0.0, 0.0]);
        for degree in 1.. {
            if all.len() >= count {
                break;
            }
            let below = all.len() - degree;
            for j in 0..=degree {
                let [without_u, without_v] =
                    [(j < degree, j), (j > 0, j.saturating_sub(1))].map(|(has, k)| match has {
                        true => all[below + k][0],
                        false => 0.0,
                    });
                let value = if j < degree { u * without_u } else { v * without_v };
                all.push([value, (degree - j) as f64 * without_u, j as f64 * without_v]);
            }
        }
        all
    }

    /// The value and its derivatives by u and v, from at least as many monomials as there are coefficients.
    pub fn value(&self, monomials: &[[f64; 3]]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for (c, monomial) in self.0.iter().zip(monomials) {
            for k in 0..3 {
                sum[k] += c * monomial[k];
            }
        }
        sum
    }

    /// Root mean square over the sensor, |u|, |v| ≤ 1.
    pub fn rms(&self) -> f64 {
        let mean = |p: i32| if p % 2 == 0 { 1.0 / f64::from(p + 1) } else { 0.0 };
        let mut sum = 0.0;
        for (a, (i, j)) in self.0.iter().zip(Self::powers()) {
            for (b, (k, l)) in self.0.iter().zip(Self::powers()) {
                sum += a * b * mean(i + k) * mean(j + l);
            }
        }
        sum.max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_has_its_derivatives_and_its_mean_square() {
        // 1 + 2u − v + 3uv
        let p = FieldPolynomial(vec![1.0, 2.0, -1.0, 0.0, 3.0, 0.0]);
        let value = p.value(&FieldPolynomial::monomials([0.5, -0.25], 6));
        assert_eq!(value, [1.0 + 1.0 + 0.25 - 0.375, 2.0 - 0.75, -1.0 + 1.5]);
        // 1 + 4/3 + 1/3 + 9/9
        assert!((p.rms().powi(2) - (1.0 + 5.0 / 3.0 + 1.0)).abs() < 1e-12);
    }

    #[test]
    fn monomials_are_in_the_order_of_the_powers() {
        let (u, v): (f64, f64) = (0.7, -1.1);
        let powers = FieldPolynomial::powers();
        for ([value, du, dv], (i, j)) in FieldPolynomial::monomials([u, v], 28).into_iter().zip(powers) {
            let of = |i: i32, j: i32| u.powi(i) * v.powi(j);
            assert!((value - of(i, j)).abs() < 1e-14);
            assert!((du - f64::from(i) * of(i - 1, j)).abs() < 1e-14);
            assert!((dv - f64::from(j) * of(i, j - 1)).abs() < 1e-13);
        }
    }
}
