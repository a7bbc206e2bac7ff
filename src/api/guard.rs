//! Guards against requests that a browser on this machine is tricked into (DNS rebinding, cross-origin requests), against
//! requests whose host is ambiguous, and against clients that ask too often.

use std::hash::{BuildHasher, RandomState};
use std::net::IpAddr;
use std::num::NonZeroU32;
use std::sync::Arc;

use axum::extract::{Request, State as Shared};
use axum::http::{HeaderMap, Method, StatusCode, Uri, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use governor::clock::{Clock, DefaultClock};
use governor::{DefaultDirectRateLimiter, Quota, RateLimiter};

use super::audit::Audit;
use super::client::Client;
use super::config::Config;
use super::problem::Problem;
use crate::metric;

/// Clients share this many buckets by a keyed hash of their address, so that memory is bounded whoever asks.
const BUCKETS: usize = 1024;

/// Which names and origins are ours.
pub struct Origins {
    audit: Audit,
    /// Whether a request's `Host` must be ours: when no token protects us.
    check_host: bool,
    hosts: Vec<String>,
    origins: Vec<String>,
}

impl Origins {
    pub fn new(config: &Config, token_required: bool, audit: Audit) -> Self {
        Self {
            audit,
            check_host: !token_required,
            hosts: config.allowed_hosts.iter().map(|h| h.to_ascii_lowercase()).collect(),
            origins: config.allowed_origins.clone(),
        }
    }

    /// A plain address cannot be rebound; of names only those we know are ours.
    fn knows_host(&self, host: &str) -> bool {
        let name = host_name(host).to_ascii_lowercase();
        let address = name.trim_start_matches('[').trim_end_matches(']');
        address.parse::<IpAddr>().is_ok()
            || name == "localhost"
            || name.ends_with(".localhost")
            || self.hosts.contains(&name)
    }

    fn knows_origin(&self, headers: &HeaderMap, host: Option<&str>) -> bool {
        let Some(origin) = headers.get(header::ORIGIN) else {
            return true;
        };
        let Ok(origin) = origin.to_str() else { return false };
        let own = origin.split_once("://").map(|(_, authority)| authority);
        own.is_some() && own == host || self.origins.iter().any(|o| o == origin)
    }
}

/// The host of `host[:port]`.
fn host_name(authority: &str) -> &str {
    match authority.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) && !name.ends_with(':') => name,
        _ => authority,
    }
}

/// The host that a request is for. Of two hosts a proxy may use another than this server, so exactly one is accepted (RFC 9112,
/// 3.2; RFC 9113, 8.3.1).
fn authority<'a>(version: Version, uri: &'a Uri, headers: &'a HeaderMap) -> Result<Option<&'a str>, &'static str> {
    let mut named = headers.get_all(header::HOST).iter();
    let host = match (named.next(), named.next()) {
        (None, _) if version == Version::HTTP_11 => return Err("expected one Host header, found none"),
        (None, _) => None,
        (Some(_), Some(_)) => return Err("expected one Host header, found several"),
        (Some(host), None) => Some(host.to_str().map_err(|_| "the Host header is not ASCII")?),
    };
    let target = uri.authority().map(|a| a.as_str());
    match (target, host) {
        (Some(target), Some(host)) if version >= Version::HTTP_2 && !target.eq_ignore_ascii_case(host) => {
            Err("the Host header names another host than the request")
        }
        _ => Ok(target.or(host)),
    }
}

fn refuse(audit: &Audit, request: &Request, reason: &'static str, problem: Problem) -> Response {
    metrics::counter!(metric::HTTP_REFUSED, "reason" => reason).increment(1);
    let client = request.extensions().get::<Client>().copied();
    audit.refused(request, client, None, &problem.detail);
    problem.into_response()
}

/// Refuses names that are not ours, and changes and streams that another site's page asks for.
pub async fn origin(Shared(ours): Shared<Arc<Origins>>, request: Request, next: Next) -> Response {
    let headers = request.headers();
    let host = match authority(request.version(), request.uri(), headers) {
        Ok(host) => host,
        Err(detail) => {
            let problem = Problem::new(StatusCode::BAD_REQUEST, detail);
            return refuse(&ours.audit, &request, "host", problem);
        }
    };
    if let Some(host) = host.filter(|h| ours.check_host && !ours.knows_host(h)) {
        let detail = format!("this server is not called {host:?}; if it should be, add it to api.allowed_hosts");
        let problem = Problem::new(StatusCode::MISDIRECTED_REQUEST, detail);
        return refuse(&ours.audit, &request, "host", problem);
    }
    let reads = [Method::GET, Method::HEAD, Method::OPTIONS].contains(request.method());
    let upgrade = headers.contains_key(header::UPGRADE);
    if (!reads || upgrade) && !ours.knows_origin(headers, host) {
        let detail = "a page of another origin may not do this; api.allowed_origins lists those that may";
        let problem = Problem::new(StatusCode::FORBIDDEN, detail);
        return refuse(&ours.audit, &request, "origin", problem);
    }
    next.run(request).await
}

/// Request rates by client address.
pub struct Rates {
    audit: Audit,
    buckets: Vec<DefaultDirectRateLimiter>,
    hasher: RandomState,
    clock: DefaultClock,
}

