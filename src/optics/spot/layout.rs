//! `[spot.shape]` of a calibration file.

use serde::{Deserialize, Serialize};

use super::field::{Field, FieldPolynomial};
use super::profile::Profile;
use super::shape::{Beyond, SpotShape, Term};
use crate::optics::Camera;
use crate::toml_file::{Key, OutOfRange};

/// A [`SpotShape`] as the file holds it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layout {
    /// Distance of the splines' knots, m.
    pub knot_m: f64,
    /// Where u and v are 1, m from the sensor's centre.
    pub half_sensor_m: [f64; 2],
    pub beyond: Option<Beyond>,
    pub term: Vec<TermLayout>,
}

/// w(u, v)·a(x)·b(y).
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TermLayout {
    /// Coefficients of 1, u, v, u², uv, v², … in w.
    pub field: Vec<f64>,
    /// B-spline coefficients of a and b.
    pub x: Vec<f64>,
    pub y: Vec<f64>,
}

/// Most coefficients of a profile: a support of 500 pixels with knots half a pixel apart.
const MOST_COEFFICIENTS: usize = 1000;
/// Largest departure of the light's sum from 1 that is taken for rounding.
const ROUNDING: f64 = 1e-6;

impl Layout {
    pub fn of(shape: &SpotShape) -> Self {
        let terms = shape.terms.iter().map(|term| TermLayout {
            field: term.weight.0.clone(),
            x: term.x.coefficients().to_vec(),
            y: term.y.coefficients().to_vec(),
        });
        Self {
            knot_m: shape.terms[0].x.knot_m(),
            half_sensor_m: shape.field.half_sensor_m,
            beyond: shape.beyond,
            term: terms.collect(),
        }
    }

    /// Checks every number; `key` is the table's own name.
    pub fn shape(self, key: &Key) -> Result<SpotShape, OutOfRange> {
        let knot_m = key.at("knot_m").positive(self.knot_m)?;
        for half in self.half_sensor_m {
            key.at("half_sensor_m").positive(half)?;
        }
        if let Some(Beyond { error, from_m }) = self.beyond {
            let key = key.at("beyond");
            key.at("from_m").positive(from_m)?;
            if !(0.0..=Camera::LARGEST_SPOT_ERROR).contains(&error) {
                return Err(key.at("error").refuse("0 to 0.5, the share of a spot's light", error));
            }
        }
        let count = self.term.len();
        if !(1..=SpotShape::MOST_TERMS).contains(&count) {
            let expected = format!("1 to {} terms", SpotShape::MOST_TERMS);
            return Err(key.at("term").refuse(expected, count));
        }
        let length = self.term[0].x.len();
        if !(5..=MOST_COEFFICIENTS).contains(&length) {
            let expected = format!("5 to {MOST_COEFFICIENTS} numbers");
            return Err(key.item("term", 0).at("x").refuse(expected, length));
        }
        for (k, term) in self.term.iter().enumerate() {
            let key = key.item("term", k);
            for (name, list) in [("field", &term.field), ("x", &term.x), ("y", &term.y)] {
                if let Some(found) = list.iter().find(|v| !v.is_finite()) {
                    return Err(key.at(name).refuse("finite numbers", found));
                }
                if name != "field" && list.len() != length {
                    let expected = format!("{length} numbers, as many as term[0].x");
                    return Err(key.at(name).refuse(expected, list.len()));
                }
            }
            let degree = (0..=MOST_DEGREE).find(|d| FieldPolynomial::length(*d) >= term.field.len());
            if degree.is_none() || term.field.is_empty() {
                let most = FieldPolynomial::length(MOST_DEGREE);
                return Err(key.at("field").refuse(format!("1 to {most} numbers"), term.field.len()));
            }
        }
        let terms = self.term.into_iter().map(|term| Term {
            weight: FieldPolynomial(term.field),
            x: Profile::new(knot_m, term.x),
            y: Profile::new(knot_m, term.y),
        });
        let field = Field {
            half_sensor_m: self.half_sensor_m,
        };
        let shape = SpotShape {
            field,
            terms: terms.collect(),
            beyond: self.beyond,
        };
        for at in [[0.0, 0.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
            let total = shape.total(std::array::from_fn(|k| at[k] * field.half_sensor_m[k]));
            if !((total - 1.0).abs() < ROUNDING) {
                let expected = format!("light that adds up to 1 at u, v = {at:?}");
                return Err(key.at("term").refuse(expected, total));
            }
        }
        Ok(shape)
    }
}

/// Highest degree of a weight: what Seidel's aberrations of third order need and two more.
const MOST_DEGREE: usize = 6;
