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

    /// The value and its derivatives by u and v.
    pub fn value(&self, [u, v]: [f64; 2]) -> (f64, [f64; 2]) {
        let mut sum = (0.0, [0.0; 2]);
        for (c, (i, j)) in self.0.iter().zip(Self::powers()) {
            sum.0 += c * u.powi(i) * v.powi(j);
            if i > 0 {
                sum.1[0] += c * f64::from(i) * u.powi(i - 1) * v.powi(j);
            }
            if j > 0 {
                sum.1[1] += c * f64::from(j) * u.powi(i) * v.powi(j - 1);
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
        let (value, [du, dv]) = p.value([0.5, -0.25]);
        assert_eq!((value, du, dv), (1.0 + 1.0 + 0.25 - 0.375, 2.0 - 0.75, -1.0 + 1.5));
        // 1 + 4/3 + 1/3 + 9/9
        assert!((p.rms().powi(2) - (1.0 + 5.0 / 3.0 + 1.0)).abs() < 1e-12);
    }
}
