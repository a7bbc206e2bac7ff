//! `[fleet]`: its keys, ranges and defaults.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use url::Url;

use super::subject::is_name;
use crate::monitor::StationName;
use crate::toml_file::{Key, OutOfRange};

/// `[fleet]`, of a station and of the hub.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// `nats://HOST:PORT` or `tls://HOST:PORT`; nothing is published when left out.
    pub url: Option<String>,
    /// Where the station is; the hub takes all sites when left out.
    pub site: Option<String>,
    /// What this station is called; the hub has none.
    pub station: Option<String>,
    /// Certificates (PEM) of a private authority that the server's certificate may come from.
    pub ca_file: Option<PathBuf>,
    /// A user's JWT and seed, as `nsc` writes them.
    pub credentials_file: Option<PathBuf>,
    /// An NKey seed (`SU…`).
    pub nkey_file: Option<PathBuf>,
    /// Subject on which the access network publishes claims; none are heard when left out.
    pub claims_subject: Option<String>,
    /// Most messages with positions a second. More cost the link, fewer make the hub's map jump.
    pub positions_hz: f64,
    /// The hub misses a station after this time without a message, s. Shorter raises `station_lost` at hiccups of the link.
    pub lost_after_s: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            url: None,
            site: None,
            station: None,
            ca_file: None,
            credentials_file: None,
            nkey_file: None,
            claims_subject: None,
            positions_hz: 10.0,
            lost_after_s: 10.0,
        }
    }
}

/// Why a `[fleet]` table cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    #[error("fleet.{key}: expected 1 to 64 letters, digits, '-' or '_', found {found:?}")]
    Name { key: &'static str, found: String },
    #[error("fleet.url: expected nats://HOST:PORT or tls://HOST:PORT, found {found:?}")]
    Url { found: String },
    #[error("fleet.{key}: expected a value, since fleet.url is given; found nothing")]
    Missing { key: &'static str },
    #[error("fleet.url: expected the NATS server of the fleet, found nothing")]
    NoUrl,
    #[error(
        "fleet.claims_subject: expected words of letters, digits, '-', '_' or '*' with dots between them, found {found:?}"
    )]
    Subject { found: String },
    #[error("fleet.claims_subject: expected fleet.url beside it, found nothing")]
    SubjectWithoutUrl,
    #[error("fleet.station: expected nothing, since a hub is no station; found {found:?}")]
    HubWithStation { found: String },
    #[error("fleet.{key}: expected one of credentials_file and nkey_file, found both")]
    TwoIdentities { key: &'static str },
}

impl Config {
    /// Checks what holds for stations and the hub alike.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let key = Key::new("fleet");
        key.at("positions_hz").within(
            self.positions_hz,
            0.01..=1000.0,
            "positions are published at least every 100 s and at most as often as frames come",
        )?;
        key.at("lost_after_s").within(
            self.lost_after_s,
            2.0..=86_400.0,
            "stations report their health every second",
        )?;
        for (key, name) in [("site", &self.site), ("station", &self.station)] {
            if let Some(found) = name.as_ref().filter(|name| !is_name(name)) {
                let found = found.clone();
                return Err(ConfigError::Name { key, found });
            }
        }
        if let Some(found) = &self.url {
            let url = Url::parse(found).ok();
            let is_nats = |url: &Url| ["nats", "tls"].contains(&url.scheme()) && url.host().is_some();
            if !url.as_ref().is_some_and(is_nats) {
                let found = found.chars().take(200).collect();
                return Err(ConfigError::Url { found });
            }
        }
        if let Some(subject) = &self.claims_subject {
            let is_word = |word: &str| word == "*" || is_name(word);
            if !subject.split('.').all(is_word) {
                let found = subject.chars().take(200).collect();
                return Err(ConfigError::Subject { found });
            }
            if self.url.is_none() {
                return Err(ConfigError::SubjectWithoutUrl);
            }
        }
        if self.credentials_file.is_some() && self.nkey_file.is_some() {
            return Err(ConfigError::TwoIdentities { key: "nkey_file" });
        }
        Ok(())
    }

    /// Who publishes; `None` where nothing is published.
    pub fn station(&self) -> Result<Option<StationName>, ConfigError> {
        self.validate()?;
        if self.url.is_none() {
            return Ok(None);
        }
        let given = |key, name: &Option<String>| name.clone().ok_or(ConfigError::Missing { key });
        Ok(Some(StationName {
            site: given("site", &self.site)?,
            station: given("station", &self.station)?,
        }))
    }

    /// Checks that the table is a hub's.
    pub fn validate_hub(&self) -> Result<(), ConfigError> {
        self.validate()?;
        if self.url.is_none() {
            return Err(ConfigError::NoUrl);
        }
        match self.station.clone() {
            Some(found) => Err(ConfigError::HubWithStation { found }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_station_has_a_site_and_a_name_and_a_hub_has_none() {
        let read = |text: &str| toml::from_str::<Config>(text).unwrap();
        assert_eq!(read("").station().unwrap(), None);
        let station = read("url = \"nats://127.0.0.1:4222\"\nsite = \"harbour\"\nstation = \"ap7\"");
        assert_eq!(station.station().unwrap().unwrap().to_string(), "harbour.ap7");
        assert!(station.validate_hub().is_err());
        for text in [
            "url = \"nats://h:4222\"\nsite = \"a\"",
            "url = \"nats://h:4222\"\nstation = \"a\"",
            "url = \"http://h:4222\"\nsite = \"a\"\nstation = \"b\"",
            "url = \"nats://h\"\nsite = \"a.b\"\nstation = \"b\"",
            "url = \"nats://h\"\nsite = \"a\"\nstation = \"*\"",
            "claims_subject = \"network.claims\"",
            "url = \"nats://h\"\nsite = \"a\"\nstation = \"b\"\nclaims_subject = \"network..claims\"",
            "url = \"nats://h\"\nsite = \"a\"\nstation = \"b\"\nclaims_subject = \"network.>\"",
            "lost_after_s = 0",
            "positions_hz = -1",
        ] {
            let error = read(text).station().expect_err(text).to_string();
            assert!(error.starts_with("fleet.") && error.contains("found"), "{error}");
        }
        assert!(read("").validate_hub().is_err());
        read("url = \"tls://hub.example:4222\"").validate_hub().unwrap();
    }
}
