//! Angle-of-arrival fluctuation within an exposure.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::table::Table;
use crate::toml_file::{Key, OutOfRange};

/// Turbulence tilts each arriving wavefront: both angles of arrival follow, for each emitter by itself, an Ornstein–Uhlenbeck
/// process of standard deviation σ_a and correlation time T_a within the exposure (angle-of-arrival variance: Andrews and Phillips,
/// 2005, eq. 6.79). Over an exposure of many T_a the spot widens by z·σ_a. Valid for T_a shorter than the time between
/// frames: frames are independent.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wander {
    /// σ_a per axis.
    pub std_rad: f64,
    /// T_a.
    pub time_s: f64,
}

impl Wander {
    /// Fills `out` with shifts of (θx, θy), rad, `step_s` apart.
    pub(in crate::scene) fn fill<R: Rng + ?Sized>(&self, step_s: f64, out: &mut [[f64; 2]], rng: &mut R) {
        let keep = libm::exp(-step_s / self.time_s);
        let fresh = (1.0 - keep * keep).sqrt();
        let mut state: Option<[f64; 2]> = None;
        for shift in out {
            let draw: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(rng));
            let next = state.map_or(draw, |s| std::array::from_fn(|i| keep * s[i] + fresh * draw[i]));
            *shift = next.map(|v| self.std_rad * v);
            state = Some(next);
        }
    }
}

impl Table for Wander {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        field.at("std_rad").non_negative(self.std_rad)?;
        field.at("time_s").positive(self.time_s).map(drop)
    }
}
