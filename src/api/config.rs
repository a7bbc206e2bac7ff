//! `[api]`: its keys, their defaults and what is refused before a port is bound.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::background;
use super::client::{NoNetwork, TrustedProxies};
use super::listener::Listen;

/// `[api]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub listen: Listen,
    /// Bearer tokens with full access, one a line, each after a name and a colon or alone; without any only loopback addresses may be listened on.
    pub token_file: Option<PathBuf>,
    /// Bearer tokens that may look but not change anything, likewise.
    pub read_token_file: Option<PathBuf>,
    /// PEM certificate chain; with `tls_key_file` the API speaks TLS only.
    pub tls_cert_file: Option<PathBuf>,
    /// PEM private key.
    pub tls_key_file: Option<PathBuf>,
    /// Origins of other web pages that may use the API (CORS), such as `https://ops.example.org`.
    pub allowed_origins: Vec<String>,
    /// Names, beside localhost and plain addresses, that this host is called by when no token is asked for.
    pub allowed_hosts: Vec<String>,
    /// Proxies whose `X-Forwarded-For` names the client: networks, addresses, or `unix` for the socket.
    pub trusted_proxies: Vec<String>,
    /// `max-age` of `Strict-Transport-Security`, s: for this long browsers use TLS only. 0 sends no such header. Needs TLS here.
    pub hsts_max_age_s: u64,
    /// Connections open at a time, streams included; one client holds at most three times as many as are still free.
    pub max_connections: usize,
    /// Requests a client address may make per second, on average.
    pub requests_per_second: u32,
    /// A client that takes longer to send a request, or to take a byte of the answer, is cut off.
    pub client_timeout_s: f64,
    /// What lies below the page's map.
    pub background: background::Config,
}

/// Why the API cannot be served as configured.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error(
        "api.listen: {listen} can be reached from other machines, so api.token_file is needed; \
         expected a token or a loopback address such as 127.0.0.1:8787"
    )]
    OpenToAll { listen: Listen },
    #[error("api.listen: a Unix socket speaks no TLS; expected no api.tls_cert_file beside {listen}")]
    TlsOnSocket { listen: Listen },
    #[error(
        "api.hsts_max_age_s: expected 0 without api.tls_cert_file, since browsers take it over TLS only, found {found}"
    )]
    HstsWithoutTls { found: u64 },
    #[error(transparent)]
    NoNetwork(#[from] NoNetwork),
    #[error("api.{missing}: expected a file, since api.{given} is set; found nothing")]
    HalfTls { given: &'static str, missing: &'static str },
    #[error("api.{field}: expected {expected}, found {found}")]
    OutOfRange {
        field: &'static str,
        expected: &'static str,
        found: f64,
    },
    #[error("api.allowed_origins: expected an origin such as \"https://ops.example.org\", found {found:?}")]
    NoOrigin { found: String },
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: Listen::Tcp(SocketAddr::from(([127, 0, 0, 1], 8787))),
            token_file: None,
            read_token_file: None,
            tls_cert_file: None,
            tls_key_file: None,
            allowed_origins: Vec::new(),
            allowed_hosts: Vec::new(),
            trusted_proxies: Vec::new(),
            hsts_max_age_s: 0,
            max_connections: 2048,
            requests_per_second: 200,
            client_timeout_s: 15.0,
            background: background::Config::default(),
        }
    }
}

impl Config {
    /// Time limit for a slow client.
    pub(super) fn client_timeout(&self) -> Duration {
        Duration::from_secs_f64(self.client_timeout_s)
    }

