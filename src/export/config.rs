//! `[[export]]`: its keys, defaults and checks.

use std::fmt::Display;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::monitor::AlertKind;

/// One `[[export]]`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    pub kind: Kind,
    /// What it is called in status, metrics and journal. Left out, it follows from kind and address; give one, and deliveries that wait
    /// survive a change of the address.
    #[serde(default)]
    pub name: Option<String>,
    /// `udp://`, `tcp://`, `tls://` or `https://` with host and port, as the kind allows.
    pub address: String,
    /// Alert kinds to send; all when left out.
    #[serde(default)]
    pub kinds: Option<Vec<AlertKind>>,
    /// What this station is called on the other side; the host's name when left out.
    #[serde(default)]
    pub station: Option<String>,
    /// Of syslog messages.
    #[serde(default)]
    pub format: Format,
    /// Certificates (PEM) of a private authority that the receiver's certificate may come from.
    #[serde(default)]
    pub ca_file: Option<PathBuf>,
    /// The certificate chain (PEM) that we show the receiver, with `client_key_file`.
    #[serde(default)]
    pub client_cert_file: Option<PathBuf>,
    #[serde(default)]
    pub client_key_file: Option<PathBuf>,
    /// File with a bearer token.
    #[serde(default)]
    pub token_file: Option<PathBuf>,
    /// Shortest time from one update of the positions to the next, s.
    #[serde(default = "one")]
    pub interval_s: f64,
    /// Allows `http://` to hosts other than this one.
    #[serde(default)]
    pub allow_http: bool,
    /// As of a webhook, s.
    #[serde(default)]
    pub cool_down_s: f64,
    /// Longest duration of one attempt, s.
    #[serde(default = "twenty")]
    pub timeout_s: f64,
}

/// A map that people look at needs no more.
fn one() -> f64 {
    1.0
}

/// As of a webhook.
fn twenty() -> f64 {
    20.0
}

/// The other system.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    Syslog,
    Alertmanager,
    /// Cursor on Target.
    Cot,
    Sapient,
}

impl Kind {
    pub fn name(self) -> &'static str {
        match self {
            Self::Syslog => "syslog",
            Self::Alertmanager => "alertmanager",
            Self::Cot => "cot",
            Self::Sapient => "sapient",
        }
    }
}

/// Of a syslog message.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Structured data.
    #[default]
    Rfc5424,
    /// ArcSight's Common Event Format as the message.
    Cef,
}

/// Why an `[[export]]` cannot be used. `index` counts the tables from 1.
#[derive(Debug, thiserror::Error)]
#[error("[[export]] {index}: {problem}")]
pub struct Error {
    pub(super) index: usize,
    pub(super) problem: String,
}

/// What is wrong, beginning with the key.
pub(super) fn refuse(key: &str, expected: &str, found: impl Display) -> String {
    format!("{key}: expected {expected}, found {found}")
}

impl Config {
    /// Refuses keys that the kind has no use for.
    pub(super) fn check_unused(&self) -> Result<(), String> {
        let is_tls = self.address.starts_with("tls://") || self.address.starts_with("https://");
        let is_http = self.kind == Kind::Alertmanager;
        let keys = [
            ("ca_file", self.ca_file.is_some(), is_tls, "an encrypted address"),
            (
                "client_cert_file",
                self.client_cert_file.is_some(),
                is_tls,
                "an encrypted address",
            ),
            (
                "client_key_file",
                self.client_key_file.is_some(),
                is_tls,
                "an encrypted address",
            ),
            (
                "token_file",
                self.token_file.is_some(),
                is_http,
                "kind = \"alertmanager\"",
            ),
            ("allow_http", self.allow_http, is_http, "kind = \"alertmanager\""),
            (
                "format",
                self.format != Format::Rfc5424,
                self.kind == Kind::Syslog,
                "kind = \"syslog\"",
            ),
            (
                "cool_down_s",
                self.cool_down_s > 0.0,
                matches!(self.kind, Kind::Syslog | Kind::Sapient),
                "kind = \"syslog\" or \"sapient\": the others are sent open alerts again",
            ),
            (
                "interval_s",
                self.interval_s != one(),
                matches!(self.kind, Kind::Cot | Kind::Sapient),
                "kind = \"cot\" or \"sapient\"",
            ),
        ];
        if !(0.1..=3600.0).contains(&self.interval_s) {
            return Err(refuse("interval_s", "0.1 to 3600 (seconds)", self.interval_s));
        }
        match keys.into_iter().find(|(_, is_given, is_used, _)| *is_given && !is_used) {
            Some((key, _, _, used_with)) => Err(format!("{key}: only used with {used_with}; leave it out")),
            None => Ok(()),
        }
    }

    /// The name of this station for the other side.
    pub(super) fn station(&self) -> Result<String, String> {
        let Some(name) = &self.station else {
            let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
            let host = host.trim();
            return Ok(if is_station(host) { host } else { "oapwatch" }.to_owned());
        };
        match is_station(name) {
            true => Ok(name.clone()),
            false => Err(refuse(
                "station",
                "1 to 255 letters, digits, '-', '_', '.' or ':'",
                format_args!("{name:?}"),
            )),
        }
    }
}

/// What RFC 5424 allows as a host's name, without what other formats would have to escape.
fn is_station(name: &str) -> bool {
    (1..=255).contains(&name.len()) && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.:".contains(c))
}
