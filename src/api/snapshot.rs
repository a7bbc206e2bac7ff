//! What the daemon publishes after each step: the report, the frame and the monitor's own status.

use std::collections::BTreeMap;
use std::sync::Arc;

use jiff::Timestamp;
use serde::{Serialize, Serializer};

use super::pose_status::PoseStatus;
use crate::frame::Frame;
use crate::monitor::{AlertKind, Report};
use crate::notify::EndpointStatus;
use crate::optics::Camera;

/// Everything the outside may see of one step. Built by the daemon, shared by all readers.
#[derive(Clone, Debug)]
pub struct Snapshot {
    pub report: Report,
    /// The pixels the report was made from; `None` when the step had no usable frame.
    pub frame: Option<Arc<Frame>>,
    pub camera: Arc<Camera>,
    /// `None` for a hub, which has no platform.
    pub pose: Option<PoseStatus>,
    pub status: Status,
}

/// How the monitor itself is doing.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct Status {
    pub version: &'static str,
    #[schema(value_type = String, format = DateTime)]
    pub started_at: Timestamp,
    pub source: SourceStatus,
    pub frames: FrameCounts,
    pub latency: Latency,
    pub claims: ClaimsStatus,
    pub journal: JournalStatus,
    pub webhooks: Vec<EndpointStatus>,
    pub estimator: String,
    /// How the estimator explains frames; null before the first one, and at a hub.
    pub fit: Option<FitStatus>,
    /// Alerts not cleared, by kind.
    pub alerts_open: BTreeMap<AlertKind, u64>,
    /// Half-widths of the watched area on the ground of a level camera over the origin, m.
    pub field_of_view_m: [f64; 2],
    /// What the camera sees of the ground; null as long as no pose has come, and at a hub.
    pub view: Option<ViewStatus>,
    /// The access points of a hub.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stations: Vec<StationStatus>,
}

/// How the estimator explains the latest usable frame.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct FitStatus {
    /// Weighted squared residual per degree of freedom; near 1 where the model explains the frame; null of an estimator without it.
    pub reduced_chi2: Option<f64>,
    /// Share of a spot's light by which spots were taken to differ from the model; 0 where it explains the frame.
    pub spot_error: f64,
    /// What to do where the spot's shape is the reason in most of the latest frames.
    pub hint: Option<&'static str>,
}

impl FitStatus {
    pub const CALIBRATE: &'static str = "the spot is not what the config says: run oapwatch calibrate";
}

/// What the camera sees of the ground in the latest frame.
#[derive(Clone, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct ViewStatus {
    /// Outline on the ground, east and north, m, counter-clockwise; without the parts that see no ground.
    pub footprint_m: Vec<[f64; 2]>,
    /// Heights of the outline's points, m.
    #[serde(skip)]
    pub footprint_z_m: Vec<f64>,
    /// The place below the lens, east and north, m.
    pub nadir_m: [f64; 2],
    /// Height of the lens, m.
    pub z_m: f64,
    /// Of the platform, clockwise from north, 0 to 360.
    pub heading_deg: f64,
    pub roll_deg: f64,
    pub pitch_deg: f64,
    pub pose_age_s: f64,
}

impl Status {
    /// Smallest and largest east and north of what is watched, m.
    pub fn bounds_m(&self) -> [[f64; 2]; 2] {
        let [x, y] = self.field_of_view_m;
        let own = self.view.iter().flat_map(|view| &view.footprint_m);
        let all = own.chain(self.stations.iter().flat_map(|station| &station.footprint_m));
        let grow = |[low, high]: [[f64; 2]; 2], p: &[f64; 2]| {
            [
                [low[0].min(p[0]), low[1].min(p[1])],
                [high[0].max(p[0]), high[1].max(p[1])],
            ]
        };
        let nothing = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        let bounds = all.fold(nothing, grow);
        if bounds == nothing { [[-x, -y], [x, y]] } else { bounds }
    }
}