    /// Checks what can be checked without opening a file or a port.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let listen = || self.listen.clone();
        if !self.listen.is_local() && self.token_file.is_none() && self.read_token_file.is_none() {
            return Err(ConfigError::OpenToAll { listen: listen() });
        }
        let has_tls = self.tls_cert_file.is_some();
        if has_tls && matches!(self.listen, Listen::Unix(_)) {
            return Err(ConfigError::TlsOnSocket { listen: listen() });
        }
        if !has_tls && self.hsts_max_age_s > 0 {
            return Err(ConfigError::HstsWithoutTls {
                found: self.hsts_max_age_s,
            });
        }
        TrustedProxies::new(&self.trusted_proxies)?;
        match (&self.tls_cert_file, &self.tls_key_file) {
            (Some(_), None) => {
                return Err(ConfigError::HalfTls {
                    given: "tls_cert_file",
                    missing: "tls_key_file",
                });
            }
            (None, Some(_)) => {
                return Err(ConfigError::HalfTls {
                    given: "tls_key_file",
                    missing: "tls_cert_file",
                });
            }
            _ => {}
        }
        if !(1..=100_000).contains(&self.max_connections) {
            return Err(ConfigError::OutOfRange {
                field: "max_connections",
                expected: "1 to 100000 (a host has no more ports for one client)",
                found: self.max_connections as f64,
            });
        }
        if !(1..=1_000_000).contains(&self.requests_per_second) {
            return Err(ConfigError::OutOfRange {
                field: "requests_per_second",
                expected: "1 to 1000000 (more than the API can answer)",
                found: self.requests_per_second.into(),
            });
        }
        if !(0.1..=3600.0).contains(&self.client_timeout_s) {
            return Err(ConfigError::OutOfRange {
                field: "client_timeout_s",
                expected: "0.1 to 3600 seconds",
                found: self.client_timeout_s,
            });
        }
        for origin in &self.allowed_origins {
            let plain = url::Url::parse(origin).is_ok_and(|u| u.origin().ascii_serialization() == *origin);
            if !plain {
                return Err(ConfigError::NoOrigin { found: origin.clone() });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listening(addr: &str) -> Config {
        Config {
            listen: addr.parse().expect("an address"),
            ..Config::default()
        }
    }

    #[test]
    fn beyond_loopback_only_with_a_token() {
        for open in ["0.0.0.0:1", "[::]:1", "192.0.2.7:1", "[::ffff:192.0.2.7]:1"] {
            let mut config = listening(open);
            let message = config.validate().expect_err(open).to_string();
            assert!(message.contains("api.token_file"), "{message}");
            config.read_token_file = Some("tokens".into());
            config.validate().expect("a token is given");
        }
        for closed in ["127.0.0.1:1", "127.9.9.9:1", "[::1]:1", "[::ffff:127.0.0.1]:1"] {
            listening(closed).validate().expect(closed);
        }
    }

    #[test]
    fn a_socket_needs_no_token_and_takes_no_tls_and_hsts_needs_it() {
        let mut config = listening("unix:/run/oapwatch/api.sock");
        config.validate().expect("only this machine reaches a socket");
        config.tls_cert_file = Some("cert.pem".into());
        config.tls_key_file = Some("key.pem".into());
        let message = config.validate().expect_err("TLS on a socket").to_string();
        assert!(message.contains("api.tls_cert_file"), "{message}");
        config.listen = Config::default().listen;
        config.hsts_max_age_s = 31_536_000;
        config.validate().expect("HSTS with TLS");
        config.tls_cert_file = None;
        config.tls_key_file = None;
        let message = config.validate().expect_err("HSTS without TLS").to_string();
        assert!(message.contains("api.hsts_max_age_s"), "{message}");
    }

    #[test]
    fn certificate_and_key_go_together() {
        let mut config = Config {
            tls_cert_file: Some("cert.pem".into()),
            ..Config::default()
        };
        let message = config.validate().expect_err("no key").to_string();
        assert!(message.contains("tls_key_file"), "{message}");
        config.tls_key_file = Some("key.pem".into());
        config.validate().expect("both given");
    }

    #[test]
    fn an_origin_is_scheme_and_host_only() {
        for (origin, good) in [
            ("https://ops.example.org", true),
            ("http://127.0.0.1:3000", true),
            ("https://ops.example.org/", false),
            ("ops.example.org", false),
            ("*", false),
        ] {
            let config = Config {
                allowed_origins: vec![origin.into()],
                ..Config::default()
            };
            assert_eq!(config.validate().is_ok(), good, "{origin}");
        }
    }
}
