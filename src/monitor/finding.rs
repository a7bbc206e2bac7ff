//! What a rule says of a frame: a cause is present, absent, or continues under another name.

use nalgebra::{Matrix2, Vector3};
use serde_json::Value;

use super::alert::{Alert, AlertKind, KNOWN_LIGHT, SHARED_SPOT, Severity};
use crate::geo::Geodetic;

/// What an alert is about. While an alert is open for a cause, the cause raises no other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    User(AlertKind, String),
    /// A track without a claim.
    Track(u64),
    /// A second beam within this user's spot.
    CoLocated(String),
    /// This known light is no longer what it was.
    KnownLight(String),
    /// The whole system: sensor, log, pose, or all users together.
    System(AlertKind),
}

impl Cause {
    /// The cause of an alert from an earlier run. One that names neither user nor spot is about a track: it gets `new_track`, an id
    /// that no track has.
    pub fn of(alert: &Alert, new_track: impl FnOnce() -> u64) -> Self {
        match (alert.kind, &alert.user, alert.evidence[SHARED_SPOT].as_str()) {
            (AlertKind::UnclaimedEmitter, None, Some(shared)) => Self::CoLocated(shared.to_owned()),
            (AlertKind::KnownLightChanged, ..) => {
                Self::KnownLight(alert.evidence[KNOWN_LIGHT].as_str().unwrap_or_default().to_owned())
            }
            (kind, Some(user), _) => Self::User(kind, user.clone()),
            (AlertKind::UnclaimedEmitter, None, None) => Self::Track(new_track()),
            (kind, None, _) => Self::System(kind),
        }
    }

    pub fn kind(&self) -> AlertKind {
        match self {
            Self::User(kind, _) | Self::System(kind) => *kind,
            Self::Track(_) | Self::CoLocated(_) => AlertKind::UnclaimedEmitter,
            Self::KnownLight(_) => AlertKind::KnownLightChanged,
        }
    }

    /// The user of a cause of this kind.
    pub fn user_with(&self, kind: AlertKind) -> Option<&str> {
        self.user().filter(|_| self.kind() == kind)
    }

    /// The user that the alert names.
    pub fn user(&self) -> Option<&str> {
        match self {
            Self::User(_, user) => Some(user),
            _ => None,
        }
    }
}

/// One statement of a rule about one cause. A cause of which nothing is said stays as it is.
#[derive(Clone, Debug)]
pub(super) enum Finding {
    Present(Cause, Box<Content>),
    Absent(Cause),
    /// The same cause under another name: a track that was lost and found again.
    Renamed {
        from: Cause,
        to: Cause,
    },
}

/// What an alert says of its cause.
#[derive(Clone, Debug)]
pub(super) struct Content {
    pub severity: Severity,
    pub x_m: Option<f64>,
    pub y_m: Option<f64>,
    pub z_m: Option<f64>,
    pub geodetic: Option<Geodetic>,
    pub cov_m2: Option<[[f64; 2]; 2]>,
    pub claimed: Option<Value>,
    pub evidence: Value,
    /// The zone that it is in, the only webhooks that are sent it, and the maintenance window in force.
    pub zone: Option<String>,
    pub webhooks: Option<Vec<String>>,
    pub maintenance: Option<String>,
}

impl Finding {
    pub fn present(cause: Cause, content: Content) -> Self {
        Self::Present(cause, Box::new(content))
    }

    /// Present where there is something to say of it, else absent.
    pub fn of(cause: Cause, content: Option<Content>) -> Self {
        match content {
            Some(content) => Self::present(cause, content),
            None => Self::Absent(cause),
        }
    }

    /// The cause it is about; of a renamed one the new name.
    pub fn cause(&self) -> &Cause {
        match self {
            Self::Present(cause, _) | Self::Absent(cause) | Self::Renamed { to: cause, .. } => cause,
        }
    }
}

/// Whether one of the findings gives the cause another name.
pub(super) fn is_renamed(findings: &[Finding], cause: &Cause) -> bool {
    let is = |finding: &Finding| matches!(finding, Finding::Renamed { from, .. } if from == cause);
    findings.iter().any(is)
}

impl Content {
    pub fn new(severity: Severity, evidence: Value) -> Self {
        Self {
            severity,
            x_m: None,
            y_m: None,
            z_m: None,
            geodetic: None,
            cov_m2: None,
            claimed: None,
            evidence,
            zone: None,
            webhooks: None,
            maintenance: None,
        }
    }

    /// Places the alert on the ground, m and m².
    pub fn at(mut self, place: Vector3<f64>, cov: Matrix2<f64>) -> Self {
        self.x_m = Some(place.x);
        self.y_m = Some(place.y);
        self.z_m = Some(place.z);
        self.cov_m2 = Some([[cov[(0, 0)], cov[(0, 1)]], [cov[(1, 0)], cov[(1, 1)]]]);
        self
    }

    /// Writes all of it to an alert, and how often its cause has come back.
    pub fn write_to(mut self, alert: &mut Alert, recurrences: u32) {
        if recurrences > 0
            && let Value::Object(evidence) = &mut self.evidence
        {
            evidence.insert("recurrences".into(), recurrences.into());
        }
        alert.severity = self.severity;
        alert.x_m = self.x_m;
        alert.y_m = self.y_m;
        alert.z_m = self.z_m;
        alert.geodetic = self.geodetic;
        alert.cov_m2 = self.cov_m2;
        alert.claimed = self.claimed;
        alert.evidence = self.evidence;
        alert.zone = self.zone;
        alert.webhooks = self.webhooks;
    }

    /// The claim that the position is compared with.
    pub fn with_claim(mut self, claimed: Value) -> Self {
        self.claimed = Some(claimed);
        self
    }
}
