//! The pose as the outside sees it.

use std::borrow::Cow;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// The pose that the latest frame was looked at with.
#[derive(Clone, Debug, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PoseStatus {
    /// "fixed", "mavlink" or "replay".
    #[schema(value_type = String)]
    pub source: Cow<'static, str>,
    /// The frame's time.
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// Whether the newest pose is older than `[platform] pose_lost_s`, or none has come for so long.
    pub is_lost: bool,
    /// Null as long as no pose has come.
    pub pose: Option<PoseNow>,
}

/// A pose, with its uncertainty.
#[derive(Clone, Debug, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PoseNow {
    /// Seconds from the newest pose before the frame to the frame.
    pub age_s: f64,
    /// The lens: east, north, up of the world's origin, m.
    pub x_m: f64,
    pub y_m: f64,
    pub z_m: f64,
    /// Where an origin is configured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latitude_deg: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub longitude_deg: Option<f64>,
    /// Above the datum of `[world] origin`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Body (forward, right, down) to north, east, down: w, x, y, z.
    pub q: [f64; 4],
    pub roll_deg: f64,
    pub pitch_deg: f64,
    /// Clockwise from north, 0 to 360.
    pub heading_deg: f64,
    /// Covariance of the turn about north, east, down (rad) and of the position east, north, up (m).
    pub cov: [[f64; 6]; 6],
}
