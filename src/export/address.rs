//! The address of an export: scheme, host and port, as its kind allows.

use url::Url;

use super::config::{Config, Kind, refuse};
use crate::notify::is_loopback;

/// Schemes of a kind with the port where the address names none.
fn schemes(kind: Kind) -> &'static [(&'static str, Option<u16>)] {
    match kind {
        // RFC 5426, 6587 and 5425.
        Kind::Syslog => &[("udp", Some(514)), ("tcp", Some(601)), ("tls", Some(6514))],
        Kind::Alertmanager => &[("https", Some(443)), ("http", Some(9093))],
        // As TAK servers and clients have them.
        Kind::Cot => &[("udp", Some(6969)), ("tcp", Some(8087)), ("tls", Some(8089))],
        Kind::Sapient => &[("tcp", None), ("tls", None)],
    }
}

/// Where an export's receiver is.
#[derive(Clone, Debug)]
pub(super) struct Address {
    pub url: Url,
    pub scheme: &'static str,
    /// Without the brackets of an IPv6 address.
    pub host: String,
    pub port: u16,
}

impl Address {
    pub(super) fn parse(config: &Config) -> Result<Self, String> {
        let text = &config.address;
        let allowed = schemes(config.kind);
        let expected = || {
            let names: Vec<String> = allowed
                .iter()
                .map(|(scheme, _)| format!("{scheme}://HOST:PORT"))
                .collect();
            names.join(" or ")
        };
        let wrong = || refuse("address", &expected(), format_args!("{text:?}"));
        let url = Url::parse(text).map_err(|_| wrong())?;
        let (scheme, port) = *allowed
            .iter()
            .find(|(scheme, _)| *scheme == url.scheme())
            .ok_or_else(wrong)?;
        let host = url.host_str().filter(|host| !host.is_empty()).ok_or_else(wrong)?;
        let host = host.trim_start_matches('[').trim_end_matches(']').to_owned();
        let is_http = scheme.starts_with("http");
        let is_bare =
            url.username().is_empty() && url.password().is_none() && url.fragment().is_none() && url.query().is_none();
        if !is_bare || !(is_http || matches!(url.path(), "" | "/")) {
            return Err(wrong());
        }
        if scheme == "http" && !is_loopback(&url) && !config.allow_http {
            return Err(format!(
                "address: http:// to {host} would show alerts to anyone on the way; use https://, or set allow_http = true"
            ));
        }
        let port = url.port().or(port).ok_or_else(wrong)?;
        Ok(Self {
            url,
            scheme,
            host,
            port,
        })
    }
}
