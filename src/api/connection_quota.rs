//! Limits the number of open connections, in total and per client address.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::client::Client;

/// A client may hold this many times the number of free connections: three quarters of all when it is alone. Six such
/// clients in a row are needed to leave none to others (Choudhury & Hahne, 1998, dynamic thresholds of a shared memory).
const FREE_MULTIPLE: usize = 3;

/// Counts open connections. Memory is bounded by their number.
pub(super) struct ConnectionQuota {
    limit: usize,
    held: Mutex<Held>,
}

#[derive(Default)]
struct Held {
    total: usize,
    by_client: HashMap<u128, usize>,
}

/// One counted connection; dropping it frees its place.
pub(super) struct ConnectionPermit {
    quota: Arc<ConnectionQuota>,
    client: u128,
}

/// Why a connection is refused, as the metric names it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Refused {
    Full,
    Greedy,
}

impl Refused {
    pub(super) fn reason(self) -> &'static str {
        match self {
            Self::Full => "connections",
            Self::Greedy => "share",
        }
    }
}

impl ConnectionQuota {
    pub(super) fn new(limit: usize) -> Arc<Self> {
        let held = Mutex::default();
        Arc::new(Self { limit, held })
    }

    /// `shares_all`: a trusted proxy brings many clients, so that only the total limits it.
    pub(super) fn take(self: &Arc<Self>, client: Client, shares_all: bool) -> Result<ConnectionPermit, Refused> {
        let client = client.key();
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.limit.saturating_sub(held.total);
        if free == 0 {
            return Err(Refused::Full);
        }
        let own = held.by_client.get(&client).copied().unwrap_or(0);
        if !shares_all && own >= FREE_MULTIPLE * free {
            return Err(Refused::Greedy);
        }
        held.by_client.insert(client, own + 1);
        held.total += 1;
        Ok(ConnectionPermit {
            quota: self.clone(),
            client,
        })
    }
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        let mut held = self.quota.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.total -= 1;
        match held.by_client.get_mut(&self.client) {
            Some(own) if *own > 1 => *own -= 1,
            _ => drop(held.by_client.remove(&self.client)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ip(address: &str) -> Client {
        Client::Ip(address.parse().expect("an address"))
    }

    fn as_many_as_it_gets(quota: &Arc<ConnectionQuota>, address: &str) -> Vec<ConnectionPermit> {
        let client = ip(address);
        std::iter::from_fn(|| quota.take(client, false).ok()).collect()
    }

    #[test]
    fn greedy_clients_leave_some_for_others() {
        let quota = ConnectionQuota::new(2048);
        let first = as_many_as_it_gets(&quota, "192.0.2.1");
        assert_eq!(first.len(), 1536);
        let mut others = Vec::new();
        for k in 0..100 {
            let other = as_many_as_it_gets(&quota, &format!("198.51.100.{k}"));
            assert!(!other.is_empty() || k > 4, "client {k}");
            others.extend(other);
        }
        drop(others);
        assert_eq!(as_many_as_it_gets(&quota, "2001:db8::1").len(), 384);
    }

    #[test]
    fn a_network_of_one_client_is_one_client() {
        let quota = ConnectionQuota::new(8);
        let own = as_many_as_it_gets(&quota, "2001:db8::1");
        let again = quota.take(ip("2001:db8::2"), false);
        assert_eq!((own.len(), again.err()), (6, Some(Refused::Greedy)));
        let other = as_many_as_it_gets(&quota, "2001:db8:0:1::1");
        assert_eq!(other.len(), 2);
        let last = quota.take(ip("192.0.2.1"), false);
        assert_eq!(last.err(), Some(Refused::Full));
    }

    #[test]
    fn a_trusted_proxy_may_hold_all_there_are() {
        let quota = ConnectionQuota::new(8);
        let held: Vec<_> = std::iter::from_fn(|| quota.take(ip("192.0.2.1"), true).ok()).collect();
        assert_eq!(held.len(), 8);
    }

    #[test]
    fn what_is_given_back_is_there_again() {
        let quota = ConnectionQuota::new(2);
        let own = as_many_as_it_gets(&quota, "192.0.2.1");
        assert_eq!(own.len(), 2);
        drop(own);
        assert!(quota.held.lock().expect("no panic").by_client.is_empty());
        assert_eq!(as_many_as_it_gets(&quota, "192.0.2.1").len(), 2);
    }
}
