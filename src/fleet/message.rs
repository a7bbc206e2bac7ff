//! What stations publish, as JSON. A reader refuses other versions.

use jiff::Timestamp;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::api::PoseStatus;
use crate::claim::Claim;
use crate::journal::Recorded;
use crate::monitor::{AlertEvent, StationName, TrackedPosition};

/// Version of the messages. Readers ignore fields that they do not know, so only a change of meaning raises it.
pub const VERSION: u32 = 1;

/// Of topic `alert`: one event of an alert's life. The header `Nats-Msg-Id` holds the event's id.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct AlertMessage {
    pub version: u32,
    #[serde(flatten)]
    pub name: StationName,
    /// The station's journal; a station that starts with a new one begins to count anew.
    pub journal: String,
    /// Grows with every event of this journal.
    #[serde(deserialize_with = "sequence_number")]
    pub seq: u64,
    /// When it happened, on the frames' clock.
    pub at: Timestamp,
    #[serde(flatten)]
    pub event: AlertEvent,
}

/// One that a journal can hold: the hub's would refuse others, and all that comes with them.
pub(crate) fn sequence_number<'de, D: Deserializer<'de>>(input: D) -> Result<u64, D::Error> {
    let seq = u64::deserialize(input)?;
    match i64::try_from(seq) {
        Ok(_) => Ok(seq),
        Err(_) => Err(D::Error::custom(format_args!(
            "expected at most {}, found {seq}",
            i64::MAX
        ))),
    }
}

/// Of topic `positions`: the newest frame, or one of the newest where frames come faster than they are published.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PositionsMessage {
    pub version: u32,
    #[serde(flatten)]
    pub name: StationName,
    pub time: Timestamp,
    pub frame: u64,
    pub emitters: Vec<TrackedPosition>,
    pub unseen: Vec<String>,
    /// The claims in view.
    pub claims: Vec<Claim>,
    /// Half-widths of the watched area on the ground, m.
    pub field_of_view_m: [f64; 2],
    /// Outline of what the station sees of the ground, east and north, m, counter-clockwise.
    #[serde(default)]
    pub footprint_m: Vec<[f64; 2]>,
}

/// Of topic `pose`: what the camera's place and attitude were in the frame of the positions before it. Only of a platform that has
/// poses: a fixed one is level, over its own origin.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PoseMessage {
    pub version: u32,
    #[serde(flatten)]
    pub name: StationName,
    /// As `GET /v1/pose`.
    #[serde(flatten)]
    pub status: PoseStatus,
}

/// Of topic `health`: once a second.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct HealthMessage {
    pub version: u32,
    #[serde(flatten)]
    pub name: StationName,
    /// The station's wall clock.
    pub time: Timestamp,
    /// As `GET /v1/status`, without what the other topics hold; null before the first frame.
    pub status: serde_json::Value,
    /// Alert events that wait for the server.
    pub alerts_waiting: u64,
}

/// Who a message says it is from, and the version of its words.
pub trait FromStation {
    fn head(&self) -> (u32, &StationName);
}

macro_rules! from_station {
    ($($message:ty),*) => {
        $(impl FromStation for $message {
            fn head(&self) -> (u32, &StationName) {
                (self.version, &self.name)
            }
        })*
    };
}
from_station!(AlertMessage, PositionsMessage, PoseMessage, HealthMessage);

impl AlertMessage {
    pub fn new(name: StationName, journal: &str, recorded: Recorded) -> Self {
        Self {
            version: VERSION,
            name,
            journal: journal.to_owned(),
            seq: recorded.seq,
            at: recorded.at,
            event: recorded.event,
        }
    }
}