/// One access point as its hub knows it.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct StationStatus {
    pub site: String,
    pub station: String,
    pub state: StationState,
    #[schema(value_type = String, format = DateTime)]
    pub last_seen_at: Timestamp,
    /// From the newest positions' frame to their arrival at the hub, by both clocks, s.
    pub lag_s: Option<f64>,
    /// Alert events that wait at the station for the link.
    pub alerts_waiting: u64,
    pub emitters: usize,
    /// Half-widths of the watched area on the ground of a level camera over the origin, m.
    pub field_of_view_m: Option<[f64; 2]>,
    /// Outline of what it sees of the ground, east and north, m, counter-clockwise.
    pub footprint_m: Vec<[f64; 2]>,
    /// Null for a platform without poses, which is level and over its own origin.
    pub pose: Option<StationPose>,
    /// Whether its users are compared with those of other stations: not where its frames are dated further from the hub's clock than
    /// 5 s.
    pub is_compared: bool,
    /// Messages that were refused since the hub began, by reason: "other_version", "malformed", "other_station" (in another's name),
    /// "too_large", "late" (older than what is known), "too_many_stations".
    pub refused: BTreeMap<&'static str, u64>,
    /// The station's own `GET /v1/status`, without `view`.
    #[serde(serialize_with = "shared")]
    #[schema(value_type = Object)]
    pub status: Arc<serde_json::Value>,
}

fn shared<S: Serializer>(status: &Arc<serde_json::Value>, serializer: S) -> Result<S::Ok, S::Error> {
    status.as_ref().serialize(serializer)
}

/// Where the platform of an access point is, by the newest pose that its station used.
#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct StationPose {
    /// "mavlink" or "replay".
    pub source: String,
    /// Of the frame that was looked at with it.
    #[schema(value_type = String, format = DateTime)]
    pub time: Timestamp,
    /// Whether the station misses its poses.
    pub is_lost: bool,
    /// Null as long as no pose has come.
    pub place: Option<StationPlace>,
}

#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct StationPlace {
    /// From the pose to now, s: its age at the station, and the time since the hub heard of it.
    pub age_s: f64,
    /// The lens: east, north, up of the world's origin, m.
    pub x_m: f64,
    pub y_m: f64,
    pub z_m: f64,
    /// Where an origin is configured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latitude_deg: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longitude_deg: Option<f64>,
    /// Above the datum of `[world] origin`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Clockwise from north, 0 to 360.
    pub heading_deg: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum StationState {
    /// Messages arrive and its frames can be used.
    Good,
    /// Messages arrive, but its source gives no usable frames.
    Blind,
    /// No message has arrived for `[fleet] lost_after_s`.
    Lost,
    /// Nothing that it has said could be used.
    Refused,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum SourceState {
    /// No frame has arrived yet.
    Starting,
    Running,
    /// Frames arrive but none can be used: the sensor is blinded, frozen or broken.
    Blind,
    /// No frames arrive.
    Lost,
    /// The recording came to its end.
    Ended,
}

#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct SourceStatus {
    /// "simulator", "v4l2" or "replay".
    pub kind: String,
    pub state: SourceState,
    /// Frames per second, over the last seconds.
    pub rate_hz: f64,
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_good_frame_at: Option<Timestamp>,
    /// Why the latest frame could not be used.
    pub fault: Option<String>,
}

#[derive(Clone, Copy, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct FrameCounts {
    pub captured: u64,
    pub dropped: u64,
    pub unusable: u64,
}

/// Time from a frame's arrival to its report, over the last frames.
#[derive(Clone, Copy, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct Latency {
    pub last_us: u64,
    pub median_us: u64,
    pub p99_us: u64,
}

#[derive(Clone, Debug, Default, Serialize, utoipa::ToSchema)]
pub struct ClaimsStatus {
    /// The log that is followed, if any.
    pub log: Option<String>,
    pub accepted: u64,
    pub malformed: u64,
    /// Users with an active claim.
    pub users: u64,
    /// The time of the newest claim that stands, from whichever way it came.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub last_at: Option<Timestamp>,
}

#[derive(Clone, Debug, Serialize, utoipa::ToSchema)]
pub struct JournalStatus {
    /// Whether alerts reach the disk.
    pub healthy: bool,
    /// "memory" when no file is configured.
    pub place: String,
    pub fault: Option<String>,
}

impl SourceStatus {
    /// Whether good frames flow.
    pub fn flows(&self) -> bool {
        self.state == SourceState::Running
    }
}
