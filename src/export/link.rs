//! A connection that messages are written to: UDP, TCP or TLS, opened again when it is lost.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use futures_util::FutureExt;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpStream, UdpSocket, lookup_host};
use tokio::sync::Mutex;
use tokio_rustls::TlsConnector;

use super::address::Address;
use super::config::Config;
use super::tls;
use crate::notify::Failure;

/// What a receiver says between two messages is read and dropped; one that says more is cut off.
const MOST_HEARD: usize = 4 << 20;

/// Writes whole messages, one after the other. A message is handed to the operating system: neither UDP nor plain streams confirm it.
pub(super) struct Link {
    host: String,
    port: u16,
    security: Option<(TlsConnector, ServerName<'static>)>,
    is_datagram: bool,
    open: Mutex<Option<Open>>,
}

enum Open {
    Datagram(UdpSocket),
    Stream(Box<dyn Duplex>),
}

/// Both directions of a stream.
pub(super) trait Duplex: AsyncRead + AsyncWrite + std::fmt::Debug + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + std::fmt::Debug + Send + Unpin> Duplex for T {}

impl std::fmt::Debug for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Link({}:{})", self.host, self.port)
    }
}

impl std::fmt::Display for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

impl Link {
    pub(super) fn new(config: &Config, address: &Address) -> Result<Self, String> {
        let security = match address.scheme {
            "tls" => {
                let name = ServerName::try_from(address.host.clone());
                let name = name.map_err(|e| {
                    format!(
                        "address: expected a host's name or address, found {:?}: {e}",
                        address.host
                    )
                })?;
                Some((TlsConnector::from(Arc::new(tls::client(config)?)), name))
            }
            _ => None,
        };
        Ok(Self {
            host: address.host.clone(),
            port: address.port,
            security,
            is_datagram: address.scheme == "udp",
            open: Mutex::new(None),
        })
    }

    /// Whether each message is a datagram of its own.
    pub(super) fn is_datagram(&self) -> bool {
        self.is_datagram
    }

    /// Sends one message. When it fails, or is dropped half-way, the connection is given up: nobody could tell where the next message begins.
    pub(super) async fn send(&self, message: &[u8]) -> Result<(), Failure> {
        let mut place = self.open.lock().await;
        let mut open = match place.take().and_then(Open::if_alive) {
            Some(open) => open,
            None => self.open().await.map_err(Failure::Unreachable)?,
        };
        match &mut open {
            Open::Datagram(socket) => socket.send(message).await.map(drop),
            Open::Stream(stream) => match stream.write_all(message).await {
                Ok(()) => stream.flush().await,
                Err(error) => Err(error),
            },
        }
        .map_err(Failure::Interrupted)?;
        *place = Some(open);
        Ok(())
    }

    async fn open(&self) -> io::Result<Open> {
        if self.is_datagram {
            return Ok(Open::Datagram(self.socket().await?));
        }
        Ok(Open::Stream(self.connect().await?))
    }

    /// A new connection for both directions.
    pub(super) async fn connect(&self) -> io::Result<Box<dyn Duplex>> {
        let stream = TcpStream::connect((self.host.as_str(), self.port)).await?;
        stream.set_nodelay(true)?;
        Ok(match &self.security {
            Some((connector, name)) => Box::new(connector.connect(name.clone(), stream).await?),
            None => Box::new(stream),
        })
    }

    async fn socket(&self) -> io::Result<UdpSocket> {
        let mut last = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
        for address in lookup_host((self.host.as_str(), self.port)).await? {
            let any = match address {
                SocketAddr::V4(_) => SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
                SocketAddr::V6(_) => SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0)),
            };
            let socket = UdpSocket::bind(any).await?;
            match socket.connect(address).await {
                Ok(()) => return Ok(socket),
                Err(error) => last = error,
            }
        }
        Err(last)
    }
}

impl Open {
    /// The connection, unless the other side has closed it. What it said is dropped.
    fn if_alive(mut self) -> Option<Self> {
        let Self::Stream(stream) = &mut self else {
            return Some(self);
        };
        let mut heard = 0;
        let mut bytes = [0; 4096];
        while heard < MOST_HEARD {
            match stream.read(&mut bytes).now_or_never() {
                None => return Some(self),
                Some(Ok(0) | Err(_)) => return None,
                Some(Ok(n)) => heard += n,
            }
        }
        None
    }
}
