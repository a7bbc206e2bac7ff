//! `[[webhook]]`: its keys and defaults.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::monitor::AlertKind;

/// One `[[webhook]]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// What the endpoint is called in status, metrics and journal. Left out, it follows from the URL; give one,
    /// and deliveries that wait survive a change of the URL.
    #[serde(default)]
    pub name: Option<String>,
    pub url: String,
    /// File with Standard Webhooks secrets, one a line (`whsec_…`, or `whsk_…` for ed25519). Every request is
    /// signed with each, so that secrets can be rotated.
    pub secret_file: PathBuf,
    /// Alert kinds to send; all when left out.
    #[serde(default)]
    pub kinds: Option<Vec<AlertKind>>,
    /// Allows `http://` to hosts other than this one.
    #[serde(default)]
    pub allow_http: bool,
    /// Certificates (PEM) of a private authority that the receiver's certificate may come from.
    #[serde(default)]
    pub ca_file: Option<PathBuf>,
    /// A cause that returns within this time of its last notification is notified again only when the time is over, if it is
    /// still there then, or at once if it has grown worse, s. 0 sends every event.
    #[serde(default)]
    pub cool_down_s: f64,
    /// Longest wait for an answer, s.
    #[serde(default = "twenty")]
    pub timeout_s: f64,
}

/// In the middle of the 15 to 30 s that Standard Webhooks recommends.
fn twenty() -> f64 {
    20.0
}
