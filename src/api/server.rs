//! Connections: their number and timeouts, plain or TLS, TCP or Unix socket, and how they end.

use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, SystemTime};

use axum_server::Handle;
use axum_server::accept::{Accept, DefaultAcceptor};
use axum_server::tls_rustls::{RustlsAcceptor, RustlsConfig};
use hyper_util::rt::{TokioExecutor, TokioTimer};
use hyper_util::server::conn::auto;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpStream, UnixStream};
use tokio::sync::watch;
use tokio_io_timeout::TimeoutStream;

use super::audit::Audit;
use super::auth::{TokenError, Tokens, warn_of_readers};
use super::client::{Client, TrustedProxies};
use super::config::{Config, ConfigError};
use super::connection_quota::{ConnectionPermit, ConnectionQuota};
use super::listener::Listener;
use super::state::State;
use crate::metric;

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
/// What an HTTP/2 connection begins with (RFC 9113, 3.4).
const HTTP2_PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Little is buffered for a slow reader in the kernel, so that what it reads is not old.
const SEND_BUFFER: usize = 128 << 10;

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

/// What every connection is held to.
#[derive(Clone)]
struct Limits {
    connections: Arc<ConnectionQuota>,
    proxies: Arc<TrustedProxies>,
    timeout: Duration,
}

impl Limits {
    fn before<A>(self, inner: A) -> Limited<A> {
        Limited { inner, limits: self }
    }
}

/// A connection as the kernel gives it.
trait ClientStream {
    fn client(&self) -> io::Result<Client>;
    fn tune(&self) -> io::Result<()>;
}

impl ClientStream for TcpStream {
    fn client(&self) -> io::Result<Client> {
        Ok(Client::Ip(self.peer_addr()?.ip()))
    }

    fn tune(&self) -> io::Result<()> {
        let socket = socket2::SockRef::from(self);
        socket.set_send_buffer_size(SEND_BUFFER)?;
        socket.set_tcp_nodelay(true)
    }
}

impl ClientStream for UnixStream {
    fn client(&self) -> io::Result<Client> {
        Ok(Client::Unix)
    }

    fn tune(&self) -> io::Result<()> {
        socket2::SockRef::from(self).set_send_buffer_size(SEND_BUFFER)
    }
}

/// Refuses connections above a limit, before any handshake, and closes those that stall.
#[derive(Clone)]
struct Limited<A> {
    inner: A,
    limits: Limits,
}

impl<A, I, S> Accept<I, S> for Limited<A>
where
    A: Accept<I, S, Future: Send + 'static, Service: Send + 'static>,
    A::Stream: AsyncRead + AsyncWrite + Send + 'static,
    I: ClientStream,
{
    type Stream = Connection<A::Stream>;
    type Service = A::Service;
    type Future = Pin<Box<dyn Future<Output = io::Result<(Self::Stream, Self::Service)>> + Send>>;

    fn accept(&self, stream: I, service: S) -> Self::Future {
        let client = match stream.client() {
            Ok(client) => client,
            Err(e) => return Box::pin(std::future::ready(Err(e))),
        };
        let is_proxy = self.limits.proxies.contain(client);
        let permit = match self.limits.connections.take(client, is_proxy) {
            Ok(permit) => permit,
            Err(refused) => {
                metrics::counter!(metric::HTTP_REFUSED, "reason" => refused.reason()).increment(1);
                return Box::pin(std::future::ready(Err(io::ErrorKind::ConnectionRefused.into())));
            }
        };
        let counted = Counted::open();
        if let Err(e) = stream.tune() {
            return Box::pin(std::future::ready(Err(e)));
        }
        let timeout = self.limits.timeout;
        let accepted = self.inner.accept(stream, service);
        Box::pin(async move {
            let (stream, service) = accepted.await?;
            let mut stream = TimeoutStream::new(stream);
            stream.set_write_timeout(Some(timeout));
            stream.set_read_timeout(Some(timeout));
            let connection = Connection {
                stream: Box::pin(stream),
                opening: Some(0),
                _permit: permit,
                _counted: counted,
            };
            Ok((connection, service))
        })
    }
}

/// One client's connection, counted as long as it lives, upgraded to a WebSocket or not.
struct Connection<S> {
    stream: Pin<Box<TimeoutStream<S>>>,
    /// Bytes read while nothing but the beginning of HTTP/2's preface has come. Once more has, hyper's own timeouts watch the
    /// header and the pings, and a stream's pings the rest.
    opening: Option<usize>,
    _permit: ConnectionPermit,
    _counted: Counted,
}

impl<S: AsyncRead + AsyncWrite> AsyncRead for Connection<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        let outcome = self.stream.as_mut().poll_read(cx, buf);
        if let (Some(read), true) = (self.opening, outcome.is_ready()) {
            self.opening = still_opening(read, &buf.filled()[before..]);
            if self.opening.is_none() {
                self.stream.as_mut().set_read_timeout_pinned(None);
            }
        }
        outcome
    }
}

impl<S: AsyncRead + AsyncWrite> AsyncWrite for Connection<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream.as_mut().poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.stream.as_mut().poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// How much of HTTP/2's preface has come with `new` bytes after `read` ones; `None` once it is whole, or something else comes.
fn still_opening(read: usize, new: &[u8]) -> Option<usize> {
    let rest = &HTTP2_PREFACE[read..];
    let is_part = !new.is_empty() && new.len() < rest.len() && rest.starts_with(new);
    is_part.then_some(read + new.len())
}

/// A gauge that is one higher while this lives.
pub(super) struct Counted(metrics::Gauge);

impl Counted {
    fn open() -> Self {
        Self::up(metrics::gauge!(metric::HTTP_CONNECTIONS))
    }

    pub(super) fn stream(protocol: &'static str) -> Self {
        Self::up(metrics::gauge!(metric::STREAM_CLIENTS, "protocol" => protocol))
    }

    fn up(gauge: metrics::Gauge) -> Self {
        gauge.increment(1.0);
        Self(gauge)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_that_stops_within_the_preface_has_not_begun() {
        assert_eq!(still_opening(0, b"PRI * "), Some(6));
        assert_eq!(still_opening(6, b"HTTP/2.0\r\n"), Some(16));
        assert_eq!(still_opening(16, b"\r\nSM\r\n\r\n"), None);
        assert_eq!(still_opening(0, b"GET / HTTP/1.1\r\n"), None);
        assert_eq!(still_opening(0, b"P"), Some(1));
        assert_eq!(still_opening(1, b"OST /v1/claims HTTP/1.1\r\n"), None);
    }
}
