//! The exact power through the lens.

use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::optics::radiometry;
use crate::toml_file::{Key, OutOfRange};

/// The power through the lens as the Gaussian beam's integral over the disc, 1 − Q₁(2r/w_z, 2r_a/w_z), in place of the flat
/// form, whose relative error is about (r_a/w_z)². Valid for any w_z.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExactAperture {}

impl Table for ExactAperture {
    fn validate(&self, _field: &Key) -> Result<(), OutOfRange> {
        Ok(())
    }
}

/// What a lens collects of a beam that misses it, relative to the flat form of a beam that does not.
#[derive(Debug)]
pub(in crate::scene) enum Capture {
    /// exp(−2r²/w_z²).
    Flat { beam_radius_m: f64 },
    /// Tabulated over r, uniformly from 0.
    Exact { step_m: f64, values: Vec<f64> },
}

impl Capture {
    /// Nodes over the beam's radius. Cubic interpolation at w_z/128 errs by less than 10⁻⁸ of the centre's value, because
    /// no feature of the integral is narrower than the beam.
    pub const PER_RADIUS: f64 = 128.0;

    /// `reach_m`: no miss is larger, but for one draw in 10¹⁵.
    pub fn exact(lens_radius_m: f64, beam_radius_m: f64, reach_m: f64) -> Self {
        let step_m = beam_radius_m / Self::PER_RADIUS;
        let flat = radiometry::flat_aperture_fraction(lens_radius_m, beam_radius_m, 0.0);
        // Beyond the lens's rim and five radii of the beam nothing is collected.
        let nodes = (reach_m.min(lens_radius_m + 5.0 * beam_radius_m) / step_m).ceil() as usize + 3;
        let at = |k| radiometry::aperture_fraction(lens_radius_m, beam_radius_m, k as f64 * step_m) / flat;
        Self::Exact {
            step_m,
            values: (0..nodes).map(at).collect(),
        }
    }

    /// At a squared miss, m².
    pub fn at(&self, squared_miss: f64) -> f64 {
        match self {
            Self::Flat { beam_radius_m } => libm::exp(-2.0 * squared_miss / beam_radius_m.powi(2)),
            Self::Exact { step_m, values } => {
                let s = squared_miss.sqrt() / step_m;
                let k = s.floor();
                let d = s - k;
                let k = k as usize;
                let Some(&[b, c, e]) = values.get(k..k + 3).and_then(|v| v.first_chunk()) else {
                    return 0.0;
                };
                // The integral is even in the miss.
                let a = values[k.abs_diff(1)];
                // Lagrange through −1, 0, 1, 2.
                b + 0.5 * d * (c - a + d * (2.0 * a - 5.0 * b + 4.0 * c - e + d * (3.0 * (b - c) + e - a)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_integral() {
        let (ra, w) = (0.05, 0.08);
        let capture = Capture::exact(ra, w, 0.3);
        let flat = radiometry::flat_aperture_fraction(ra, w, 0.0);
        for k in 0..600 {
            let r = k as f64 * 0.00047;
            let exact = radiometry::aperture_fraction(ra, w, r) / flat;
            assert!(
                (capture.at(r * r) - exact).abs() < 1e-6,
                "{r}: {} {exact}",
                capture.at(r * r)
            );
        }
    }
}
