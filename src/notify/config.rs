use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::monitor::AlertKind;

/// One `[[webhook]]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub url: String,
    /// File with a Standard Webhooks secret (`whsec_…`, or `whsk_…` for ed25519).
    pub secret_file: PathBuf,
    /// Alert kinds to send; all when left out.
    #[serde(default)]
    pub kinds: Option<Vec<AlertKind>>,
}
