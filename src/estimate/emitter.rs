use serde::{Deserialize, Serialize};

bitflags::bitflags! {
    /// What a reader of a position must know before trusting it. Defined here once; JSON carries the names
    /// in lower case.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
    pub struct Flags: u16 {
        /// Another emitter is so near that the data cannot tell the two apart; or this one, or an overlapping one, may be two.
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
        /// Positions and energies trade against each other so nearly that rounding has a say in them.
        const ILL_CONDITIONED = 1 << 7;
        /// The covariance is only an outline: two standard deviations out the likelihood differs from it by a factor of two.
        const NON_GAUSSIAN = 1 << 8;
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

/// What a frame says of second moments (xx, xy, yy) that an emitter has beyond one spot's, in σ²: two emitters of equal energy,
/// d apart in units of σ, have d²/4 along the line between them. Zero where nothing is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bend {
    /// Derivative of the log likelihood in the moments; its covariance, with one spot, is `information`.
    pub score: [f64; 3],
    /// Inverse covariance of the moments, what the rest of the model adjusts taken out.
    pub information: [[f64; 3]; 3],
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
    /// Standard deviation of `energy_j`.
    #[serde(skip)]
    pub energy_std_j: f64,
    /// Spot centre on the sensor, m.
    #[serde(skip)]
    pub sensor_m: [f64; 2],
    #[serde(skip)]
    pub bend: Bend,
    pub flags: Flags,
}

/// What one frame holds.
#[derive(Clone, Debug, Default)]
pub struct Estimate {
    pub emitters: Vec<Emitter>,
    /// The rung that produced it.
    pub rung: &'static str,
    /// Whether a budget of time or work ended the search: its best answer until then.
    pub is_cut_short: bool,
    /// Weighted squared residual per degree of freedom; near 1 when the model explains the frame.
    pub reduced_chi2: f64,
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
