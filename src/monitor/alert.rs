//! Alerts and the events of their life, as the journal, the API and webhooks carry them.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::geo::Geodetic;

/// Distance within which beams without a claim, one after the other, are one cause, m. Wider joins two strangers into one
/// alert; narrower raises an alert for each reappearance of one who walks on while off. Not tuned; `a_beam_that_blinks` in
/// `tests/monitor` checks it.
pub(super) const SAME_PLACE_M: f64 = 10.0;
/// The key of an alert's evidence that names the user in whose spot a second beam is.
pub(super) const SHARED_SPOT: &str = "shares_the_spot_of";
/// The key of an alert's evidence that names the known light that changed.
pub(super) const KNOWN_LIGHT: &str = "known_light";
/// Age from which an alert is critical, s. Longer delays the escalation, shorter makes every alert critical. Not tuned.
const ESCALATE_S: f64 = 10.0;

/// What an alert is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum AlertKind {
    /// A beam nobody claims: a possible eavesdropper.
    UnclaimedEmitter,
    /// A user is not where the log says.
    PositionMismatch,
    /// Claimed, active, not seen.
    UserUnseen,
    /// No usable frames: blinding the monitor is itself an attack.
    SensorLost,
    /// The network's log has gone quiet.
    ClaimsStale,
    /// All users are shifted alike: our own pose is off.
    PoseInconsistent,
    /// More is claimed than there is room or time for: claims are refused or shed.
    ClaimsFlooded,
    /// An approved light is no longer what was approved.
    KnownLightChanged,
    /// A user is in a restricted zone that does not list them, or outside of all zones that do.
    UserOutOfZone,
    /// A hub hears nothing of one of its access points.
    StationLost,
    /// A user is claimed or seen at two access points, too far apart to be one.
    UserInTwoPlaces,
    /// No poses come: where the camera looks is known ever less.
    PoseLost,
}

impl AlertKind {
    pub const ALL: [Self; 12] = [
        Self::UnclaimedEmitter,
        Self::PositionMismatch,
        Self::UserUnseen,
        Self::SensorLost,
        Self::ClaimsStale,
        Self::PoseInconsistent,
        Self::ClaimsFlooded,
        Self::KnownLightChanged,
        Self::UserOutOfZone,
        Self::StationLost,
        Self::UserInTwoPlaces,
        Self::PoseLost,
    ];
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    Info,
    Warning,
    Critical,
}

impl Severity {
    /// Of a cause that has lasted `lasted_s`: a warning at first, then critical.
    pub(super) fn of_duration(lasted_s: f64) -> Self {
        if lasted_s >= ESCALATE_S {
            Self::Critical
        } else {
            Self::Warning
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum AlertState {
    Open,
    Acknowledged,
    Cleared,
}

/// The frame an alert came from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct AlertSource {
    /// "simulator", "v4l2" or "replay".
    pub kind: String,
    pub frame: u64,
    /// The recording that holds the frame, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
}

/// One cause for alarm, from raise to clear.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Alert {
    /// Unique and, for the same input, the same in every run.
    pub id: String,
    pub kind: AlertKind,
    pub severity: Severity,
    pub state: AlertState,
    #[schema(value_type = String, format = DateTime)]
    pub raised_at: Timestamp,
    #[schema(value_type = Option<String>, format = DateTime)]
    pub cleared_at: Option<Timestamp>,
    pub user: Option<String>,
    pub x_m: Option<f64>,
    pub y_m: Option<f64>,
    /// Height of the ground there above the world's origin.
    #[serde(default)]
    pub z_m: Option<f64>,
    /// The same on the earth, where `[world] origin` places it.
    #[serde(default, flatten)]
    #[schema(value_type = GeodeticFields)]
    pub geodetic: Option<Geodetic>,
    pub cov_m2: Option<[[f64; 2]; 2]>,
    /// The claim that the position was compared with, where there is one.
    pub claimed: Option<serde_json::Value>,
    pub evidence: serde_json::Value,
    pub source: AlertSource,
    /// The watched or restricted zone that its emitter is in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zone: Option<String>,
    /// The only webhooks that are sent it: those of its zone, or none during maintenance. All when left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub webhooks: Option<Vec<String>>,
    /// The maintenance window in which it was raised, until that ends: it is recorded and not sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub maintenance: Option<String>,
    /// The latest acknowledgement; it stays, marked as withdrawn, when it is undone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub acknowledgement: Option<Acknowledgement>,
    /// The access point that it comes from, at a hub of many.
    #[serde(default, flatten)]
    #[schema(value_type = StationFields)]
    pub station: Option<StationName>,
}

/// How an optional [`StationName`] beside other fields is described: both of these or none.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "a description only")]
pub struct StationFields {
    site: Option<String>,
    station: Option<String>,
}

/// How an optional [`Geodetic`] beside other fields is described: all of these or none.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "a description only")]
pub struct GeodeticFields {
    latitude_deg: Option<f64>,
    longitude_deg: Option<f64>,
    /// Above the datum of `[world] origin`.
    height_m: Option<f64>,
}

/// An access point among all sites.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StationName {
    pub site: String,
    pub station: String,
}

