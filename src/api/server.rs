//! The server: plain or TLS, TCP or Unix socket, how it is kept up to date and how it ends.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use axum_server::Handle;
use axum_server::accept::DefaultAcceptor;
use axum_server::tls_rustls::{RustlsAcceptor, RustlsConfig};
use hyper_util::rt::{TokioExecutor, TokioTimer};
use hyper_util::server::conn::auto;
use tokio::sync::watch;

use super::audit::Audit;
use super::client::{Client, TrustedProxies};
use super::config::{Config, ConfigError};
use super::connection::{Limits, SEND_BUFFER};
use super::connection_quota::ConnectionQuota;
use super::listener::Listener;
use super::state::State;
use super::tokens::{TokenError, Tokens, warn_of_readers};

/// Time that running requests get when the daemon stops.
const SHUTDOWN_GRACE: Duration = Duration::from_secs(1);
/// How often token files and certificates are read again: what was taken out of a file ends its streams within a second.
const RELOAD_EVERY: Duration = Duration::from_millis(300);
const MAX_HEADER_BYTES: usize = 32 << 10;
/// An HTTP/2 client that answers no ping within the client timeout is cut off.
const HTTP2_PING_EVERY: Duration = Duration::from_secs(15);
/// Concurrent requests on one HTTP/2 connection: enough for the page, and few enough that the number of connections remains
/// the limit.
const HTTP2_STREAMS: u32 = 32;

/// Why the API cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Token(#[from] TokenError),
    #[error("api.tls_cert_file, api.tls_key_file: {cert}, {key}: {source}")]
    Tls {
        cert: PathBuf,
        key: PathBuf,
        source: io::Error,
    },
    #[error("the API's listener failed: {0}")]
    Listener(#[from] io::Error),
}

/// An API whose config has been checked and whose secrets have been read; no port is bound yet.
pub struct Server {
    config: Config,
    tokens: Arc<Tokens>,
    proxies: Arc<TrustedProxies>,
    tls: Option<Tls>,
}

#[derive(Clone)]
struct Tls {
    cert: PathBuf,
    key: PathBuf,
    config: RustlsConfig,
}

impl Server {
    /// Reads tokens and certificates. Cheap enough for `check`.
    pub fn new(config: Config) -> Result<Self, Error> {
        config.validate()?;
        let tokens = Arc::new(Tokens::load(&config)?);
        let proxies = Arc::new(TrustedProxies::new(&config.trusted_proxies).map_err(ConfigError::from)?);
        let tls = match (&config.tls_cert_file, &config.tls_key_file) {
            (Some(cert), Some(key)) => Some(Tls::load(cert.clone(), key.clone())?),
            _ => None,
        };
        if tls.is_none() && !config.listen.is_local() {
            tracing::warn!(
                "the API listens on {} without TLS: tokens travel in the clear",
                config.listen
            );
        }
        Ok(Self {
            config,
            tokens,
            proxies,
            tls,
        })
    }

    /// "http" or "https".
    pub fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Serves until `shutdown` completes, then closes streams and lets requests under way finish.
    pub async fn serve(
        self,
        listener: impl Into<Listener>,
        state: State,
        shutdown: impl Future<Output = ()> + Send + 'static,
    ) -> Result<(), Error> {
        let listener = listener.into();
        let upkeep = tokio::spawn(keep_up(self.tokens.clone(), self.tls.clone(), state.audit.clone()));
        let stopping = state.stopping.clone();
        let audit = state.audit.clone();
        let app = super::router(state, &self.config, self.tokens.clone(), self.proxies.clone());
        let service = app.into_make_service_with_connect_info::<Client>();
        let timeout = self.config.client_timeout();
        let limits = Limits {
            connections: ConnectionQuota::new(self.config.max_connections),
            proxies: self.proxies.clone(),
            timeout,
        };
        let outcome = match listener {
            Listener::Tcp(listener) => {
                listener.set_nonblocking(true)?;
                let handle = Handle::new();
                let stop = tokio::spawn(stop_on(shutdown, stopping, handle.clone()));
                let mut server = axum_server::from_tcp(listener)?.handle(handle);
                *server.http_builder() = protocol(timeout, self.tls.is_some());
                let outcome = match self.tls {
                    None => {
                        let acceptor = limits.before(DefaultAcceptor::new());
                        server.acceptor(acceptor).serve(service).await
                    }
                    Some(tls) => {
                        let acceptor = limits.before(RustlsAcceptor::new(tls.config).handshake_timeout(timeout));
                        server.acceptor(acceptor).serve(service).await
                    }
                };
                stop.abort();
                outcome
            }
            Listener::Unix(listener, _file) => {
                listener.set_nonblocking(true)?;
                let handle = Handle::new();
                let stop = tokio::spawn(stop_on(shutdown, stopping, handle.clone()));
                let mut server = axum_server::from_unix(listener)?.handle(handle);
                *server.http_builder() = protocol(timeout, false);
                let acceptor = limits.before(DefaultAcceptor::new());
                let outcome = server.acceptor(acceptor).serve(service).await;
                stop.abort();
                outcome
            }
        };
        upkeep.abort();
        audit.flush(true);
        Ok(outcome?)
    }
}

