//! What an estimator returns: emitters with their covariance and flags.

use serde::{Deserialize, Serialize};

bitflags::bitflags! {
    /// Qualifications of a position. Defined here once; JSON carries the names in lower case.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub struct Flags: u16 {
        /// Not resolved from another emitter; or this one, or an overlapping one, may be two.
        const UNRESOLVED = 1;
        /// Within 2σ of the sensor's edge, or past it.
        const NEAR_EDGE = 1 << 1;
        /// The fit stopped before it converged.
        const NO_CONVERGENCE = 1 << 2;
        /// Saturated pixels lie within 3σ of the spot.
        const SATURATED = 1 << 3;
        /// Masked or non-finite pixels lie within 3σ of the spot.
        const MASKED = 1 << 4;
        /// The frame as a whole is not explained by the model at the configured noise.
        const POOR_FIT = 1 << 5;
        /// The frame-time budget ended the search early.
        const OUT_OF_TIME = 1 << 6;
        /// The information matrix is so badly conditioned that rounding affects positions and energies.
        const ILL_CONDITIONED = 1 << 7;
        /// The likelihood is not quadratic: two standard deviations out it differs from the covariance's by a factor of two.
        const NON_GAUSSIAN = 1 << 8;
        /// The search ended at the most emitters that it looks for: the frame may hold more.
        const LIMIT_REACHED = 1 << 9;
    }
}

impl Flags {
    /// Names as JSON carries them.
    pub fn names(self) -> Vec<String> {
        self.iter_names().map(|(name, _)| name.to_ascii_lowercase()).collect()
    }
}

impl Serialize for Flags {
    fn serialize<S: serde::Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        self.names().serialize(s)
    }
}

/// Score of an emitter's second moments (xx, xy, yy) in excess of one spot's, in σ²: two emitters of equal energy, a distance d apart in
/// σ, have d²/4 along the line between them. Zero where the frame gives no information.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SecondMomentScore {
    /// Derivative of the log likelihood in the moments; for a single spot its covariance is `information`.
    pub score: [f64; 3],
    /// Information of the moments after projection off the fitted parameters.
    pub information: [[f64; 3]; 3],
}

/// How an emitter moves on the ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Velocity {
    pub vx_m_s: f64,
    pub vy_m_s: f64,
}

/// One fitted light source, placed on the ground.
#[derive(Clone, Debug, Serialize)]
pub struct Emitter {
    pub x_m: f64,
    pub y_m: f64,
    /// Error covariance on the ground, symmetric positive semi-definite.
    pub cov_m2: [[f64; 2]; 2],
    /// Collected energy over the whole spot (also the part that falls off the sensor).
    pub energy_j: f64,
    /// Velocity along x and y, in the world where the platform moves, where the estimator follows emitters over frames.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub velocity: Option<Velocity>,
    /// Of a moving platform's, the error covariance in the world that this emitter shares with the frames before and with no other
    /// emitter.
    #[serde(skip)]
    pub lasting_cov_m2: Option<[[f64; 2]; 2]>,
    /// Standard deviation of `energy_j`.
    #[serde(skip)]
    pub energy_std_j: f64,
    /// Centre on the sensor, m.
    #[serde(skip)]
    pub sensor_m: [f64; 2],
    #[serde(skip)]
    pub second_moment: SecondMomentScore,
    pub flags: Flags,
}

/// The emitters of one frame.
#[derive(Clone, Debug, Default)]
pub struct Estimate {
    pub emitters: Vec<Emitter>,
    /// The name of the estimator that produced it.
    pub estimator: &'static str,
    /// Whether a budget of time or work ended the search early.
    pub is_cut_short: bool,
    /// Whether the search ended at the most emitters that it looks for.
    pub is_limited: bool,
    /// Weighted squared residual per degree of freedom; near 1 when the model explains the frame.
    pub reduced_chi2: f64,
    /// Share of a spot's light by which the spots were taken to differ from the PSF; 0 where it explains the frame.
    pub spot_error: f64,
    /// Share of pixels at or above saturation.
    pub saturated_share: f64,
    /// Condition number (1-norm) of the information matrix scaled to a unit diagonal; 1 where nothing was found.
    pub condition: f64,
    /// Steps of the joint fit, over all hypotheses tried.
    pub steps: u64,
}

impl<'de> Deserialize<'de> for Flags {
    fn deserialize<D: serde::Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        let names = Vec::<String>::deserialize(d)?;
        names
            .iter()
            .map(|n| {
                Flags::from_name(&n.to_ascii_uppercase())
                    .ok_or_else(|| serde::de::Error::custom(format!("unknown flag {n:?}")))
            })
            .collect()
    }
}
