//! A receiver of alert events; validates a `[[webhook]]` table and reads its secrets.

use std::sync::Arc;
use std::time::Duration;

use sha2::{Digest, Sha256};
use url::{Host, Url};

use super::channel::Channel;
use super::client::Webhook;
use super::error::{CommonError, Error};
use super::signature::Signer;
use super::{Config, http};
use crate::journal::Subscription;
use crate::monitor::AlertKind;
use crate::small_file;

/// A receiver that alert events can be sent to: a `[[webhook]]` or an `[[export]]`.
#[derive(Debug)]
pub struct Endpoint {
    /// What status, metrics and journal call it.
    pub name: String,
    /// "webhook", or the kind of the export.
    pub kind: &'static str,
    /// The address as it may be shown.
    pub shown_url: String,
    /// `None` is all.
    pub kinds: Option<Vec<AlertKind>>,
    /// Whether it hears of acknowledgements too.
    pub has_operator_acts: bool,
    pub cool_down: Duration,
    /// Longest duration of one attempt.
    pub timeout: Duration,
    pub channel: Arc<dyn Channel>,
}

/// Validates all `[[webhook]]` tables and reads their secrets.
pub fn load(configs: &[Config]) -> Result<Vec<Endpoint>, Error> {
    let mut endpoints: Vec<Endpoint> = Vec::with_capacity(configs.len());
    for (k, config) in configs.iter().enumerate() {
        let endpoint = Endpoint::load(k + 1, config)?;
        if let Some(earlier) = endpoints.iter().position(|e| e.name == endpoint.name) {
            return Err(Error::Twice {
                index: k + 1,
                earlier: earlier + 1,
                name: endpoint.name,
            });
        }
        endpoints.push(endpoint);
    }
    Ok(endpoints)
}

/// The names by which the journal knows the endpoints of a config, also of one that [`load`] would refuse.
pub fn names(configs: &[Config]) -> Vec<String> {
    let name = |config: &Config| match &config.name {
        Some(name) => Some(name.clone()),
        None => Url::parse(&config.url).ok().map(|url| name_of("webhook", &url)),
    };
    configs.iter().filter_map(name).collect()
}

/// What `[[webhook]]` and `[[export]]` have in common.
pub fn check_common(
    name: Option<&str>,
    kinds: Option<&[AlertKind]>,
    timeout_s: f64,
    cool_down_s: f64,
) -> Result<(), CommonError> {
    if !(1.0..=120.0).contains(&timeout_s) {
        return Err(CommonError::Timeout(timeout_s));
    }
    if !(0.0..=86_400.0).contains(&cool_down_s) {
        return Err(CommonError::CoolDown(cool_down_s));
    }
    if kinds.is_some_and(<[_]>::is_empty) {
        return Err(CommonError::NoKinds);
    }
    match name {
        Some(name) if !is_name(name) => Err(CommonError::Name(name.to_owned())),
        _ => Ok(()),
    }
}

impl Endpoint {
    fn load(index: usize, config: &Config) -> Result<Self, Error> {
        let url = Url::parse(&config.url).map_err(|cause| Error::Url { index, cause })?;
        let loopback = is_loopback(&url);
        match url.scheme() {
            "https" => {}
            "http" if loopback || config.allow_http => {}
            "http" => {
                return Err(Error::Plain {
                    index,
                    host: url.host_str().unwrap_or_default().to_owned(),
                });
            }
            scheme => {
                return Err(Error::Scheme {
                    index,
                    scheme: scheme.to_owned(),
                });
            }
        }
        check_common(
            config.name.as_deref(),
            config.kinds.as_deref(),
            config.timeout_s,
            config.cool_down_s,
        )
        .map_err(|cause| Error::Common { index, cause })?;
        let webhook = Webhook {
            signer: read_secrets(index, config)?,
            client: http::build(index, config, &url, loopback)?,
            url: url.clone(),
        };
        Ok(Self {
            name: config.name.clone().unwrap_or_else(|| name_of("webhook", &url)),
            kind: "webhook",
            shown_url: shown_url(&url),
            kinds: config.kinds.clone(),
            has_operator_acts: false,
            cool_down: Duration::from_secs_f64(config.cool_down_s),
            timeout: Duration::from_secs_f64(config.timeout_s),
            channel: Arc::new(webhook),
        })
    }

    /// What the journal's outbox is to hold for this endpoint.
    pub fn subscription(&self) -> Subscription {
        Subscription {
            endpoint: self.name.clone(),
            kinds: self.kinds.clone(),
            has_operator_acts: self.has_operator_acts,
        }
    }
}

/// A URL as it may be shown: query, fragment and credentials often are secrets.
pub fn shown_url(url: &Url) -> String {
    let mut url = url.clone();
    url.set_query(None);
    url.set_fragment(None);
    // These only fail for URLs that cannot hold credentials in the first place.
    let _ = url.set_username("");
    let _ = url.set_password(None);
    url.to_string()
}

fn read_secrets(index: usize, config: &Config) -> Result<Signer, Error> {
    use std::os::unix::fs::PermissionsExt;
    let path = &config.secret_file;
    let unreadable = |cause| Error::Unreadable {
        index,
        path: path.clone(),
        cause,
    };
    let text = small_file::read(path).map_err(unreadable)?;
    let signer = Signer::parse(&text).map_err(|(line, cause)| Error::Secret {
        index,
        path: path.clone(),
        line,
        cause,
    })?;
    let mode = std::fs::metadata(path).map_err(unreadable)?.permissions().mode() & 0o777;
    if mode & 0o077 != 0 {
        tracing::warn!(path = %path.display(), mode = %format_args!("{mode:03o}"), "others may read this webhook secret; chmod 600 it");
    }
    if signer.is_weak() {
        tracing::warn!(path = %path.display(), "a webhook secret is shorter than the 24 bytes that Standard Webhooks asks for");
    }
    Ok(signer)
}

/// Whether the receiver is on this host.
pub fn is_loopback(url: &Url) -> bool {
    match url.host() {
        Some(Host::Domain(name)) => name == "localhost" || name.ends_with(".localhost"),
        Some(Host::Ipv4(ip)) => ip.is_loopback(),
        Some(Host::Ipv6(ip)) => ip.is_loopback(),
        None => false,
    }
}

fn is_name(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=64).contains(&name.len()) && name.chars().all(allowed)
}

/// A name for an endpoint that was given none: its kind or host, for readers, and a hash of the whole URL, which is unique and reveals
/// nothing of it.
pub fn name_of(kind: &str, url: &Url) -> String {
    let host = url.host_str().unwrap_or_default();
    let plain: String = host
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '-' })
        .take(40)
        .collect();
    let hash = Sha256::digest(url.as_str().as_bytes());
    let before = match kind {
        "webhook" if !plain.is_empty() => plain,
        "webhook" => kind.to_owned(),
        _ => format!("{kind}-{plain}"),
    };
    format!("{before}-{:02x}{:02x}{:02x}{:02x}", hash[0], hash[1], hash[2], hash[3])
}