/// Stops a server when `shutdown` completes: streams are closed, running requests get a second.
async fn stop_on<A: axum_server::Address>(
    shutdown: impl Future<Output = ()>,
    stopping: watch::Sender<bool>,
    handle: Handle<A>,
) {
    shutdown.await;
    stopping.send_replace(true);
    handle.graceful_shutdown(Some(SHUTDOWN_GRACE));
}

/// HTTP/1.1 and, where the TLS handshake chooses it, HTTP/2. WebSockets come over HTTP/1.1 connections of their own.
fn protocol(timeout: Duration, has_tls: bool) -> auto::Builder<TokioExecutor> {
    let mut builder = auto::Builder::new(TokioExecutor::new());
    if !has_tls {
        builder = builder.http1_only();
    }
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(timeout)
        .max_buf_size(MAX_HEADER_BYTES);
    builder
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(HTTP2_PING_EVERY)
        .keep_alive_timeout(timeout)
        .max_concurrent_streams(HTTP2_STREAMS)
        .max_header_list_size(MAX_HEADER_BYTES as u32)
        .max_send_buf_size(SEND_BUFFER);
    builder
}

impl Tls {
    fn load(cert: PathBuf, key: PathBuf) -> Result<Self, Error> {
        let config = RustlsConfig::from_config(server_config(&cert, &key)?);
        warn_of_readers(&key);
        Ok(Self { cert, key, config })
    }

    fn reload(&self) -> Result<(), Error> {
        self.config.reload_from_config(server_config(&self.cert, &self.key)?);
        Ok(())
    }

    fn changed_at(&self) -> Option<(SystemTime, SystemTime)> {
        let time = |p: &Path| std::fs::metadata(p).and_then(|m| m.modified()).ok();
        Some((time(&self.cert)?, time(&self.key)?))
    }
}

fn server_config(cert: &PathBuf, key: &PathBuf) -> Result<Arc<rustls::ServerConfig>, Error> {
    use rustls::pki_types::pem::PemObject;
    use rustls::pki_types::{CertificateDer, PrivateKeyDer};
    let failed = |source: io::Error| Error::Tls {
        cert: cert.clone(),
        key: key.clone(),
        source,
    };
    let bad = |e: rustls::pki_types::pem::Error| failed(io::Error::other(e));
    let chain = CertificateDer::pem_file_iter(cert).map_err(bad)?;
    let chain = chain.collect::<Result<Vec<_>, _>>().map_err(bad)?;
    let key_der = PrivateKeyDer::from_pem_file(key).map_err(bad)?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .and_then(|b| b.with_no_client_auth().with_single_cert(chain, key_der))
        .map_err(|e| failed(io::Error::other(e)))?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}

/// Reloads tokens and certificates when their files change, and writes the audit log's rows that are due.
async fn keep_up(tokens: Arc<Tokens>, tls: Option<Tls>, audit: Audit) {
    let mut seen = tls.as_ref().and_then(Tls::changed_at);
    let mut reported = Vec::new();
    loop {
        tokio::time::sleep(RELOAD_EVERY).await;
        audit.flush(false);
        let (has_changed, wrong) = tokens.reload();
        if has_changed {
            tracing::info!("the API's tokens have changed and are in force");
        }
        let mut faults: Vec<String> = wrong.iter().map(ToString::to_string).collect();
        if let Some(tls) = &tls {
            let now = tls.changed_at();
            if now.is_some() && now != seen {
                match tls.reload() {
                    Ok(()) => {
                        seen = now;
                        tracing::info!("the API's certificate has changed and is in force");
                    }
                    Err(e) => faults.push(format!("{e}; the certificate before stays in force")),
                }
            }
        }
        for fault in faults.iter().filter(|fault| !reported.contains(*fault)) {
            tracing::warn!("{fault}");
        }
        reported = faults;
    }
}
