//! A position that the access network asserts for a user. An attacker may write one.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// One line of the network's log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Claim {
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    #[schema(min_length = 1, max_length = 256, pattern = r"^[^\x00-\x1f\x7f-\x9f]+$")]
    pub user: String,
    #[schema(minimum = -1e7, maximum = 1e7)]
    pub x_m: f64,
    #[schema(minimum = -1e7, maximum = 1e7)]
    pub y_m: f64,
    /// Standard deviation per axis of the claimed position.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0)]
    pub sigma_m: Option<f64>,
    #[serde(default)]
    pub state: ClaimState,
}

/// Whether the user still transmits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ClaimState {
    #[default]
    Active,
    Ended,
}
