//! Connections: how many, how slow, in plain or in TLS, and how they end.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
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
use tokio::net::TcpStream;
use tokio_io_timeout::TimeoutStream;

use super::auth::{TokenError, Tokens};
use super::config::{Config, ConfigError};
use super::connection_quota::{ConnectionPermit, ConnectionQuota};
use super::state::State;
use crate::metric;

/// Requests under way when the daemon stops have this long.
const SHUTDOWN_GRACE: Duration = Duration::from_secs(1);
/// How often secrets and certificates on disk are looked at.
const LOOK_AGAIN: Duration = Duration::from_secs(2);
const MAX_HEADER_BYTES: usize = 32 << 10;
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
        let tls = match (&config.tls_cert_file, &config.tls_key_file) {
            (Some(cert), Some(key)) => Some(Tls::load(cert.clone(), key.clone())?),
            _ => None,
        };
        if tls.is_none() && !config.listen.ip().to_canonical().is_loopback() {
            tracing::warn!(
                "the API listens on {} without TLS: tokens travel in the clear",
                config.listen
            );
        }
        Ok(Self { config, tokens, tls })
    }

    /// "http" or "https".
    pub fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Serves until `shutdown` completes, then says goodbye to streams and lets requests under way finish.
    pub async fn serve(
        self,
        listener: std::net::TcpListener,
        state: State,
        shutdown: impl Future<Output = ()> + Send + 'static,
    ) -> Result<(), Error> {
        listener.set_nonblocking(true)?;
        let handle = Handle::new();
        let stopping = state.stopping.clone();
        let upkeep = tokio::spawn(keep_up(self.tokens.clone(), self.tls.clone()));
        let stop = tokio::spawn({
            let handle = handle.clone();
            async move {
                shutdown.await;
                stopping.send_replace(true);
                handle.graceful_shutdown(Some(SHUTDOWN_GRACE));
            }
        });
        let app = super::router(state, &self.config, self.tokens.clone());
        let service = app.into_make_service_with_connect_info::<SocketAddr>();
        let patience = self.config.patience();
        let connections = ConnectionQuota::new(self.config.max_connections);
        let mut server = axum_server::from_tcp(listener)?.handle(handle);
        *server.http_builder() = protocol(patience);
        let outcome = match self.tls {
            None => {
                let limited = Limited {
                    inner: DefaultAcceptor::new(),
                    connections,
                    patience,
                };
                server.acceptor(limited).serve(service).await
            }
            Some(tls) => {
                let limited = Limited {
                    inner: RustlsAcceptor::new(tls.config).handshake_timeout(patience),
                    connections,
                    patience,
                };
                server.acceptor(limited).serve(service).await
            }
        };
        upkeep.abort();
        stop.abort();
        Ok(outcome?)
    }
}

/// HTTP/1.1 only: what browsers and Prometheus speak to one host, and WebSockets need no second way in.
fn protocol(patience: Duration) -> auto::Builder<TokioExecutor> {
    let mut builder = auto::Builder::new(TokioExecutor::new()).http1_only();
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(patience)
        .max_buf_size(MAX_HEADER_BYTES);
    builder
}

impl Tls {
    fn load(cert: PathBuf, key: PathBuf) -> Result<Self, Error> {
        let config = RustlsConfig::from_config(server_config(&cert, &key)?);
        Ok(Self { cert, key, config })
    }

    fn reload(&self) -> Result<(), Error> {
        self.config.reload_from_config(server_config(&self.cert, &self.key)?);
        Ok(())
    }

    fn changed_at(&self) -> Option<(SystemTime, SystemTime)> {
        let time = |p: &PathBuf| std::fs::metadata(p).and_then(|m| m.modified()).ok();
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
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}

/// Reloads tokens and certificates when their files change.
async fn keep_up(tokens: Arc<Tokens>, tls: Option<Tls>) {
    let mut seen = tls.as_ref().and_then(Tls::changed_at);
    let mut complained = false;
    loop {
        tokio::time::sleep(LOOK_AGAIN).await;
        let mut failure = None;
        match tokens.reload() {
            Ok(true) => tracing::info!("the API's tokens have changed and are in force"),
            Ok(false) => {}
            Err(e) => failure = Some(e.to_string()),
        }
        if let Some(tls) = &tls {
            let now = tls.changed_at();
            if now.is_some() && now != seen {
                match tls.reload() {
                    Ok(()) => {
                        seen = now;
                        tracing::info!("the API's certificate has changed and is in force");
                    }
                    Err(e) => failure = Some(e.to_string()),
                }
            }
        }
        match failure {
            Some(e) if !complained => {
                tracing::warn!("{e}; what was in force stays in force");
                complained = true;
            }
            Some(_) => {}
            None => complained = false,
        }
    }
}

/// Turns connections away above a limit, before any handshake, and cuts those that stall.
#[derive(Clone)]
struct Limited<A> {
    inner: A,
    connections: Arc<ConnectionQuota>,
    patience: Duration,
}

impl<A, S> Accept<TcpStream, S> for Limited<A>
where
    A: Accept<TcpStream, S, Future: Send + 'static, Service: Send + 'static>,
    A::Stream: AsyncRead + AsyncWrite + Send + 'static,
{
    type Stream = Connection<A::Stream>;
    type Service = A::Service;
    type Future = Pin<Box<dyn Future<Output = io::Result<(Self::Stream, Self::Service)>> + Send>>;

    fn accept(&self, stream: TcpStream, service: S) -> Self::Future {
        let address = match stream.peer_addr() {
            Ok(address) => address.ip(),
            Err(e) => return Box::pin(std::future::ready(Err(e))),
        };
        let permit = match self.connections.take(address) {
            Ok(permit) => permit,
            Err(refused) => {
                metrics::counter!(metric::HTTP_REFUSED, "reason" => refused.reason()).increment(1);
                return Box::pin(std::future::ready(Err(io::ErrorKind::ConnectionRefused.into())));
            }
        };
        let counted = Counted::open();
        let socket = socket2::SockRef::from(&stream);
        if let Err(e) = socket
            .set_send_buffer_size(SEND_BUFFER)
            .and(socket.set_tcp_nodelay(true))
        {
            return Box::pin(std::future::ready(Err(e)));
        }
        let patience = self.patience;
        let accepted = self.inner.accept(stream, service);
        Box::pin(async move {
            let (stream, service) = accepted.await?;
            let mut stream = TimeoutStream::new(stream);
            stream.set_write_timeout(Some(patience));
            stream.set_read_timeout(Some(patience));
            let connection = Connection {
                stream: Box::pin(stream),
                is_silent: true,
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
    /// Nothing has been read yet. Once something has, hyper's own clock watches the header, and a stream's pings the rest.
    is_silent: bool,
    _permit: ConnectionPermit,
    _counted: Counted,
}

impl<S: AsyncRead + AsyncWrite> AsyncRead for Connection<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let outcome = self.stream.as_mut().poll_read(cx, buf);
        if self.is_silent && outcome.is_ready() {
            self.is_silent = false;
            self.stream.as_mut().set_read_timeout_pinned(None);
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