impl std::fmt::Display for StationName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}", self.site, self.station)
    }
}

/// That an operator took note of an alert.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Acknowledgement {
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    /// Name of the operator's token; null where the token has none, or none is asked for.
    pub by: Option<String>,
    pub note: Option<String>,
    /// Set when the acknowledgement was undone; the alert is open again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub withdrawn: Option<Withdrawal>,
}

/// That an acknowledgement was undone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Withdrawal {
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    /// Name of the operator's token, as for the acknowledgement.
    pub by: Option<String>,
}

impl Alert {
    /// Whether both alerts have one cause: the same user, the same shared spot or, where neither is named, the same place
    /// to within 10 m.
    pub fn has_cause_of(&self, other: &Self) -> bool {
        let spot = |alert: &Self| {
            let name = |key: &str| alert.evidence[key].as_str();
            name(SHARED_SPOT).or(name(KNOWN_LIGHT)).map(str::to_owned)
        };
        let is_near = match (self.x_m.zip(self.y_m), other.x_m.zip(other.y_m)) {
            (Some((x, y)), Some((ox, oy))) => (x - ox).hypot(y - oy) < SAME_PLACE_M,
            (here, there) => here == there,
        };
        let is_named = self.user.is_some() || spot(self).is_some();
        self.kind == other.kind && self.user == other.user && spot(self) == spot(other) && (is_named || is_near)
    }

    /// A step in its life, with the alert as it is now.
    pub(super) fn event(&self, event: AlertEventKind) -> AlertEvent {
        AlertEvent::new(event, self.clone())
    }

    /// Takes an operator's note of it. Whether that changes anything: an alert that is acknowledged takes only another note.
    pub fn acknowledge(&mut self, acknowledgement: Acknowledgement) -> bool {
        if self.state == AlertState::Acknowledged && acknowledgement.note.is_none() {
            return false;
        }
        self.state = AlertState::Acknowledged;
        self.acknowledgement = Some(acknowledgement);
        true
    }

    /// Undoes the acknowledgement, if there is one.
    pub fn withdraw(&mut self, withdrawal: Withdrawal) -> bool {
        if self.state != AlertState::Acknowledged {
            return false;
        }
        self.state = AlertState::Open;
        // An alert that was acknowledged before acknowledgements were kept has none.
        if let Some(acknowledgement) = &mut self.acknowledgement {
            acknowledgement.withdrawn = Some(withdrawal);
        }
        true
    }
}

