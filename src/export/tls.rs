//! The TLS of an export: the system's authorities, a private one, and the certificate that we show.

use std::path::Path;
use std::sync::Arc;

use rustls::ClientConfig;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls_platform_verifier::Verifier;

use super::config::Config;

/// Reads the files that the config names.
pub(super) fn client(config: &Config) -> Result<ClientConfig, String> {
    let provider = Arc::new(ring::default_provider());
    let authorities = match &config.ca_file {
        Some(path) => certificates("ca_file", path)?,
        None => Vec::new(),
    };
    let verifier =
        Verifier::new_with_extra_roots(authorities, provider.clone()).map_err(|e| format!("ca_file: {e}"))?;
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|e| format!("address: {e}"))?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(verifier));
    match (&config.client_cert_file, &config.client_key_file) {
        (None, None) => Ok(builder.with_no_client_auth()),
        (Some(chain), Some(key)) => {
            let chain = certificates("client_cert_file", chain)?;
            let read = PrivateKeyDer::from_pem_file(key);
            let read = read.map_err(|e| {
                format!(
                    "client_key_file: {}: expected a private key in PEM, found: {e}",
                    key.display()
                )
            })?;
            let with = builder.with_client_auth_cert(chain, read);
            with.map_err(|e| format!("client_key_file: {}: {e}", key.display()))
        }
        (Some(_), None) => Err("client_cert_file: expected client_key_file beside it, found none".to_owned()),
        (None, Some(_)) => Err("client_key_file: expected client_cert_file beside it, found none".to_owned()),
    }
}

fn certificates(key: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let wrong = |found: String| {
        format!(
            "{key}: {}: expected certificates in PEM, found: {found}",
            path.display()
        )
    };
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect);
    let chain: Vec<_> = read.map_err(|e: rustls::pki_types::pem::Error| wrong(e.to_string()))?;
    if chain.is_empty() {
        return Err(wrong("none".to_owned()));
    }
    Ok(chain)
}
