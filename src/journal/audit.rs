//! The audit log: who acknowledged alerts, approved lights, drew zones, posted claims, changed webhooks, or was refused.

use jiff::Timestamp;

/// What somebody did, or tried to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub enum AuditAction {
    #[serde(rename = "alert.acknowledge")]
    Acknowledge,
    #[serde(rename = "alert.unacknowledge")]
    Unacknowledge,
    #[serde(rename = "claims.post")]
    PostClaims,
    #[serde(rename = "webhook.replay")]
    ReplayWebhook,
    #[serde(rename = "webhook.enable")]
    EnableWebhook,
    #[serde(rename = "webhook.test")]
    TestWebhook,
    #[serde(rename = "known_light.approve")]
    ApproveLight,
    #[serde(rename = "known_light.revoke")]
    RevokeLight,
    #[serde(rename = "zones.put")]
    PutZones,
    #[serde(rename = "maintenance.begin")]
    BeginMaintenance,
    #[serde(rename = "maintenance.end")]
    EndMaintenance,
    /// A request was refused: wrong token, foreign host or origin, too many requests.
    #[serde(rename = "request.refused")]
    Refused,
}

/// Something for the audit log.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct AuditEntry {
    pub action: AuditAction,
    /// The name of the token that was used; null where it has none, or none was asked for.
    pub actor: Option<String>,
    /// Network address of the client, or "unix".
    pub client: String,
    /// What was acted on: an alert's id, a webhook's name, a route.
    pub target: Option<String>,
    /// The note of an acknowledgement, the outcome of claims, the reason of a refusal.
    pub detail: Option<String>,
    /// Requests that this row stands for: repetitions within a minute share one.
    pub count: u64,
}

/// A row of the audit log.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
pub struct AuditRecord {
    /// Grows with time; the place in the list.
    pub id: u64,
    /// Wall clock.
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    #[serde(flatten)]
    pub entry: AuditEntry,
}
