use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::Fate;
use crate::claim::Claim;
use crate::frame::Frame;

/// What a plan makes of one frame number.
#[derive(Clone, Debug)]
pub struct SimulatedFrame {
    pub frame: Frame,
    pub truth: Truth,
    /// The claims that reached the network's log since the frame before, in the order of their arrival.
    pub claims: Vec<Claim>,
    /// Whether the frame arrived; a live source hands on only the claims of one that did not.
    pub fate: Fate,
}

/// Who was where in a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    pub frame: u64,
    pub time: Timestamp,
    pub emitters: Vec<EmitterTruth>,
}

/// One emitter at the middle of the exposure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EmitterTruth {
    pub x_m: f64,
    pub y_m: f64,
    /// Energy of its whole spot, inside the array or not, J.
    pub energy_j: f64,
    /// Name of the user, or of the intruder.
    pub user: Option<String>,
    pub role: Role,
    /// Whether the centre of its spot falls on the array.
    pub in_view: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// A legitimate user of the network.
    User,
    /// A beam that the network knows nothing of.
    Intruder,
    /// Drawn anew for this frame.
    Random,
}
