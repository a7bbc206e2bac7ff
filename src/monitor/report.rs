//! The input of one step of the monitor and its output.

use jiff::Timestamp;
use nalgebra::Vector6;
use serde::{Deserialize, Serialize};

use crate::claims::Claim;
use crate::estimate::{Error, Estimate};
use crate::geo::{Geodetic, Sight};
use crate::monitor::alert::{AlertEvent, GeodeticFields, StationFields, StationName};

/// One frame's estimate, or why there is none.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    pub frame: u64,
    pub time: Timestamp,
    pub result: Result<&'a Estimate, &'a Error>,
    /// As [`crate::frame::Frame::energy_scale`].
    pub energy_scale: f64,
    /// Hash of the frame's pixels: an exact repeat is a frozen sensor.
    pub digest: u64,
    pub look: Look<'a>,
}

/// Where the camera was and looked at a frame's time.
#[derive(Clone, Copy, Debug)]
pub enum Look<'a> {
    /// Level, over (0, 0) at the camera's altitude.
    Level,
    /// As a pose says that is `age_s` seconds old.
    From {
        sight: &'a Sight,
        age_s: f64,
        /// The pose is older than is tolerated.
        is_lost: bool,
        /// Pose stamps minus frame stamps, s, by which it was taken.
        delay_s: f64,
        /// How far off the pose may be as that is not known exactly, one standard deviation.
        by_delay: Vector6<f64>,
    },
    /// Not known: no pose has come yet, for `waited_s` seconds.
    Unknown { waited_s: f64, is_lost: bool },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum PositionStatus {
    Verified,
    Mismatch,
    Unclaimed,
    Pending,
    /// A known light: approved, and tested for change.
    Known,
    /// Unclaimed, in a zone in which that raises nothing.
    Ignored,
}

/// One beam as the monitor knows it after a frame.
#[derive(Clone, Debug, Serialize, Deserialize, utoipa::ToSchema)]
pub struct TrackedPosition {
    pub track: u64,
    pub x_m: f64,
    pub y_m: f64,
    /// Height of the ground there above the world's origin.
    #[serde(default)]
    pub z_m: f64,
    /// The same on the earth, where `[world] origin` places it.
    #[serde(default, flatten)]
    #[schema(value_type = GeodeticFields)]
    pub geodetic: Option<Geodetic>,
    pub cov_m2: [[f64; 2]; 2],
    pub energy_j: f64,
    /// The user whose claim it is associated with, if any. Never an input to the position.
    pub user: Option<String>,
    pub status: PositionStatus,
    pub flags: Vec<String>,
    /// The known light that it is, by id.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub known_light: Option<String>,
    /// The access point that sees it, at a hub of many.
    #[serde(default, flatten)]
    #[schema(value_type = StationFields)]
    pub station: Option<StationName>,
}

/// Outcome of one step: `GET /v1/positions` and the alert events it caused, in order.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Report {
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    pub frame: u64,
    pub emitters: Vec<TrackedPosition>,
    /// Active users in view whose claim no beam is associated with.
    pub unseen: Vec<String>,
    #[serde(skip)]
    pub events: Vec<AlertEvent>,
    /// Claims as they stand at the frame's time, for the map.
    #[serde(skip)]
    pub claims: Vec<Claim>,
}

/// `GET /v1/users/{user}/position`.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct UserPosition {
    pub user: String,
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    pub position: Option<TrackedPosition>,
    #[schema(value_type = Option<Object>)]
    pub claim: Option<Claim>,
}