impl AlertEventKind {
    /// Whether it is news to webhooks: neither an operator's own act nor another access point's word on the same cause.
    pub fn is_news(self) -> bool {
        matches!(self, Self::Raised | Self::Updated | Self::Cleared)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub enum AlertEventKind {
    #[serde(rename = "alert.raised")]
    Raised,
    #[serde(rename = "alert.updated")]
    Updated,
    #[serde(rename = "alert.acknowledged")]
    Acknowledged,
    /// An acknowledgement was undone.
    #[serde(rename = "alert.unacknowledged")]
    Unacknowledged,
    /// At a hub: another access point reports the same cause, or no longer does.
    #[serde(rename = "alert.reported")]
    Reported,
    #[serde(rename = "alert.cleared")]
    Cleared,
}

/// A step in an alert's life, with the alert as it is after it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct AlertEvent {
    pub event: AlertEventKind,
    pub alert: Alert,
    /// The maintenance in which it was raised is over: receivers have heard nothing of it yet.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub released: bool,
}

impl AlertEvent {
    pub fn new(event: AlertEventKind, alert: Alert) -> Self {
        Self {
            event,
            alert,
            released: false,
        }
    }

    /// What it is to receivers.
    pub fn told_as(&self) -> AlertEventKind {
        match self.released {
            true => AlertEventKind::Raised,
            false => self.event,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An alert about `user`, or about a beam at (`x`, 0), m.
    fn alert(user: Option<&str>, x: f64) -> Alert {
        Alert {
            id: String::new(),
            kind: AlertKind::UnclaimedEmitter,
            severity: Severity::Warning,
            state: AlertState::Open,
            raised_at: Timestamp::UNIX_EPOCH,
            cleared_at: None,
            user: user.map(str::to_owned),
            x_m: Some(x),
            y_m: Some(0.0),
            z_m: Some(0.0),
            geodetic: None,
            cov_m2: None,
            claimed: None,
            evidence: serde_json::json!({}),
            source: AlertSource {
                kind: "replay".into(),
                frame: 0,
                file: None,
            },
            zone: None,
            webhooks: None,
            maintenance: None,
            acknowledgement: None,
            station: None,
        }
    }

    #[test]
    fn an_alert_is_acknowledged_once_or_with_a_note_and_can_be_reopened() {
        let mut alert = alert(None, 0.0);
        let acknowledgement = |note: Option<&str>| Acknowledgement {
            at: Timestamp::UNIX_EPOCH,
            by: None,
            note: note.map(str::to_owned),
            withdrawn: None,
        };
        let withdrawal = || Withdrawal {
            at: Timestamp::UNIX_EPOCH,
            by: None,
        };
        assert!(!alert.withdraw(withdrawal()));
        assert!(alert.acknowledge(acknowledgement(None)));
        assert_eq!(alert.state, AlertState::Acknowledged);
        assert!(!alert.acknowledge(acknowledgement(None)));
        assert!(alert.acknowledge(acknowledgement(Some("known"))));
        assert!(alert.withdraw(withdrawal()));
        assert_eq!(alert.state, AlertState::Open);
        assert!(alert.acknowledgement.unwrap().withdrawn.is_some());
    }

    #[test]
    fn a_cause_is_told_by_user_or_by_place() {
        assert!(alert(Some("a"), 0.0).has_cause_of(&alert(Some("a"), 99.0)));
        assert!(!alert(Some("a"), 0.0).has_cause_of(&alert(Some("b"), 0.0)));
        assert!(alert(None, 0.0).has_cause_of(&alert(None, 9.9)));
        assert!(!alert(None, 0.0).has_cause_of(&alert(None, 10.1)));
        let mut shared = alert(None, 0.0);
        shared.evidence = serde_json::json!({ SHARED_SPOT: "a" });
        assert!(!shared.has_cause_of(&alert(None, 0.0)));
    }

    #[test]
    fn ten_seconds_make_an_alert_critical() {
        assert_eq!(
            [9.9, 10.0].map(Severity::of_duration),
            [Severity::Warning, Severity::Critical]
        );
    }
}
