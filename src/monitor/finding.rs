//! What a rule says of a frame: a cause is present, absent, or continues under another name.

use nalgebra::{Matrix2, Vector2};
use serde_json::Value;

use super::alert::{AlertKind, Severity};

/// What an alert is about. While an alert is open for a cause, the cause raises no other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    User(AlertKind, String),
    /// A track without a claim.
    Track(u64),
    /// A second beam within this user's spot.
    CoLocated(String),
    /// The whole system: sensor, log, pose, or all users together.
    System(AlertKind),
}

impl Cause {
    pub fn kind(&self) -> AlertKind {
        match self {
            Self::User(kind, _) | Self::System(kind) => *kind,
            Self::Track(_) | Self::CoLocated(_) => AlertKind::UnclaimedEmitter,
        }
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
    pub cov_m2: Option<[[f64; 2]; 2]>,
    pub claimed: Option<Value>,
    pub evidence: Value,
}

impl Finding {
    pub fn present(cause: Cause, content: Content) -> Self {
        Self::Present(cause, Box::new(content))
    }

    /// The cause it is about; of a renamed one the new name.
    pub fn cause(&self) -> &Cause {
        match self {
            Self::Present(cause, _) | Self::Absent(cause) | Self::Renamed { to: cause, .. } => cause,
        }
    }
}

impl Content {
    pub fn new(severity: Severity, evidence: Value) -> Self {
        Self {
            severity,
            x_m: None,
            y_m: None,
            cov_m2: None,
            claimed: None,
            evidence,
        }
    }

    /// Places the alert on the ground, m and m².
    pub fn at(mut self, position: Vector2<f64>, cov: Matrix2<f64>) -> Self {
        self.x_m = Some(position.x);
        self.y_m = Some(position.y);
        self.cov_m2 = Some([[cov[(0, 0)], cov[(0, 1)]], [cov[(1, 0)], cov[(1, 1)]]]);
        self
    }

    /// The claim that the position is compared with.
    pub fn with_claim(mut self, claimed: Value) -> Self {
        self.claimed = Some(claimed);
        self
    }
}
