//! One connection: counted against the limits before any handshake, closed when it stalls.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum_server::accept::Accept;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpStream, UnixStream};
use tokio_io_timeout::TimeoutStream;

use super::client::{Client, TrustedProxies};
use super::connection_quota::{ConnectionPermit, ConnectionQuota};
use crate::metric;

/// What an HTTP/2 connection begins with (RFC 9113, 3.4).
const HTTP2_PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// Little is buffered for a slow reader in the kernel, so that what it reads is not old.
pub(super) const SEND_BUFFER: usize = 128 << 10;

/// What every connection is held to.
#[derive(Clone)]
pub(super) struct Limits {
    pub connections: Arc<ConnectionQuota>,
    pub proxies: Arc<TrustedProxies>,
    pub timeout: Duration,
}

impl Limits {
    pub fn before<A>(self, inner: A) -> Limited<A> {
        Limited { inner, limits: self }
    }
}

/// A connection as the kernel gives it.
pub(super) trait ClientStream {
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
pub(super) struct Limited<A> {
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
pub(super) struct Connection<S> {
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
