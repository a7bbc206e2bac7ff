//! The HTTP client of one webhook: private authority, no redirects.

use std::time::Duration;

use reqwest::{Certificate, Client, redirect};
use url::Url;

use super::Config;
use super::error::{AuthorityError, Error};

/// `loopback`: the receiver is on this host, so that no proxy lies between.
pub(super) fn build(index: usize, config: &Config, url: &Url, loopback: bool) -> Result<Client, Error> {
    // Any earlier choice of the process stands.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let mut builder = Client::builder()
        .user_agent(concat!("oapwatch/", env!("CARGO_PKG_VERSION")))
        .redirect(redirect::Policy::none())
        .referer(false)
        .connect_timeout(Duration::from_secs(10))
        .pool_idle_timeout(Duration::from_secs(60));
    if loopback {
        builder = builder.no_proxy();
    }
    if url.scheme() == "http" {
        // A host without authorities can send all the same.
        builder = builder.tls_certs_only([]);
    } else if let Some(path) = &config.ca_file {
        let authority = |cause| Error::Authority {
            index,
            path: path.clone(),
            cause,
        };
        let pem = std::fs::read(path).map_err(|e| authority(e.into()))?;
        let certificates = Certificate::from_pem_bundle(&pem).map_err(|e| authority(e.into()))?;
        if certificates.is_empty() {
            return Err(authority(AuthorityError::Empty));
        }
        builder = builder.tls_certs_merge(certificates);
    }
    builder.build().map_err(|error| Error::Client {
        index,
        cause: error.into(),
    })
}
