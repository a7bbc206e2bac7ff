//! Validates a `[[webhook]]` table and reads its secrets.

use std::time::Duration;

use sha2::{Digest, Sha256};
use url::{Host, Url};

use super::error::Error;
use super::signature::Signer;
use super::{Config, http};
use crate::journal::Subscription;

/// A `[[webhook]]` that can be sent to.
#[derive(Debug)]
pub struct Endpoint {
    pub(super) name: String,
    pub(super) url: Url,
    pub(super) signer: Signer,
    pub(super) client: reqwest::Client,
    pub(super) cool_down: Duration,
    subscription: Subscription,
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
        if !(1.0..=120.0).contains(&config.timeout_s) {
            return Err(Error::Timeout {
                index,
                found: config.timeout_s,
            });
        }
        if !(0.0..=86_400.0).contains(&config.cool_down_s) {
            return Err(Error::CoolDown {
                index,
                found: config.cool_down_s,
            });
        }
        if config.kinds.as_ref().is_some_and(Vec::is_empty) {
            return Err(Error::NoKinds { index });
        }
        let name = match &config.name {
            Some(name) if is_name(name) => name.clone(),
            Some(name) => {
                return Err(Error::Name {
                    index,
                    found: name.clone(),
                });
            }
            None => name_of(&url),
        };
        let timeout = Duration::from_secs_f64(config.timeout_s);
        Ok(Self {
            signer: read_secrets(index, config)?,
            client: http::build(index, config, timeout, loopback)?,
            cool_down: Duration::from_secs_f64(config.cool_down_s),
            subscription: Subscription {
                endpoint: name.clone(),
                kinds: config.kinds.clone(),
            },
            name,
            url,
        })
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// What the journal's outbox is to hold for this endpoint.
    pub fn subscription(&self) -> Subscription {
        self.subscription.clone()
    }

    /// The URL as it may be shown: query, fragment and credentials often are secrets.
    pub fn shown_url(&self) -> String {
        let mut url = self.url.clone();
        url.set_query(None);
        url.set_fragment(None);
        // These only fail for URLs that cannot hold credentials in the first place.
        let _ = url.set_username("");
        let _ = url.set_password(None);
        url.to_string()
    }
}

fn read_secrets(index: usize, config: &Config) -> Result<Signer, Error> {
    use std::os::unix::fs::PermissionsExt;
    let path = &config.secret_file;
    let unreadable = |cause| Error::Unreadable {
        index,
        path: path.clone(),
        cause,
    };
    let text = std::fs::read_to_string(path).map_err(unreadable)?;
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

fn is_loopback(url: &Url) -> bool {
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

/// The host, for readers, and a hash of the whole URL, which is unique and reveals nothing of it.
fn name_of(url: &Url) -> String {
    let host: String = url
        .host_str()
        .unwrap_or("webhook")
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '-' })
        .take(40)
        .collect();
    let hash = Sha256::digest(url.as_str().as_bytes());
    format!("{host}-{:02x}{:02x}{:02x}{:02x}", hash[0], hash[1], hash[2], hash[3])
}
