//! Who sends a request: the other end of the connection or, behind a trusted proxy, whom the proxy names.

use std::convert::Infallible;
use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::connect_info::{ConnectInfo, Connected};
use axum::extract::{FromRequestParts, Request, State as Shared};
use axum::http::HeaderMap;
use axum::http::request::Parts;
use axum::middleware::Next;
use axum::response::Response;
use ipnet::IpNet;

/// The network address of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Client {
    Ip(IpAddr),
    /// A process of this machine, over the Unix socket.
    Unix,
}

impl Client {
    /// The key of one client for limits: an IPv4 address, the /64 network that an IPv6 client is assigned, or the socket.
    pub(super) fn key(self) -> u128 {
        match self {
            Self::Ip(address) => match address.to_canonical() {
                IpAddr::V4(v4) => u128::from(u32::from(v4)),
                IpAddr::V6(v6) => u128::from(v6) >> 64 << 64 | 1,
            },
            Self::Unix => 2,
        }
    }
}

impl fmt::Display for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ip(address) => address.to_canonical().fmt(f),
            Self::Unix => f.write_str("unix"),
        }
    }
}

impl Connected<SocketAddr> for Client {
    fn connect_info(address: SocketAddr) -> Self {
        Self::Ip(address.ip())
    }
}

impl Connected<std::os::unix::net::SocketAddr> for Client {
    fn connect_info(_: std::os::unix::net::SocketAddr) -> Self {
        Self::Unix
    }
}

/// Who sends a request, by the name of their token; inserted into every request that is let through.
#[derive(Clone, Debug, Default)]
pub struct Actor(pub Option<Arc<str>>);

/// Who sends a request, for the handlers that change something.
#[derive(Clone, Debug)]
pub struct Caller {
    pub actor: Actor,
    pub client: Client,
}

impl Caller {
    /// The name of the caller's token, where it has one.
    pub fn name(&self) -> Option<String> {
        self.actor.0.as_deref().map(str::to_owned)
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(Self {
            actor: parts.extensions.get::<Actor>().cloned().unwrap_or_default(),
            client: parts.extensions.get::<Client>().copied().unwrap_or(Client::Unix),
        })
    }
}

/// An entry of `[api] trusted_proxies` that is no network.
#[derive(Debug, thiserror::Error)]
#[error("api.trusted_proxies: expected networks such as \"10.0.0.0/8\", addresses or \"unix\", found {0:?}")]
pub struct NoNetwork(String);

/// Proxies whose `X-Forwarded-For` is believed.
#[derive(Clone, Debug, Default)]
pub struct TrustedProxies {
    networks: Vec<IpNet>,
    unix: bool,
}

impl TrustedProxies {
    /// Reads `[api] trusted_proxies`: networks such as `10.0.0.0/8`, single addresses, and `unix`.
    pub fn new(networks: &[String]) -> Result<Self, NoNetwork> {
        let mut proxies = Self::default();
        for found in networks {
            if found == "unix" {
                proxies.unix = true;
                continue;
            }
            let single = || found.parse::<IpAddr>().ok().map(IpNet::from);
            let network = found.parse::<IpNet>().ok().or_else(single);
            let network = network.ok_or_else(|| NoNetwork(found.clone()))?;
            proxies.networks.push(network);
        }
        Ok(proxies)
    }

    pub(super) fn contain(&self, client: Client) -> bool {
        match client {
            Client::Unix => self.unix,
            Client::Ip(address) => {
                let address = address.to_canonical();
                self.networks.iter().any(|network| network.contains(&address))
            }
        }
    }

    /// The client behind `peer`. Each proxy appends the address it was called from, so the list is read from its end: the
    /// first address that is not a trusted proxy's is the client's, and what stands before it was written by the client.
    fn client_of(&self, peer: Client, headers: &HeaderMap) -> Client {
        let mut client = peer;
        let named: Vec<&str> = headers
            .get_all("x-forwarded-for")
            .iter()
            .map(|value| value.to_str().unwrap_or("unreadable"))
            .flat_map(|value| value.split(','))
            .collect();
        for hop in named.into_iter().rev() {
            if !self.contain(client) {
                break;
            }
            match forwarded_address(hop.trim()) {
                Some(address) => client = Client::Ip(address),
                None => break,
            }
        }
        client
    }
}

/// An address with or without a port.
fn forwarded_address(text: &str) -> Option<IpAddr> {
    let plain = text.trim_start_matches('[').trim_end_matches(']');
    let with_port = || text.parse::<SocketAddr>().ok().map(|address| address.ip());
    plain.parse().ok().or_else(with_port)
}

/// Gives every request its [`Client`].
pub async fn identify(
    Shared(proxies): Shared<Arc<TrustedProxies>>,
    ConnectInfo(peer): ConnectInfo<Client>,
    mut request: Request,
    next: Next,
) -> Response {
    let client = proxies.client_of(peer, request.headers());
    request.extensions_mut().insert(client);
    next.run(request).await
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(text: &str) -> Client {
        Client::Ip(text.parse().expect("an address"))
    }

    fn trusting(networks: &[&str]) -> TrustedProxies {
        let networks: Vec<String> = networks.iter().map(|n| (*n).to_owned()).collect();
        TrustedProxies::new(&networks).expect("networks")
    }

    fn headers(values: &[&'static str]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for value in values {
            headers.append("x-forwarded-for", axum::http::HeaderValue::from_static(value));
        }
        headers
    }

    #[test]
    fn only_a_trusted_proxy_names_a_client() {
        let proxies = trusting(&["10.0.0.0/8", "2001:db8::/32", "192.0.2.7"]);
        for (peer, forwarded, expected) in [
            ("198.51.100.1", &["203.0.113.9"][..], "198.51.100.1"),
            ("10.1.2.3", &[], "10.1.2.3"),
            ("10.1.2.3", &["203.0.113.9"], "203.0.113.9"),
            ("192.0.2.7", &["203.0.113.9"], "203.0.113.9"),
            ("192.0.2.8", &["203.0.113.9"], "192.0.2.8"),
            ("2001:db8::1", &["2001:4860::1"], "2001:4860::1"),
            ("::ffff:10.1.2.3", &["203.0.113.9"], "203.0.113.9"),
            // What the client wrote itself stands first and is not read.
            ("10.1.2.3", &["127.0.0.1, 203.0.113.9"], "203.0.113.9"),
            ("10.1.2.3", &["127.0.0.1", "203.0.113.9, 10.9.9.9"], "203.0.113.9"),
            ("10.1.2.3", &["203.0.113.9:4711"], "203.0.113.9"),
            ("10.1.2.3", &["[2001:4860::1]:4711"], "2001:4860::1"),
            ("10.1.2.3", &["203.0.113.9, nonsense"], "10.1.2.3"),
        ] {
            assert_eq!(
                proxies.client_of(ip(peer), &headers(forwarded)),
                ip(expected),
                "{peer} {forwarded:?}"
            );
        }
        assert_eq!(
            proxies.client_of(Client::Unix, &headers(&["203.0.113.9"])),
            Client::Unix
        );
        let behind_socket = trusting(&["unix"]);
        assert_eq!(
            behind_socket.client_of(Client::Unix, &headers(&["203.0.113.9"])),
            ip("203.0.113.9")
        );
    }

    #[test]
    fn what_is_no_network_is_refused() {
        for wrong in ["10.0.0.0/33", "proxy.example", "", "10.0.0"] {
            let message = TrustedProxies::new(&[wrong.into()]).expect_err(wrong).to_string();
            assert!(message.contains("api.trusted_proxies"), "{message}");
        }
    }
}
