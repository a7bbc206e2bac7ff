//! The truth of a frame: which emitter was where.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::Fate;
use crate::claim::Claim;
use crate::frame::Frame;
use crate::pose::Pose;

/// A simulated frame with its truth and claims.
#[derive(Clone, Debug)]
pub struct SimulatedFrame {
    pub frame: Frame,
    pub truth: Truth,
    /// The claims that reached the network's log since the frame before, in the order of their arrival.
    pub claims: Vec<Claim>,
    /// What the autopilot said since the frame before, in the order of its times.
    pub poses: Vec<Pose>,
    /// Whether the frame arrived; a live source passes on only the claims of a lost one.
    pub fate: Fate,
}

/// Emitters of a frame.
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
    /// A beam that the network does not know.
    Intruder,
    /// Drawn anew for this frame.
    Random,
}