impl Rates {
    pub fn new(per_second: NonZeroU32, audit: Audit) -> Self {
        let quota =
            Quota::per_second(per_second).allow_burst(per_second.saturating_mul(NonZeroU32::MIN.saturating_add(1)));
        Self {
            audit,
            buckets: (0..BUCKETS).map(|_| RateLimiter::direct(quota)).collect(),
            hasher: RandomState::new(),
            clock: DefaultClock::default(),
        }
    }

    /// Seconds to wait, if the client has asked too often.
    fn excess(&self, client: Client) -> Option<u64> {
        let bucket = &self.buckets[self.hasher.hash_one(client.key()) as usize % BUCKETS];
        let until = bucket.check().err()?;
        Some(until.wait_time_from(self.clock.now()).as_secs() + 1)
    }
}

/// Whether a path is a liveness or readiness probe. A probe that is refused would make a supervisor restart the daemon during a
/// flood, and a probe costs almost nothing.
fn is_probe(path: &str) -> bool {
    ["/healthz", "/readyz"].contains(&path)
}

/// Refuses clients that ask too often.
pub async fn rate(Shared(rates): Shared<Arc<Rates>>, request: Request, next: Next) -> Response {
    let client = request.extensions().get::<Client>().copied().unwrap_or(Client::Unix);
    if is_probe(request.uri().path()) {
        return next.run(request).await;
    }
    match rates.excess(client) {
        None => next.run(request).await,
        Some(seconds) => {
            let detail = "more requests than api.requests_per_second allows";
            let problem = Problem::later(StatusCode::TOO_MANY_REQUESTS, seconds, detail);
            refuse(&rates.audit, &request, "rate", problem)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::journal::{self, Journal};

    fn audit() -> Audit {
        Audit::new(Journal::open(&journal::Config::default(), Vec::new()).expect("a journal in memory"))
    }

    #[test]
    fn a_request_names_one_host() {
        let uri: Uri = "/v1/positions".parse().expect("a path");
        let whole: Uri = "https://a.example/v1/positions".parse().expect("a URI");
        for (version, uri, hosts, expected) in [
            (Version::HTTP_11, &uri, &["a.example"][..], Ok(Some("a.example"))),
            (Version::HTTP_11, &uri, &[], Err(())),
            (Version::HTTP_11, &uri, &["a.example", "a.example"], Err(())),
            (Version::HTTP_11, &uri, &["a.example", "b.example"], Err(())),
            (Version::HTTP_11, &uri, &["\u{e4}.example"], Err(())),
            (Version::HTTP_10, &uri, &[], Ok(None)),
            (Version::HTTP_2, &whole, &[], Ok(Some("a.example"))),
            (Version::HTTP_2, &whole, &["A.example"], Ok(Some("a.example"))),
            (Version::HTTP_2, &whole, &["b.example"], Err(())),
        ] {
            let mut headers = HeaderMap::new();
            for host in hosts {
                let value = axum::http::HeaderValue::from_bytes(host.as_bytes()).expect("a header");
                headers.append(header::HOST, value);
            }
            let found = authority(version, uri, &headers).map_err(|_| ());
            assert_eq!(found, expected, "{version:?} {hosts:?}");
        }
    }

    #[test]
    fn only_our_names_and_plain_addresses_are_hosts() {
        let config = Config {
            allowed_hosts: vec!["UAV.local".into()],
            ..Config::default()
        };
        let ours = Origins::new(&config, false, audit());
        for (host, known) in [
            ("localhost:8787", true),
            ("LOCALHOST", true),
            ("watch.localhost:1", true),
            ("127.0.0.1:8787", true),
            ("[::1]:8787", true),
            ("[::1]", true),
            ("10.1.2.3", true),
            ("uav.local:8787", true),
            ("evil.example:8787", false),
            ("localhost.evil.example", false),
            ("127.0.0.1.evil.example", false),
            ("", false),
        ] {
            assert_eq!(ours.knows_host(host), known, "{host}");
        }
    }

    #[test]
    fn an_origin_is_ours_when_it_is_the_host_or_listed() {
        let config = Config {
            allowed_origins: vec!["https://ops.example.org".into()],
            ..Config::default()
        };
        let ours = Origins::new(&config, true, audit());
        for (origin, known) in [
            (None, true),
            (Some("http://127.0.0.1:8787"), true),
            (Some("https://ops.example.org"), true),
            (Some("http://127.0.0.1:9"), false),
            (Some("https://evil.example"), false),
            (Some("null"), false),
        ] {
            let mut headers = HeaderMap::new();
            if let Some(origin) = origin {
                headers.insert(header::ORIGIN, origin.parse().expect("a header"));
            }
            assert_eq!(ours.knows_origin(&headers, Some("127.0.0.1:8787")), known, "{origin:?}");
        }
    }

    #[test]
    fn a_client_that_asks_too_often_is_told_to_wait_and_others_are_not() {
        let rates = Rates::new(NonZeroU32::new(5).expect("not zero"), audit());
        let client = Client::Ip("192.0.2.1".parse().expect("an address"));
        let let_through = (0..50).filter(|_| rates.excess(client).is_none()).count();
        assert!((10..=12).contains(&let_through), "{let_through}");
        let others = (1..=100u8).map(|k| Client::Ip(IpAddr::from([198, 51, 100, k])));
        let served = others.filter(|o| rates.excess(*o).is_none()).count();
        // Each shares the bucket with a chance of 1 in 1024: more than six of a hundred once in 10¹¹ runs.
        assert!(served >= 94, "{served} of 100 others");
    }
}
